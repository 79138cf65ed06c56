"""The index of an open store in MongoDB, reached when a question or a recording needs it."""

from __future__ import annotations

import os
import platform
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from typing import TYPE_CHECKING, NamedTuple, ParamSpec, TypeVar

from hybridlog.maintenance.report import IndexTarget, Progress
from hybridlog_storage.errors import (
    ConnectionLostError,
    DatabaseError,
    HybridlogError,
    StoreError,
    WithoutMongoError,
)
from hybridlog_storage.mongo.index_documents import IndexState, Owner, other_store
from hybridlog_storage.settings import (
    EMBEDDED,
    NAME,
    NONE,
    is_own,
    with_password,
    without_password,
)

if TYPE_CHECKING:
    from hybridlog.shared import Shared
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.mongo.mongod import EmbeddedMongod

_P = ParamSpec("_P")
_T = TypeVar("_T")
_TIMEOUT_S = 5.0
_EMBEDDED_TIMEOUT_S = 2.0
"""Seconds to wait for a server that was reached before; the embedded one has no network."""
_REST_S = 10.0
"""Seconds after a failure in which questions do not try to connect again."""


def again_if_lost(work: Callable[_P, _T]) -> Callable[_P, _T]:
    """Do something once more if the connection to MongoDB was lost.

    The new connection has started a MongoDB that had ended.
    """

    @wraps(work)
    def tried(*args: _P.args, **options: _P.kwargs) -> _T:
        try:
            return work(*args, **options)
        except ConnectionLostError:
            return work(*args, **options)

    return tried


class IndexAddress(NamedTuple):
    """The address of the index for other programs.

    Attributes:
        uri: As `pymongo.MongoClient` takes it, without a password.
        database: Name of the database.
    """

    uri: str
    database: str


