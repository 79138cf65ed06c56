"""The connection of a store to its index in MongoDB, made on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog_storage.errors import DatabaseError, StoreError
from hybridlog_storage.settings import EMBEDDED, with_password

if TYPE_CHECKING:
    from hybridlog_storage.database import Database
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.mongod import EmbeddedMongod


class Connection:
    """Starts and connects to the MongoDB that holds the index of a store.

    Args:
        directory: The store.
        mongo: URI of the MongoDB, or `embedded`; None for the one in the store's settings.

    Attributes:
        database: The index; None without a connection.
    """

    def __init__(self, directory: StoreDirectory, mongo: str | None) -> None:
        self.database: Database | None = None
        self._directory = directory
        self._wanted = mongo
        self._uri: str | None = None
        self._mongod: EmbeddedMongod | None = None

    def open(self) -> Database:
        """Connect, and check that the database belongs to this store.

        Raises:
            DatabaseError: MongoDB does not answer.
            StoreError: it holds the index of another store, or this store is a copy.
        """
        from hybridlog.maintenance import lease
        from hybridlog_storage.index_state import IndexState

        if self.database is None:
            self.database = self.another()
            state = IndexState(self.database)
            place = lease.place_of(self._directory)
            if lease.check(state.mark(), place, self.database, embedded=self._uri == EMBEDDED):
                state.claim(place)
        return self.database

    def another(self) -> Database:
        """An additional connection; starts the embedded MongoDB if it is not running.

        Raises:
            DatabaseError: MongoDB does not answer.
        """
        from hybridlog import consent
        from hybridlog_storage.database import Database

        if self._uri is None:
            self._uri = self._wanted or consent.trusted_uri(
                self._directory.settings, self._directory.path
            )
        uri = self._uri
        if uri == EMBEDDED:
            from hybridlog_storage.mongod import EmbeddedMongod

            self._mongod = self._mongod or EmbeddedMongod(self._directory.mongod)
            try:
                uri = self._mongod.start()
            except StoreError as error:
                # A read-only store has no embedded MongoDB, but its segments can be read.
                raise DatabaseError(str(error)) from error
        else:
            uri = with_password(uri)
        return Database.connect(uri)

    @property
    def place(self) -> str:
        """Description of the index's location; does not contact MongoDB."""
        if self.database is not None:
            return f"database {self.database.name} at {self.database.address}"
        uri = self._wanted or self._directory.settings.mongo or EMBEDDED
        if uri == EMBEDDED:
            return "the MongoDB that comes with hybridlog"
        from hybridlog_storage.database import without_secrets

        return without_secrets(uri)

    def close(self) -> None:
        """Disconnect; the embedded MongoDB ends when no process uses it."""
        if self.database is not None:
            self.database.close()
        self.database = None
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
        from hybridlog_storage.index_state import IndexState

        self.close()
        with self.another() as database:
            state = IndexState(database)
            place = lease.place_of(self._directory)
            lease.check(state.mark(), place, database, embedded=True)
            state.claim(place)
