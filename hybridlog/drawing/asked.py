"""The part of `Query` that drawing uses. `Query` imports drawing, not the other way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol, Self

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.query.counters import Counters
    from hybridlog.query.intervals import Intervals
    from hybridlog.query.question import Question, Span
    from hybridlog_storage.summary import RecordingSummary


class Asked(Protocol):
    """A query; its methods are described there."""

    question: Question
    counters: Counters

    @property
    def topics(self) -> tuple[str, ...]:
        """Full names of the topics."""

    def fields(self, *paths: str) -> Self:
        """Only these fields."""

    def with_topic(self, topic: str) -> Self:
        """Only this topic."""

    def in_recording(self, *names: str) -> Self:
        """Only these recordings."""

    def during(self, intervals: Intervals) -> Self:
        """Only messages in these intervals."""

    def field_types(self) -> dict[str, str] | None:
        """Paths of fields and their types."""

    def summaries(self) -> Sequence[RecordingSummary]:
        """The recordings."""

    def spans(self) -> dict[str, Span]:
        """Log time of the messages of each recording, by id."""

    def to_tables(self) -> Iterator[pa.Table | Any]:
        """The answer in tables."""
