"""Regularity of topics: rates, gaps, jitter, late starts, losses."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog.query.answers.lost import completeness_of, flush_interval_ns
from hybridlog.query.answers.rates import Rates
from hybridlog.query.latching import depth_of
from hybridlog.query.periods import Regularity
from hybridlog.query.ranges import RangeResolver
from hybridlog.record.losses import topics_of

if TYPE_CHECKING:
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary


@dataclass(frozen=True, slots=True)
class TopicCheck:
    """Regularity of a topic in a recording, or in a range of it.

    Attributes:
        recording: Name of the recording.
        topic: Full name.
        type: Type of the messages; several have commas between them.
        begin_ns: Beginning of the recording or the range.
        messages: Number of messages.
        rate_hz: Mean rate from the first message to the last; None of fewer than two.
        period_ns: Usual time from one message to the next, which nine of ten do not exceed.
        jitter_ns: Standard deviation of the times from one message to the next.
        gap_ns: Longest time from one message to the next.
        gap_begin_ns: Beginning of this time.
        late_ns: Time from the beginning to the first message; None without messages.
        early_ns: Time from the last message to the end; None without messages.
        lost: Messages lost, as far as the ledger names the topic; None for an unknown number.
        is_latched: The last message holds until the next: nothing starts late or stops early.
    """

    recording: str
    topic: str
    type: str
    begin_ns: int
    messages: int
    rate_hz: float | None = None
    period_ns: float | None = None
    jitter_ns: float | None = None
    gap_ns: int | None = None
    gap_begin_ns: int | None = None
    late_ns: int | None = None
    early_ns: int | None = None
    lost: int | None = 0
    is_latched: bool = False

    @property
    def silent_periods(self) -> float:
        """Longest time without a message in usual periods; 0 where a period is not known.

        A late start and an early stop are such times, and without messages it is infinite.
        """
        if not self.messages:
            return math.inf
        ends = (0, 0) if self.is_latched else (self.late_ns or 0, self.early_ns or 0)
        return max(self.gap_ns or 0, *ends) / self.period_ns if self.period_ns else 0.0


def check(session: Session, question: Question, counters: Counters) -> list[TopicCheck]:
    """Regularity of topics, the worst first; see `Query.check`."""
    lost: dict[tuple[str, str], list[int | None]] = defaultdict(list)
    for row in completeness_of(session, question).rows:
        lost[row["recording"], row["topic"]].append(row["count"])
    rates = Rates(session, question, counters)
    found = []
    for summary, span in _spans(session, question):
        stretches = {one.topic: one for one in rates.stretches_in(summary, span)}
        for topic in sorted({*question.topics} & topics_of(session.entry_of(summary))):
            measured = Regularity()
            if topic in stretches:
                for times in rates.times(stretches[topic]):
                    measured.add(times)
            counts = lost[summary.name, topic]
            found.append(_check(session, summary, span, topic, measured=measured, lost=counts))
    return sorted(
        found, key=lambda one: (one.silent_periods, one.lost is None, one.lost or 0), reverse=True
    )


def _spans(session: Session, question: Question) -> Iterator[tuple[RecordingSummary, Span]]:
    """The log time of each recording of a question, also of those without messages."""
    resolver = RangeResolver(session, question)
    yield from resolver.spans()
    for recording, bounds, windows in resolver.resolve():
        if recording.span is None and bounds is None and windows is None:
            yield recording, (0, 0)


def _check(
    session: Session,
    summary: RecordingSummary,
    span: Span,
    topic: str,
    *,
    measured: Regularity,
    lost: Sequence[int | None],
) -> TopicCheck:
    channels = [one.channel for one in session.channels_of(session.entry_of(summary), [topic])]
    begin, end = span
    if summary.status == "open":  # other topics may be flushed later than this one
        end = max(begin, end - flush_interval_ns(summary))
    some = measured.messages > 0
    return TopicCheck(
        summary.name,
        topic,
        ", ".join(sorted({one.schema.name for one in channels if one.schema is not None})),
        begin,
        measured.messages,
        measured.rate_hz,
        measured.period_ns,
        measured.jitter_ns,
        measured.gap[1] - measured.gap[0] if measured.messages > 1 else None,
        measured.gap[0] if measured.messages > 1 else None,
        measured.first - begin if some else None,
        max(end - 1 - measured.last, 0) if some else None,
        None if None in lost else sum(count or 0 for count in lost),
        any(map(depth_of, channels)),
    )
