"""Reaches the index of an open store in MongoDB, when a question or a recording needs it."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from hybridlog.index.connection import Connection
from hybridlog.maintenance.report import RepairReport
from hybridlog_storage.errors import (
    ConnectionBrokenError,
    ConnectionLostError,
    DatabaseError,
    HybridlogError,
    MissingDependencyError,
    ResourceError,
    StoreError,
)

if TYPE_CHECKING:
    from hybridlog.index.index_writer import IndexTarget
    from hybridlog.maintenance.report import Progress
    from hybridlog.shared import Shared
    from hybridlog_storage.mongo.database import Database

_REST_S = 10.0
"""Seconds after a failure in which questions do not try to connect again."""


class IndexAccess:
    """The index of an open store.

    Args:
        shared: The open store.
        connection: Its connection to MongoDB.
        progress: Called while an index is brought up to date.
        recovers: False to leave what the index lacks of cut recordings to another opening.

    Attributes:
        connection: As above.
        unavailable: The reason why MongoDB is unavailable; None while that is unknown.
    """

    def __init__(
        self,
        shared: Shared,
        connection: Connection,
        progress: Progress | None,
        *,
        recovers: bool,
    ) -> None:
        self._shared = shared
        self.connection = connection
        self.unavailable: HybridlogError | None = None
        self._progress = progress
        self._recovers = recovers
        self._rests_until = 0.0
        self._connecting = threading.RLock()
        self._is_complete = False  # the index has all recordings
        self._stale: set[str] = set()  # recordings that the index may lack

    def note_changes(self, *recordings: str) -> None:
        """Note that the index may lack something, of some recordings for certain."""
        self._stale.update(recordings)
        self._is_complete = False

    @property
    def connected(self) -> Database | None:
        """The index, if it is connected already."""
        return self.connection.database

    @property
    def database(self) -> Database | None:
        """The index, connected when it is needed; None if MongoDB is unavailable.

        A failure is remembered for some seconds.
        """
        return self._reached(brings=True)

    def _reached(self, *, brings: bool) -> Database | None:
        """The index, connected when it is needed; `brings` it up to date first."""
        is_ready = self._is_complete or not brings
        if (self.connected is None or not is_ready) and time.monotonic() >= self._rests_until:
            with suppress(HybridlogError):
                self.connect(brings=brings)
        return self.connected

    def index_as_it_is(self) -> Database:
        """The index, for a MongoDB filter; it may lack recordings.

        Raises:
            DatabaseError: it is unavailable; has the reason.
        """
        database = self._reached(brings=False)
        if database is None:
            raise self._missing_database("A MongoDB filter (a predicate needs none)")
        return database

    def connect(self, *, brings: bool = True) -> Database:
        """Connect to the index and bring it up to date; once more if the connection breaks.

        Args:
            brings: False to leave it as it is.

        Raises:
            DatabaseError: MongoDB does not answer.
            StoreError: it holds the index of another store, or this store is a copy.
        """
        with self._connecting:
            if self.connected is not None and (self._is_complete or not brings):
                return self.connected
            was_connected = self.connected is not None
            try:
                try:
                    return self._connect(brings=brings)
                except ConnectionLostError as error:
                    if not was_connected and not isinstance(error, ConnectionBrokenError):
                        raise
                return self._connect(brings=brings)
            except BaseException as error:
                self.disconnect()
                if isinstance(error, HybridlogError):
                    self.unavailable = error
                    self._rests_until = time.monotonic() + _REST_S
                raise

    def _connect(self, *, brings: bool) -> Database:
        from hybridlog.maintenance import index

        shared = self._shared
        if self.connected is None:
            self._is_complete = False
        repairs = RepairReport()
        changed: set[str] = set()
        try:
            database = self.connection.open()
            if brings and self.connection.may_write:
                store = index.StoreIndex(shared.directory, shared.catalog, database, self._progress)
                session = self._shared.now()
                changed = store.bring_up_to_date(
                    session.snapshot(),
                    session.entry_of,
                    index=self.connection.index,
                    stale=self._stale,
                    report=repairs,
                )
        finally:
            shared.repairs.damage += self.connection.damage
            self.connection.damage.clear()
            shared.repairs.indexed.update(repairs.indexed)
            shared.repairs.unreadable.update(repairs.unreadable)
            shared.repairs.removed += repairs.removed
        self.unavailable = None
        self._rests_until = 0.0
        if brings:
            self._stale = set()
            self._is_complete = True
            if changed:
                shared.catch_up(*changed)  # what came meanwhile is seen, and indexed next
        return database

    def disconnect(self) -> None:
        """Disconnect from MongoDB; questions are then answered from the files."""
        self.connection.close()

    def take_over(self) -> None:
        """Record in the index that the store is at this location."""
        self.connection.take_over()
        self.unavailable = None
        self._rests_until = 0.0

    def database_for(self, purpose: str, *, writes: bool = False) -> Database:
        """The index.

        Args:
            purpose: The activity, for messages.
            writes: True if it changes the index.

        Raises:
            DatabaseError: it is unavailable, or may not be changed; has the purpose and the
                reason.
        """
        return self._checked(self.database, purpose, writes=writes)

    def _checked(self, database: Database | None, purpose: str, *, writes: bool) -> Database:
        """The index, if there is one that may be used; raises as `database_for` does."""
        if database is None:
            raise self._missing_database(purpose)
        if writes and not self.connection.may_write:
            raise DatabaseError(
                f"{purpose} needs a MongoDB user who may write. This one may only read: grant "
                f"the role readWrite on the database {database.name!r}."
            )
        return database

    def _missing_database(self, purpose: str) -> DatabaseError:
        return DatabaseError(f"{purpose} needs MongoDB. {self.unavailable or ''}".strip())

    @property
    def writable_database(self) -> Database | None:
        """The index; None if it is unavailable, or if its user may only read."""
        database = self.database
        return database if self.connection.may_write else None

    def index_to_record(self, purpose: str) -> IndexTarget:
        """The index, for a new recording; it may lack other recordings, or be unavailable.

        Raises:
            DatabaseError: as for `database_for`, if it was reached.
            StoreError: it holds the index of another store, or this store is a copy.
        """
        from hybridlog.index.index_writer import IndexTarget

        if self.connected is not None and self.connection.may_write:
            if self.connected.ping():
                return IndexTarget(self.connected, renew=self._another_database)
            self.disconnect()
        # Those that a crash has cut are brought into the index by another opening.
        database = self._reached(brings=self._recovers)
        if database is None and self.unavailable is not None:
            if isinstance(self.unavailable, ConnectionLostError):
                return IndexTarget(failure=self.unavailable, renew=self._another_database)
            if self.connection.has_none:
                return IndexTarget()
            if isinstance(self.unavailable, StoreError):
                raise self.unavailable
        database = self._checked(database, purpose, writes=True)
        return IndexTarget(database, renew=self._another_database)

    def _another_database(self) -> Database:
        """An additional connection to the index.

        Raises:
            DatabaseError: It does not answer, or belongs to another store.
        """
        try:
            if not self.connection.index:
                with self._connecting:
                    self.connection.open()
            return self.connection.another()
        except (StoreError, ResourceError, MissingDependencyError) as error:
            raise DatabaseError(str(error)) from error
