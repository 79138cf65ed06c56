"""The connection of a store to its index in MongoDB, made on first use."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, NamedTuple, ParamSpec, TypeVar

from hybridlog_storage.errors import (
    ConnectionLostError,
    DatabaseError,
    DiskFullError,
    MissingDependencyError,
    ResourceError,
    StoreError,
    WithoutMongoError,
)
from hybridlog_storage.settings import EMBEDDED, MIN_CACHE_MB, NAME, NONE, with_password

if TYPE_CHECKING:
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.mongo.mongod import EmbeddedMongod

_P = ParamSpec("_P")
_T = TypeVar("_T")
_TIMEOUT_S = 5.0
_EMBEDDED_TIMEOUT_S = 2.0
"""Seconds to wait for a server that was reached before; the embedded one has no network."""


def again_if_lost(work: Callable[_P, _T]) -> Callable[_P, _T]:
    """Do something once more if the connection to MongoDB was lost.

    The new connection has started a MongoDB that had ended, and replaced damaged data files.
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


class Connection:
    """Starts and connects to the MongoDB that holds the index of a store.

    Args:
        directory: The store.
        mongo: URI of the MongoDB, `embedded`, or `none`; None for the one in the store's
            settings.
        cache_mb: Size of the embedded MongoDB's cache in MiB, if this process starts it; None
            for the one in the store's settings.

    Attributes:
        wanted: The URI that was asked for; None for the one in the store's settings.
        may_write: False if the user of MongoDB may only read.
        has_none: True if the store does without MongoDB: none is wanted, or ours does not start.
        damage: Reasons why data files of the embedded MongoDB were replaced by empty ones.
        index: Id of the index; an index that replaces it has another one. Empty without a
            connection, and for an index without an id that this user may only read.
    """

    def __init__(
        self, directory: StoreDirectory, mongo: str | None, cache_mb: int | None = None
    ) -> None:
        self.may_write = True
        self.has_none = False
        self.damage: list[str] = []
        self.index = ""
        self._database: Database | None = None
        self._directory = directory
        self.wanted = mongo
        self._cache_mb = cache_mb
        self._uri: str | None = None
        self._mongod: EmbeddedMongod | None = None

    @property
    def database(self) -> Database | None:
        """The index; None without a connection."""
        return None if self._database is None or self._database.is_lost else self._database

    def open(self) -> Database:
        """Connect, and check that the database belongs to this store.

        Raises:
            DatabaseError: MongoDB does not answer, or the store does without.
            StoreError: it holds the index of another store, or this store is a copy.
        """
        from hybridlog.maintenance import lease
        from hybridlog_storage.mongo.index_state import IndexState

        database = self.database
        if database is None:
            if self._database is not None:
                self._database.close()
            database = self._database = self.another()
            state = IndexState(database)
            place = lease.place_of(self._directory)
            self.may_write = database.may_write()
            mark = state.mark()
            if self._uri == EMBEDDED and mark is not None and mark.get("id") != place["id"]:
                database.drop_all()  # the store is a copy that has an id of its own now
                mark = None
            is_new = lease.check(mark, place, database, embedded=self._uri == EMBEDDED)
            if (is_new or mark is None or "index" not in mark) and self.may_write:
                mark = state.claim(place)
            self.index = "" if mark is None else str(mark.get("index", ""))
        return database

    def another(self) -> Database:
        """An additional connection; starts the embedded MongoDB if it is not running.

        Raises:
            DatabaseError: MongoDB does not answer, or the store does without.
        """
        from hybridlog.index import consent

        if self._uri is None:
            self._uri = consent.trusted_uri(
                self._directory.settings, self._directory.path, self.wanted
            )
        uri = self._uri
        if uri == NONE:
            self.has_none = True
            setting = "--mongo none" if self.wanted else f'mongo = "none" in {NAME}'
            raise WithoutMongoError(
                f"The store is used without MongoDB ({setting}). With --mongo embedded, or --mongo "
                "URI, a command uses one; `hybridlog index rebuild` makes its index."
            )
        from hybridlog_storage.mongo.database import Database

        timeout_s = _TIMEOUT_S
        if uri == EMBEDDED:
            from hybridlog_storage.mongo.mongod import EmbeddedMongod

            if self._mongod is None:
                cache_mb = self._cache_mb or _bounded_cache_mb(self._directory.settings.cache_mb)
                self._mongod = EmbeddedMongod(self._directory.mongod, cache_mb=cache_mb)
            try:
                uri = self._mongod.start()
            except StoreError as error:
                # A read-only store has no embedded MongoDB, but its segments can be read.
                self.has_none = True
                raise DatabaseError(str(error)) from error
            except (DatabaseError, MissingDependencyError, ResourceError) as error:
                self.has_none = not isinstance(error, DiskFullError)
                raise
            self.has_none = False
            timeout_s = _EMBEDDED_TIMEOUT_S
            if self._mongod.damage is not None:
                self.damage.append(self._mongod.damage)
        else:
            uri = with_password(uri)
        return Database.connect(uri, timeout_s=timeout_s)

    def address(self, wait_s: float) -> str:
        """The URI of the index for other programs; it stays the same. Has no password.

        Args:
            wait_s: Seconds for which an embedded MongoDB waits for clients.

        Raises:
            DatabaseError: MongoDB does not answer.
        """
        self.open()
        if self._mongod is not None:
            return self._mongod.publish(wait_s)
        assert self._uri is not None
        return re.sub(r"//([^:/@]*):[^/]*@", r"//\1@", self._uri)

    @property
    def place(self) -> str:
        """Description of the index's location; does not contact MongoDB."""
        if self.database is not None:
            return f"database {self.database.name} at {self.database.address}"
        uri = self.wanted or self._directory.settings.mongo or EMBEDDED
        if uri == EMBEDDED:
            return "the MongoDB that comes with hybridlog"
        if uri == NONE:
            return "none"
        from hybridlog_storage.mongo.database import without_secrets

        return without_secrets(uri)

    def close(self) -> None:
        """Disconnect; the embedded MongoDB ends when no process uses it."""
        if self._database is not None:
            self._database.close()
        self._database = None
        self.index = ""
        if self._mongod is not None:
            self._mongod.stop()
        self._mongod = None

    def take_over(self) -> None:
        """Record in the index that the store is at this location.

        Raises:
            DatabaseError: MongoDB does not answer.
            StoreError: the database holds the index of another store.
        """
        from hybridlog.maintenance import lease
        from hybridlog_storage.mongo.index_state import IndexState

        self.close()
        with self.another() as database:
            state = IndexState(database)
            place = lease.place_of(self._directory)
            lease.check(state.mark(), place, database, embedded=True)
            state.claim(place)


def _bounded_cache_mb(stored: int | None) -> int:
    """The size of the cache in a store's settings, at most half of the memory.

    The store may come from a larger machine, or from somebody else.
    """
    if stored is None:
        return MIN_CACHE_MB
    memory_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") >> 20
    return max(MIN_CACHE_MB, min(stored, memory_mb // 2))
