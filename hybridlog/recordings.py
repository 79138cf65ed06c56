"""Recordings that were chosen from a store, and queries about them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, overload

from hybridlog.query.query import Query
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError

if TYPE_CHECKING:
    from hybridlog.session import Asked
    from hybridlog_storage.catalog import RecordingEntry, RecordingSummary


class Recordings(Sequence["RecordingEntry"]):
    """Some recordings of an open store, oldest first; each entry is read when it is accessed.

    Args:
        source: The open store, or one moment of it.
        summaries: The recordings in short.
        problem: The reason why there is none.

    Attributes:
        summaries: The recordings in short.
    """

    def __init__(
        self, source: Asked, summaries: Iterable[RecordingSummary], problem: str = ""
    ) -> None:
        self.summaries = tuple(summaries)
        self._source = source
        self._problem = problem

    def __len__(self) -> int:
        return len(self.summaries)

    @overload
    def __getitem__(self, index: int) -> RecordingEntry: ...

    @overload
    def __getitem__(self, index: slice) -> Recordings: ...

    def __getitem__(self, index: int | slice) -> RecordingEntry | Recordings:
        """The entry of a recording by position, or some of the recordings."""
        if isinstance(index, slice):
            return Recordings(self._source, self.summaries[index], self._problem)
        return self._source.now().entry_of(self.summaries[index])

    def __iter__(self) -> Iterator[RecordingEntry]:
        """The entries, without those of recordings that were removed meanwhile."""
        return self._source.now().entries(self.summaries)

    def __eq__(self, other: object) -> bool:
        """True for the same recordings, also as a list of entries."""
        if isinstance(other, Recordings):
            return self.ids == other.ids
        return [*self] == other if isinstance(other, list) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"<Recordings {listed((one.name for one in self.summaries), 5)}>"

    def _repr_html_(self) -> str:
        """The recordings in a notebook."""
        from hybridlog.drawing.notebook import recordings_html

        return recordings_html("Recordings", self.summaries)

    @property
    def ids(self) -> tuple[str, ...]:
        """Their ids."""
        return tuple(summary.id for summary in self.summaries)

    @property
    def names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(summary.name for summary in self.summaries)

    def check(self) -> Recordings:
        """These recordings.

        Raises:
            TopicError: There is none; names the condition that no recording satisfies.
        """
        if not self.summaries:
            raise TopicError(self._problem or self._source.now().when_empty)
        return self

    def topics(self, *types: str) -> list[str]:
        """Names of their topics, sorted, also of some types alone; as of `Store.topics`."""
        from hybridlog.query.choice import topics_of_types

        session = self._source.now()
        return topics_of_types(session, types, self.ids) if types else session.topics_of(self.ids)

    def topic(self, *names: str) -> Query:
        """Make a query about topics of these recordings.

        Args:
            names: As for `Store.topic`, among the topics of these recordings: a short name
                that is ambiguous in the store may be clear in them.

        Raises:
            TopicError: There is no recording; or a name matches no topic, or several.
        """
        return Query(self._source, self._source.now().question(names, self.check().ids))

    def all_topics(self) -> Query:
        """Make a query about all topics of these recordings.

        Raises:
            TopicError: There is no recording.
        """
        session = self._source.now()
        ids = self.check().ids
        return Query(self._source, session.about(session.topics_of(ids), ids))
