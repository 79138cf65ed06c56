"""Resolves the time range of a question in each recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.query.question import windows_in
from hybridlog.query.times import (
    format_time,
    is_early,
    is_relative,
    parse_range,
    parse_time,
)
from hybridlog.wording import listed
from hybridlog_storage.errors import TimeError, UsageError
from hybridlog_storage.times import BEGIN, END, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question, RecordedChannel, Span
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

_MAX_NAMES = 5  # recordings in a message
_MAX_LOOKED_AT = 100
_FAR_NS = 10 * 365 * 86_400 * 10**9


class Resolved(NamedTuple):
    """The share of a question that one recording has.

    Attributes:
        bounds: `[begin, end)` on the question's clock, ns; None for all times.
        windows: int64[n, 2], `[begin, end)` of log time, disjoint, in order; None for all times.
    """

    summary: RecordingSummary
    bounds: Span | None
    windows: NDArray[np.int64] | None


class RangeResolver:
    """Turns relative and absolute times into nanoseconds, one recording at a time."""

    def __init__(self, session: Session, question: Question) -> None:
        self._session = session
        self._question = question

    def resolve(self) -> list[Resolved]:
        """The recordings to ask, oldest first; without reading their entries."""
        question, during = self._question, self._question.during
        chosen = self._session.summaries_of(question)
        if during is not None:
            named = {*during.recordings}
            chosen = [one for one in chosen if one.id in named]
        found: list[tuple[RecordingSummary, Span | None]] = [(one, None) for one in chosen]
        if question.bounds is not None:
            shared = self._shared_bounds()
            spans = [(one, shared or self.bounds_in(one)) for one in chosen]
            found = [(one, span) for one, span in spans if not self._is_outside(span, one)]
            if chosen and not found and during is None:
                self._refuse(chosen)
            self._check_begin([one.extent[0] for one, _ in found])
        return [
            Resolved(one, span, None if during is None else during.of_recording(one.id))
            for one, span in found
        ]

    def _check_begin(self, first: Sequence[int]) -> None:
        """Refuse a range that begins far before any first message of the recordings, ns."""
        assert self._question.bounds is not None
        begin, _ = self._question.bounds
        if self._question.clock != "log" or not is_early(begin) or not first:
            return
        at = parse_time(begin, start=None, end=None)
        if min(first) - at > _FAR_NS:
            raise TimeError(
                f"{begin} is {format_time(at)}, long before any message; +{begin} is that long "
                "after the beginning of a recording."
            )

    def _shared_bounds(self) -> Span | None:
        """The range by the log clock if it is the same in each recording, ns."""
        assert self._question.bounds is not None
        begin, stop = self._question.bounds
        if self._question.clock != "log" or is_relative(begin) or is_relative(stop):
            return None
        return (
            BEGIN if begin is None else parse_time(begin, start=None, end=None),
            END if stop is None else parse_time(stop, start=None, end=None),
        )

    def spans(self) -> list[tuple[RecordingSummary, Span]]:
        """The log time `[begin, end)`, ns, of each recording of the question."""
        question = self._question
        if not question.is_by_log_time:
            raise UsageError(
                f"Intervals use log time; a range cannot use the {question.clock} clock."
            )
        found: list[tuple[RecordingSummary, Span]] = []
        for recording, bounds, windows in self.resolve():
            if recording.span is not None:
                inside = windows_in(windows_in(windows, bounds), recording.extent)
                found += [(recording, (low, high)) for low, high in inside.tolist()]
        return found

    def beginnings(self) -> Iterator[tuple[RecordingSummary, int]]:
        """Recordings that begin before the range does, and the beginning of the range, ns."""
        seen: set[str] = set()
        for recording, (begin, _) in self.spans():
            if recording.id not in seen and recording.extent[0] < begin:
                yield recording, begin
            seen.add(recording.id)

    def bounds_in(self, recording: RecordingSummary) -> Span:
        """The range in one recording, ns.

        It may be empty: for example `2025-01-01` to `end`, in a recording of 2024.
        """
        assert self._question.bounds is not None
        start, end = self._clock_span(recording)
        begin, stop = self._question.bounds
        return (
            BEGIN if begin is None else parse_time(begin, start=start, end=end),
            END if stop is None else parse_time(stop, start=start, end=end),
        )

    def _clock_span(self, summary: RecordingSummary) -> Span:
        """`[first, end)` of the question's topics, on the question's clock."""
        if self._question.clock == "log":
            return summary.extent
        entry = self._session.entry_of(summary)
        channels = self._session.channels_of(entry, {*self._question.topics})
        ends = [time for channel in channels for time in self._ends(channel)]
        return span_of(min(ends), max(ends)) if ends else summary.extent

    def _ends(self, channel: RecordedChannel) -> Iterator[int]:
        """First and last time of a channel on the question's clock, perhaps of each chunk.

        Where its statistics do not have them, the messages are read.
        """
        recording, stats = channel.recording, channel.stats
        number = channel.channel_id
        if self._question.clock == "publish":
            if channel.channel.has_publish_time:
                for segment, _, _ in recording.spans_with([number]):
                    parts = self._session.chunk_table(recording, segment).parts
                    own = parts[parts["channel"] == number]
                    yield from own["first_publish"].tolist()
                    yield from own["last_publish"].tolist()
            return
        if recording.is_decoded:
            known = stats.first_stamp, stats.last_stamp
            yield from (time for time in known if time is not None)
            return
        for chunk in self._session.chunks(recording, [number], None, "log"):
            from hybridlog.schema.codec import stamps_of

            batch = self._session.read_chunk(recording, chunk.segment, chunk.place).batch
            batch = batch.take(np.flatnonzero(batch.channel == number))
            times = stamps_of(channel.codec, batch)[1]
            yield from (int(times.min()), int(times.max())) if len(times) else ()

    def _is_outside(self, bounds: Span, recording: RecordingSummary) -> bool:
        """True if a range is empty, or does not overlap the recording on the log clock."""
        start, end = recording.extent
        beside = self._question.clock == "log" and (bounds[0] >= end or bounds[1] <= start)
        return beside or bounds[0] >= bounds[1]

    def _refuse(self, chosen: Sequence[RecordingSummary]) -> None:
        """Refuse a range that overlaps no recording."""
        assert self._question.bounds is not None
        begin, stop = self._question.bounds
        spans = [self._clock_span(one) for one in chosen[:_MAX_LOOKED_AT]]
        start, end = min(low for low, _ in spans), max(high for _, high in spans)
        parse_range(begin, stop, start=start, end=end)
        names = listed((one.name for one in chosen), _MAX_NAMES)
        raise TimeError(
            f"Nothing was recorded between {begin} and {stop}: {names} spans {format_time(start)} "
            f"to {format_time(end)}."
        )
