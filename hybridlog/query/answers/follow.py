"""Messages of running recordings, as they are flushed.

The chunks of a recording only grow in number, whether its segments are sealed meanwhile or not,
and each is read once. So each message comes once, also one with an earlier log time than others.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from hybridlog.message import Message, messages_in
from hybridlog.query.answers.completeness import flush_interval_ns
from hybridlog.query.answers.current import picture_of
from hybridlog.query.chunk_columns import Chunk, ChunkColumns
from hybridlog.query.chunk_scan import MessageRun, RecordingScan
from hybridlog.query.planner import Planner, Resolved, bounds_in, resolved
from hybridlog.query.question import Counters, Part, Question, Span, windows_in
from hybridlog.query.topics import later
from hybridlog.record.marks import MARKS_SEGMENT, without_marks
from hybridlog_storage.errors import UsageError
from hybridlog_storage.stopping import pause, safe_point

if TYPE_CHECKING:
    from hybridlog.session import Asked, Session
    from hybridlog_storage.catalog import RecordingEntry, RecordingSummary

_EVERY_S: Final = 0.25


class Arrivals(Planner):
    """The messages of running recordings that have come since the last look.

    `takes` tells whether a topic that appears later is part of the question. By recording, `read`
    counts chunks that were read by segment, and `sealed` has segments that were read to their end.
    """

    def __init__(
        self, session: Session, question: Question, counters: Counters, takes: Callable[[str], bool]
    ) -> None:
        super().__init__(session, question, counters)
        self._chunks: dict[str, list[Chunk]] = {}  # that have just come, by recording
        self._takes = takes
        self._bounds: dict[str, Span] = {}
        recordings = question.recordings or ()
        self.read = {one: Counter[int]() for one in recordings}
        self.sealed: dict[str, set[int]] = {one: set() for one in recordings}
        self._marks: set[str] = set()  # ids of those that were read

    def look(self, session: Session) -> tuple[Iterator[MessageRun], bool]:
        """The messages that have come since the last look, and whether more will."""
        self.session = session
        summaries = session.summaries_of(self.question)
        known = session.snapshot().topics_of(summaries)
        new = [t for t in known if t not in self.question.topics]
        topics = (*self.question.topics, *filter(self._takes, new))
        self.question = replace(self.question, topics=topics)
        parts: list[Part] = []
        for one in summaries:
            entry = session.entry_of(one)
            if self.question.bounds and one.span is not None and one.id not in self._bounds:
                # The beginning that a time may be relative to is known now.
                self._bounds[one.id] = bounds_in(session, self.question, one)
            bounds = self._bounds.get(one.id)
            span = bounds if self.question.is_by_log_time else None
            self._chunks[one.id] = chunks = [*self._arrivals(entry, span)]
            ranges = (None, bounds) if span is None else (windows_in(None, span), None)
            parts += self.parts_in(one, *ranges) if chunks else ()
        return self.scan(parts).runs(), any(map(self._goes_on, summaries))

    @property
    def resolved(self) -> list[Resolved]:
        """The recordings, whatever the range is: it may have no beginning yet."""
        return resolved(self.session, replace(self.question, bounds=None))

    def tabled(self, part: Part, fields: Collection[str] | None = ()) -> None:
        """No tables: they have older messages, too."""

    def _scan(self, part: Part, indexes: dict[int, int]) -> RecordingScan:
        """Reads only the chunks that have just come."""
        new = self._chunks[part.recording.id]
        chunks = [chunk for chunk in new if not indexes.keys().isdisjoint(chunk.place.channels)]
        return RecordingScan(part.recording, indexes, chunks, part.windows)

    def _goes_on(self, one: RecordingSummary) -> bool:
        """True if more messages of the question may come."""
        bounds = self._bounds.get(one.id)
        is_past = False
        if bounds is not None and one.span is not None and self.question.clock == "log":
            is_past = one.span[1] - flush_interval_ns(one) >= bounds[1]
        return one.status == "open" and not is_past

    def _arrivals(self, entry: RecordingEntry, span: Span | None) -> Iterator[Chunk]:
        """The chunks that have come since the last call, and may have messages in a log time."""
        read, sealed = self.read[entry.id], self.sealed[entry.id]
        sealed &= _sealed(entry)
        for segment in sorted((_sealed(entry) | entry.flushed.keys()) - {*sealed, MARKS_SEGMENT}):
            flushed = entry.flushed.get(segment)
            table = flushed.table if flushed else self.session.chunk_table(entry, segment)
            columns = ChunkColumns(segment, table)
            is_new = columns.number >= read[segment]
            yield from columns.chunks(is_new & columns.within(span))
            read[segment] = len(table.chunks)
            if flushed is None:
                sealed.add(segment)
                del read[segment]
        if entry.manifest.marks:
            entry = without_marks(entry, self._marks)
            self.session.show(entry)
            self._marks.update(mark.id for mark in entry.manifest.marks)
            columns = ChunkColumns(MARKS_SEGMENT, entry.flushed[MARKS_SEGMENT].table)
            yield from columns.chunks(columns.within(span))


class Following(Arrivals, Iterator["Message"]):
    """The messages of running recordings as they come; waits for the next one.

    Args:
        source: The open store.
        question: The question; without a time range, about what is flushed from now on.
        counters: Count what is read.
        names: The topics as they were written; globs take topics that appear later.

    Raises:
        UsageError: No recording of the question is running, or it asks for what is not known
            before the end; or a snapshot is asked, in which nothing comes.
    """

    def __init__(
        self, source: Asked, question: Question, counters: Counters, names: Sequence[str]
    ) -> None:
        question, wanted = _checked(question), question.recordings
        session = source.now()
        if session is source:
            raise UsageError("In a snapshot nothing new is seen: follow in the store itself.")
        running = [
            session.entry_of(one)
            for one in session.look(wanted).summaries
            if one.status == "open" and (wanted is None or one.id in wanted)
        ]
        if not running:
            raise UsageError(
                "Only a running recording can be followed, and none of those asked about is."
            )
        ids = tuple(entry.id for entry in running)
        named = question.names_recording or len(running) > 1
        question = replace(question, recordings=ids, names_recording=named)
        super().__init__(session, question, counters, later(names))
        self._source = source
        for entry in running if question.bounds is None else ():
            self.sealed[entry.id] |= _sealed(entry)
            _ = [*self._arrivals(entry, None)]
        _ = self.examples, self.ranks  # of this moment
        self._messages = (
            message for run in self.runs() for message in messages_in(run, picture_of(self.session))
        )

    def __next__(self) -> Message:
        """The next message; ends with the recordings."""
        return next(self._messages)

    def _runs(self) -> Iterator[MessageRun]:
        goes_on = True
        while goes_on:
            started = time.monotonic()
            runs, goes_on = self.look(self._source.now())
            for run in runs:
                yield run
                safe_point()
            if goes_on:
                pause(max(_EVERY_S - (time.monotonic() - started), 0))


def _sealed(entry: RecordingEntry) -> set[int]:
    """Numbers of the sealed segments of a running recording."""
    return {*map(int, entry.digests)}


def _checked(question: Question) -> Question:
    """The question without an end; refuses what is only known when a recording has ended."""
    begin, stop = question.bounds or (None, None)
    word = str(stop).strip().lower()
    for is_used, problem in (
        (question.reverse, "has no last message to begin with"),
        (question.during is not None, "has no intervals to follow: they are those of one moment"),
        (
            question.predicate is not None and question.predicate.filters,
            "is not in MongoDB yet: write a predicate instead of a MongoDB filter",
        ),
        (word.startswith("-"), f"has no end to count {stop} from"),
    ):
        if is_used:
            raise UsageError(f"What is still recorded {problem}.")
    return replace(question, bounds=(begin, None)) if word == "end" else question