class IndexAccess:
    """The index of an open store.

    Args:
        mongo: URI of the MongoDB, `embedded`, or `none`; None for the one in the store's
            settings.

    Attributes:
        wanted: The URI that was asked for; None for the one in the store's settings.
        id: Id of the index; an index that replaces it has another one. Empty without a
            connection.
        unavailable: The reason why MongoDB is unavailable; None while that is unknown.
    """

    def __init__(
        self,
        shared: Shared,
        mongo: str | None,
        progress: Progress | None,
    ) -> None:
        self.wanted = mongo
        self.id = ""
        self.unavailable: HybridlogError | None = None
        self._shared = shared
        self._directory = shared.directory
        self._progress = progress
        self._mongod: EmbeddedMongod | None = None
        self._database: Database | None = None
        self._owns = False  # the index is of the store at this place, not of a copy elsewhere
        self._rests_until = 0.0
        self._connecting = threading.RLock()
        self._is_complete = False  # the index has all recordings

    def note_changes(self) -> None:
        """Note that the index may lack something."""
        self._is_complete = False

    @property
    def connected(self) -> Database | None:
        """The index, if it is connected already."""
        return None if self._database is None or self._database.is_lost else self._database

    def reached(self, *, brings: bool = True) -> Database | None:
        """The index, connected when it is needed; without `brings`, it may lack recordings.

        None if it is unavailable. A failure is remembered for some seconds.
        """
        is_ready = self._is_complete or not brings
        if (self.connected is None or not is_ready) and time.monotonic() >= self._rests_until:
            with suppress(HybridlogError):
                self.connect(brings=brings)
        return self.connected

    def database_for(self, purpose: str, *, brings: bool = True) -> Database:
        """The index, for a purpose that errors name; without `brings`, it may lack recordings."""
        database = self.reached(brings=brings)
        if database is None:
            raise DatabaseError(f"{purpose} needs MongoDB. {self.unavailable or ''}".strip())
        return database

    def index_to_record(self, purpose: str, *, brings: bool = True) -> IndexTarget:
        """The index, for a new recording; it may be unavailable, or without `brings` be behind."""
        try:
            database = self.database_for(purpose, brings=brings)
        except DatabaseError as error:
            why = self.unavailable if isinstance(self.unavailable, DatabaseError) else error
            # It does without MongoDB if none is wanted, or ours does not start.
            has_none = self._named in {EMBEDDED, NONE} and not isinstance(why, ConnectionLostError)
            return IndexTarget(failure=None if has_none else why)
        return IndexTarget(database)

    def connect(self, *, brings: bool = True) -> Database:
        """Connect to the index and bring it up to date; once more if the connection breaks."""
        with self._connecting:
            if self.connected is not None and (self._is_complete or not brings):
                return self.connected
            may_end = self.connected is not None or self._named == EMBEDDED
            connect = again_if_lost(self._connect) if may_end else self._connect
            try:
                return connect(brings=brings)
            except BaseException as error:
                self.disconnect()
                if isinstance(error, HybridlogError):
                    self.unavailable = error
                    self._rests_until = time.monotonic() + _REST_S
                raise

    def disconnect(self) -> None:
        """Disconnect; questions are then answered from the files.

        The embedded MongoDB ends when no process uses it.
        """
        if self._database is not None:
            self._database.close()
        self._database = None
        self.id = ""
        if self._mongod is not None:
            self._mongod.stop()
        self._mongod = None

    def claim(self, database: Database) -> Owner:
        """Note in the index that it is of the store at this place."""
        owner = IndexState(database).claim(self._directory.settings.store_id, self._own_place)
        self.id, self._owns = owner.made, True
        return owner

    @property
    def _own_place(self) -> str:
        """The place of the store, as its index has it; the embedded MongoDB moves with it."""
        if self._named == EMBEDDED:
            return EMBEDDED
        return f"{platform.node()}:{os.path.realpath(self._directory.path)}"

    def address(self, wait_s: float) -> IndexAddress:
        """The lasting address of the index; an embedded MongoDB waits `wait_s` for clients."""
        name = self.connect().name
        if self._mongod is not None:
            return IndexAddress(self._mongod.publish(wait_s), name)
        return IndexAddress(without_password(self._named), name)

    @property
    def _named(self) -> str:
        return self.wanted or self._directory.settings.mongo or EMBEDDED

    @property
    def is_wanted(self) -> bool:
        """False in a store that is used without MongoDB."""
        return self._named != NONE

    @property
    def place(self) -> str:
        """Its URI without secrets, `embedded` or `none`."""
        if self._named in {EMBEDDED, NONE}:
            return self._named
        from hybridlog_storage.mongo.database import without_secrets

        return without_secrets(self._named)

    def _another(self) -> Database:
        """A new connection; starts the embedded MongoDB if it is not running."""
        uri = self._named
        if uri == NONE:
            setting = "--mongo none" if self.wanted else f'mongo = "none" in {NAME}'
            raise WithoutMongoError(
                f"The store is used without MongoDB ({setting}). With --mongo embedded, or --mongo "
                "URI, a command uses one; `hybridlog index rebuild` makes its index."
            )
        from hybridlog_storage.mongo.database import Database, without_secrets

        if uri == EMBEDDED:
            return Database.connect(self._started(), timeout_s=_EMBEDDED_TIMEOUT_S)
        if self.wanted is not None:
            uri = with_password(uri)  # no other server gets it: an unpacked store is one's own, too
        elif not is_own(self._directory.path):
            raise DatabaseError(
                f"The store {self._directory.path} names a MongoDB at {without_secrets(uri)}, and "
                f"its {NAME} is not yours: if that server is, name it by `--mongo URI`."
            )
        return Database.connect(uri, timeout_s=_TIMEOUT_S)

    def _started(self) -> str:
        """The URI of the embedded MongoDB, which runs."""
        from hybridlog_storage.mongo.mongod import EmbeddedMongod

        if self._mongod is None:
            self._mongod = EmbeddedMongod(self._directory.mongod)
        try:
            return self._mongod.start()
        except StoreError as error:
            # A read-only store has no embedded MongoDB, but its segments can be read.
            raise DatabaseError(str(error)) from error

    def _connect(self, *, brings: bool) -> Database:
        from hybridlog.maintenance.derived import StoreIndex

        shared = self._shared
        if self.connected is None:
            self._is_complete = False
        changed: set[str] = set()
        database = self._open()
        if brings:
            shared.recover()
            store = StoreIndex(shared.directory, shared.catalog, database, self._progress)
            session = shared.now()
            changed = store.bring_up_to_date(
                session.snapshot(),
                session.entry_of,
                index=self.id,
                removes=self._owns,
                report=shared.repairs,
            )
        self.unavailable, self._rests_until = None, 0.0
        if brings:
            self._is_complete = True
            if changed:
                shared.catch_up(*changed)  # what came meanwhile is seen, and indexed next
        return database

    def _open(self) -> Database:
        """The database, connected again if it is lost; it belongs to this store."""
        if (database := self.connected) is not None:
            return database
        if self._database is not None:
            self._database.close()
        database = self._database = self._another()
        state, store_id = IndexState(database), self._directory.settings.store_id
        owner = state.owner()
        if owner is not None and owner.store != store_id:
            if self._named != EMBEDDED:
                raise other_store(database)
            # The store is a copy that has an id of its own now.
            database.run(lambda db: db.client.drop_database(db.name))
            owner = None
        if owner is None:
            owner = self.claim(database)
        self.id, self._owns = owner.made, owner.place == self._own_place
        return database
