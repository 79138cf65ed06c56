"""Resolves the time range of a question in each recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from hybridlog.query.intervals import span_of
from hybridlog.query.times import TIME_LIMIT, format_time, parse_range, parse_time
from hybridlog_storage.errors import TimeError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.query.question import Clock, Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry


class RangeResolver:
    """Turns relative and absolute times into nanoseconds, one recording at a time.

    Args:
        session: The open store.
        question: The question.
    """

    def __init__(self, session: Session, question: Question) -> None:
        self._session = session
        self._question = question

    def resolve(self) -> list[tuple[RecordingEntry, Span | None, NDArray[np.int64] | None]]:
        """Each recording with its bounds on the question's clock and its windows of log time.

        Raises:
            TimeError: the range is empty, or outside all recordings.
        """
        question = self._question
        found = []
        outside: list[tuple[RecordingEntry, Span]] = []
        for recording in self._session.chosen(question.recordings):
            bounds = self.bounds_in(recording)
            if bounds is not None and self._is_outside(bounds, recording):
                outside.append((recording, bounds))
                continue
            windows = None
            if question.during is not None:
                windows = question.during.of_recording(recording.id)
                if not len(windows):
                    continue
            found.append((recording, bounds, windows))
        if outside and not found and question.during is None:
            self._refuse(outside)
        return found

    def spans(self) -> list[tuple[RecordingEntry, Span]]:
        """The log time `[begin, end)`, ns, of each recording of the question.

        Raises:
            TimeError: the range is empty, or outside all recordings.
            UsageError: the range refers to another clock.
        """
        question = self._question
        if not question.is_by_log_time:
            raise UsageError(
                f"Intervals use log time; a range cannot use the {question.clock} clock."
            )
        found: list[tuple[RecordingEntry, Span]] = []
        for recording, bounds, windows in self.resolve():
            if recording.span is None:
                continue
            start, end = span_of(recording)
            if bounds is not None:
                start, end = max(start, bounds[0]), min(end, bounds[1])
            if windows is None:
                if start < end:
                    found.append((recording, (start, end)))
                continue
            found.extend(
                (recording, (max(start, low), min(end, high)))
                for low, high in windows.tolist()
                if low < end and high > start
            )
        return found

    def beginnings(self) -> Iterator[tuple[RecordingEntry, int]]:
        """Recordings that begin before the range does, and the beginning of the range, ns."""
        if self._question.clock != "log" and self._question.bounds is not None:
            return
        seen: set[str] = set()
        for recording, (begin, _) in self.spans():
            if recording.id not in seen and span_of(recording)[0] < begin:
                yield recording, begin
            seen.add(recording.id)

    def bounds_in(self, recording: RecordingEntry) -> Span | None:
        """The range in one recording, ns; None for all times.

        It may be empty: for example `2025-01-01` to `end`, in a recording of 2024.
        """
        if self._question.bounds is None:
            return None
        start, end = self._clock_span(recording)
        begin, stop = self._question.bounds
        return (
            0 if begin is None else parse_time(begin, start=start, end=end),
            TIME_LIMIT - 1 if stop is None else parse_time(stop, start=start, end=end),
        )

    def _clock_span(self, recording: RecordingEntry) -> Span:
        """`[first, end)` of the question's topics, on the question's clock."""
        clock: Clock = self._question.clock
        if clock == "log":
            return span_of(recording)
        stats = [c.stats for c in recording.channels if c.topic in self._question.topics]
        pairs = [
            (s.first_publish, s.last_publish)
            if clock == "publish"
            else (s.first_stamp, s.last_stamp)
            for s in stats
        ]
        known = [(first, last) for first, last in pairs if first is not None and last is not None]
        if not known:
            return span_of(recording)
        first, last = min(low for low, _ in known), max(high for _, high in known)
        return max(first, 0), min(last + 1, TIME_LIMIT - 1)

    def _is_outside(self, bounds: Span, recording: RecordingEntry) -> bool:
        """True if a range is empty, or does not overlap the recording on the log clock."""
        start, end = span_of(recording)
        beside = self._question.clock == "log" and (bounds[0] >= end or bounds[1] <= start)
        return beside or bounds[0] >= bounds[1]

    def _refuse(self, outside: Sequence[tuple[RecordingEntry, Span]]) -> None:
        """Refuse a range that overlaps no recording.

        Raises:
            TimeError: it ends before it begins, or is outside all recordings.
        """
        assert self._question.bounds is not None
        begin, stop = self._question.bounds
        spans = []
        for recording, (low, high) in outside:
            start, end = self._clock_span(recording)
            # `2025-01-01` to `end` is no mistake: the recording simply ends before.
            if low < high or low == start or high == end:
                spans.append(f"{recording.label} spans {format_time(start)} to {format_time(end)}")
        if not spans:
            start, end = self._clock_span(outside[0][0])
            parse_range(begin, stop, start=start, end=end)
        raise TimeError(f"Nothing was recorded between {begin} and {stop}: {'; '.join(spans[:5])}.")
