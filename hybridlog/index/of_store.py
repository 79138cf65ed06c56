"""The index of an open store, for its user: rebuild it, add fields to it, find it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from hybridlog.index.access import IndexAddress, again_if_lost
from hybridlog.query.query import Query
from hybridlog_storage.errors import TopicError, UsageError
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    from hybridlog.maintenance.report import ArraysOfTopic, Progress
    from hybridlog.opened import OpenStore
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.mongo.database import Database

# `list` is a method below.
_Entries: TypeAlias = "list[RecordingEntry]"
_FieldIndexes: TypeAlias = "list[FieldIndex]"
_Arrays: TypeAlias = "list[ArraysOfTopic]"
_CLIENTS_WAIT_S: Final = 600.0
"""Seconds for which a published MongoDB waits for clients."""
_OWN_FIELDS: Final = ("_meta.t", "_meta.pub", "_meta.inserted_at", "_meta.rec")
"""Fields that every index document has, in any topic."""
_MAX_FIELDS: Final = 8


class FieldIndex(NamedTuple):
    """An index of MongoDB on some fields of a topic.

    It changes the duration of a question and never its answer, so MongoDB alone has it, and
    `index rebuild` leaves it in place.

    Attributes:
        topic: Full name.
        fields: Fields in the order of the index.
    """

    topic: str
    fields: tuple[str, ...]


class Index:
    """The index of an open store.

    Args:
        shared: The open store.
    """

    def __init__(self, shared: OpenStore) -> None:
        self._shared = shared

    @again_if_lost
    def rebuild(
        self,
        recordings: Iterable[str | RecordingEntry] | None = None,
        progress: Progress | None = None,
    ) -> _Entries:
        """Rebuild the index from the segments, recording by recording.

        Args:
            recordings: The recordings; None for all, of an index that is emptied first.
            progress: Called after each chunk.

        Returns:
            The indexed recordings.

        Raises:
            StoreError: A named recording is being written.
        """
        from hybridlog.maintenance.derived import StoreIndex

        shared = self._shared
        database = shared.index.database_for("Rebuilding the index")
        shared.invalidate()
        chosen = shared.now().select(recordings)
        index = StoreIndex(shared.directory, shared.catalog, database, progress)
        if recordings is None:
            index.clear()
            shared.index.claim(database)
        left = index.rebuild(chosen)
        if recordings is not None and left:
            raise next(iter(left.values()))
        shared.invalidate()
        now = shared.now()
        found = (now.find(entry.id) for entry in chosen if entry.id not in left)
        return [entry for entry in found if entry is not None]

    @again_if_lost
    def add(self, topic: str, *fields: str) -> _FieldIndexes:
        """Add a MongoDB index on fields of a topic.

        Args:
            topic: Full name, short name, glob, or `re:` and a regular expression.
            fields: Fields of the messages, or `_meta.inserted_at` and the like. Filters
                should give a value or a range of the first one; the others narrow it down.

        Returns:
            All indexes of the topics.

        Raises:
            TopicError: A topic or field does not exist.
            DatabaseError: MongoDB refuses, for example because two fields are arrays.
        """
        query = self._about(topic)
        database = self._shared.index.database_for("An index")
        query.fields(*(name for name in fields if name not in _OWN_FIELDS))
        keys = _keys(fields)
        names = [*map(collection_of, query.topics)]
        for name in names:
            database.ensure_collection(name)
        database.run(lambda db: [db[name].create_index(keys) for name in names])
        return _indexes(database, query.topics)

    @again_if_lost
    def remove(self, topic: str, *fields: str) -> int:
        """Drop the index on exactly these fields; return the number of topics.

        Raises:
            TopicError: A topic does not exist.
        """
        query = self._about(topic)
        database = self._shared.index.database_for("An index")
        keys = _keys(fields)
        names = [*map(collection_of, query.topics)]
        names = [name for name in names if tuple(keys) in database.indexes(name)]
        for name in names:
            database.run(lambda db, name=name: db[name].drop_index(keys))  # type: ignore[misc]
        return len(names)

    @again_if_lost
    def list(self, *topics: str) -> _FieldIndexes:
        """The indexes on fields, of these topics or of all."""
        database = self._shared.index.database_for("Indexes")
        names = self._about(*topics).topics if topics else self._shared.now().topics_of()
        return _indexes(database, names)

    def arrays(self, *topics: str, off: bool = False, progress: Progress | None = None) -> _Arrays:
        """Keep long arrays in the tables of topics, beside their summaries.

        Predicates on elements of arrays, SQL and other readers of Parquet then read columns in
        place of messages. Of a PointCloud2 tables get the points, a list for each of their
        fields, for SQL and other readers. Arrays of bytes stay in the segments alone. The setting
        is kept in `hybridlog.toml`: new recordings follow it, and tables of ended ones are made
        anew. No MongoDB is needed.

        Args:
            topics: Topics, as for `topic`; the full name of one that no recording has yet.
            off: True for tables without arrays, as at first.
            progress: Called after each chunk.

        Returns:
            What was done for each topic, and the bytes of the tables of its type.

        Raises:
            UsageError: There is no topic, or one is no text.
            TopicError: No recording has a topic, and this is no full name.
            StoreError: The store cannot be written.
        """
        from hybridlog.maintenance.derived import index_arrays

        if not topics or not all(isinstance(name, str) for name in topics):
            raise UsageError('Name the topics one by one, as in store.index.arrays("scan", "tf").')
        shared = self._shared
        shared.directory.check_writable()
        shared.invalidate()
        names: dict[str, None] = {}
        for name in topics:
            try:
                names |= dict.fromkeys(self._about(name).topics)
            except TopicError:
                if not name.startswith("/") or {*name} & {*"*?[]"}:
                    raise
                names[name] = None
        session = shared.now()
        entries = [*map(session.entry_of, session.snapshot().having([*names]))]
        return index_arrays(
            shared.directory,
            shared.catalog,
            entries,
            [*names],
            shared.tables,
            off=off,
            progress=progress,
        )

    @again_if_lost
    def address(self) -> IndexAddress:
        """The address of the index for other programs, after it was brought up to date.

        The embedded MongoDB keeps its address, waits ten minutes for the first client, and runs
        as long as one is connected.

        Raises:
            DatabaseError: MongoDB is unavailable.
        """
        return self._shared.index.address(_CLIENTS_WAIT_S)

    def _about(self, *topics: str) -> Query:
        return Query(self._shared, self._shared.now().question(topics))


def _indexes(database: Database, topics: Iterable[str]) -> list[FieldIndex]:
    """The indexes of some topics, in the order of the topics, by fields."""
    return [
        FieldIndex(topic, tuple(field for field, _ in keys))
        for topic in topics
        for keys in database.indexes(collection_of(topic))
    ]


def _keys(fields: Sequence[str]) -> list[tuple[str, int]]:
    if not fields:
        raise UsageError("Name at least one field; `hybridlog info -t TOPIC` lists them.")
    if len(fields) > _MAX_FIELDS or len(set(fields)) != len(fields):
        raise UsageError(f"An index takes up to {_MAX_FIELDS} fields, without duplicates.")
    # Documents have no brackets: an index on an element is one on the array.
    return [(field.replace("[]", ""), 1) for field in fields]
