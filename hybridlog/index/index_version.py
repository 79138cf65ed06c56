"""Protects answers from MongoDB against changes of the index by other processes.

Another process may remove a recording or rebuild its index at any time. It announces this
in the database before it removes the first document. After each answer, a small query of
one document therefore looks for announcements. Before the first answer, the index is
checked to be complete for the recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from hybridlog_storage.errors import IndexChangedError
from hybridlog_storage.mongo.index_state import IndexState

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.mongo.index_state import Progressed

_Filter = Mapping[str, object]


@dataclass(frozen=True)
class IndexVersion:
    """State of the index at some time.

    Attributes:
        turn: Number of announced removals of documents of any recording.
        recordings: Progress of each recording, by key; None if it is not in the
            index. Read after `turn`.
    """

    turn: int
    recordings: Mapping[str, Progressed | None]

    @classmethod
    def of(
        cls, database: Database, keys: Collection[str], before: IndexVersion | None
    ) -> IndexVersion:
        """The current state for some recordings, and for those in an earlier state."""
        state = IndexState(database)
        if before is not None and before.recordings.keys() >= set(keys):
            return before
        # What is read after this is as new as this, whichever member is the primary by now.
        turn = state.turn(read="linearizable")
        known = before.recordings if before is not None and before.turn == turn else {}
        missing = set(keys) - known.keys()
        return cls(turn, {**known, **dict.fromkeys(missing), **state.progress(missing)})

    def problem(self, entry: RecordingEntry) -> str | None:
        """The reason why the index cannot answer for a recording; None if it can."""
        found = self.recordings[entry.key]
        if found is None:
            gone = f"Recording {entry.label!r} was removed from the index by another process."
            return None if entry.status == "open" else f"{gone} Ask again."
        if entry.status == "open" or entry.digests.items() <= dict(found.segments).items():
            return None
        return (
            f"The index of recording {entry.label!r} is not complete: another process changes it "
            "at this moment, or the store is read-only. Questions by topic and time are answered "
            "all the same."
        )


class ReadVersion(Protocol):
    """Reads the state of the index of some recordings."""

    def __call__(
        self, database: Database, keys: Collection[str], *, anew: bool = False
    ) -> IndexVersion:
        """Read it."""


class GuardedIndex:
    """Queries the index about some recordings. Thread safe.

    The methods are those of `Database`, and raise the same errors.

    Args:
        database: The index.
        entries: The recordings.
        read: Reads the state of the index of recordings, given by key; with `anew`, from
            the database.
        on_change: Called when another process has changed the index.

    Raises:
        IndexChangedError: some documents of these recordings are missing.
    """

    def __init__(
        self,
        database: Database,
        entries: Sequence[RecordingEntry],
        read: ReadVersion,
        on_change: Callable[[], None],
    ) -> None:
        self.database = database
        self._read = read
        self._on_change = on_change
        self._entries = entries
        self._keys = {entry.key for entry in entries}
        self._version = read(database, self._keys)
        self._refuse(self._version)

    def count_each(self, questions: Sequence[tuple[str, _Filter]]) -> list[int]:
        """Numbers of documents that match each of many questions."""
        found = self.database.count_each(questions)
        self._check()
        return found

    def find_raw(self, collection: str, *args: Any, **options: Any) -> Iterator[bytes]:
        """Documents as bytes, many in one item."""
        return self._each(self.database.find_raw(collection, *args, **options))

    def find_each(
        self, questions: Sequence[tuple[str, _Filter]], projection: _Filter
    ) -> Iterator[bytes]:
        """Documents of many questions, one after the other, in the form of `find_raw`."""
        return self._each(self.database.find_each(questions, projection))

    def _each(self, found: Iterator[bytes]) -> Iterator[bytes]:
        """Verified items: each is yielded once the next item or the end has been received."""
        previous: bytes | None = None
        for item in found:
            if previous is not None:
                self._check()
                yield previous
            previous = item
        self._check()
        if previous is not None:
            yield previous

    def _check(self) -> None:
        """Check that the index was not changed during the query.

        Raises:
            IndexChangedError: it may have changed; the store's knowledge of it is refreshed.
        """
        if IndexState(self.database).turn() == self._version.turn:
            return
        before = self._version
        self._version = self._read(self.database, self._keys, anew=True)
        self._refuse(self._version)
        for entry in self._entries:
            then, now = before.recordings[entry.key], self._version.recordings[entry.key]
            if then is not None and (now is None or now.turn != then.turn):
                self._on_change()
                raise IndexChangedError(
                    f"The index of recording {entry.label!r} was changed by another process "
                    "while it was asked. Ask again."
                )

    def _refuse(self, version: IndexVersion) -> None:
        for entry in self._entries:
            problem = version.problem(entry)
            if problem is not None:
                self._on_change()
                raise IndexChangedError(problem)
