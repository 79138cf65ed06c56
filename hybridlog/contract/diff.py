"""Differences between two recordings, or two choices of them."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from hybridlog.query.times import TimeLike, format_duration
from hybridlog.query.topics import resolve
from hybridlog.record.marks import MARKS
from hybridlog.wording import Rows, counted

if TYPE_CHECKING:
    from hybridlog.query.answers.statistics import FieldStatistics, TopicCheck
    from hybridlog.recordings import Recordings

Value = float | str | None
Range = tuple["TimeLike | None", "TimeLike | None"]
_LEAST_SHARE: Final = 0.01
"""Of the longer recording: only a difference in length above that is one of times."""
_ENDS: Final = ("late_start", "early_stop")
_COUNTED: Final = re.compile(r"(.*\.)?(seq|sequence|stamp(\..*)?)")
"""Fields that differ between any two recordings: counters and stamps."""
_STATISTICS: Final = ("count", "nan", "infinite", "min", "max", "mean", "std")


class Difference(Struct, frozen=True):
    """Something that differs.

    Attributes:
        topic: Full name of the topic; empty for the whole recording.
        what: `times`, `topic`, `type`, `messages`, `rate`, `longest_gap`, `jitter`, `late_start`,
            `early_stop`, `lost`, or the path of a field.
        a: What the first choice has, in words; empty if it has no such thing.
        b: The same for the second one.
        share: How far numbers differ, as a share of the greater one; None for other things.
    """

    topic: str
    what: str
    a: str
    b: str
    share: float | None = None


class _Side:
    """Figures of some recordings together, to be compared."""

    def __init__(
        self, recordings: Recordings, topics: Collection[str], between: Range | None
    ) -> None:
        self.topics: dict[str, list[TopicCheck]] = defaultdict(list)
        self.fields: dict[str, dict[str, FieldStatistics]] = defaultdict(dict)
        # Marks are about a recording, and not of it.
        known = [one for one in recordings.topics() if one in topics and one != MARKS]
        if not known:
            return
        query = recordings.topic(*known)
        if between is not None:
            query = query.between(*between)
        for one in query.check():
            self.topics[one.topic].append(one)
        for row in query.stats():
            self.fields[row.topic][row.field] = row

    def values(self, topic: str) -> dict[str, Value]:
        """Figures of a topic, by name; durations in ns."""
        ones = self.topics[topic]
        steady = [one for one in ones if not one.is_latched]
        rated = [one for one in ones if one.rate_hz]
        steps = sum(one.messages - 1 for one in rated)
        seconds = sum((one.messages - 1) / one.rate_hz for one in rated if one.rate_hz)
        return {
            "type": ", ".join(sorted({one.type for one in ones})),
            "messages": sum(one.messages for one in ones),
            "rate": steps / seconds if seconds else None,
            "longest_gap": _greatest(one.gap_ns for one in ones),
            "jitter": _greatest(one.jitter_ns for one in ones),
            "late_start": _greatest(one.late_ns for one in steady),
            "early_stop": _greatest(one.early_ns for one in steady),
            "lost": None if any(o.lost is None for o in ones) else sum(o.lost or 0 for o in ones),
        }


def diff(
    a: Recordings,
    b: Recordings,
    *,
    topics: Sequence[str] = (),
    between: Range | None = None,
    tolerance: float = 0.0,
    counters: bool = False,
) -> list[Difference]:
    """Differences between two choices of recordings: what only one has first, then by topic.

    Of two recordings of different length, the time that only one has is one difference, and the
    others are those of the time that both have. Topics are as `Store.topic` takes them, empty for
    all; `tolerance` is a share of the greater number. Counters and stamps in messages differ
    always, and are left out unless asked for.
    """
    known = sorted({*a.topics(), *b.topics()})
    wanted = resolve(topics, known) if topics else known
    ranges: Sequence[Range | None] = (between, between)
    found = []
    if between is None and (shared := _shared(a, b)) is not None:
        ranges, others = shared
        found = [Difference("", "times", others[0], others[1])]
    sides = _Side(a, wanted, ranges[0]), _Side(b, wanted, ranges[1])
    rest: list[Difference] = []
    for topic in sorted({*sides[0].topics, *sides[1].topics}):
        if not all(topic in side.topics for side in sides):
            # There is no common time of what only one has: its messages are all of them.
            words = [
                counted(one.topic(topic).between(*(between or (None, None))).count(), "message")
                if topic in side.topics
                else ""
                for one, side in zip((a, b), sides, strict=True)
            ]
            found.append(Difference(topic, "topic", words[0], words[1]))
            continue
        first, second = (side.values(topic) for side in sides)
        for what, value in first.items():
            if what in _ENDS and None in (value, second[what]):
                continue  # latched, or without messages
            share = _share(value, second[what])
            if share > tolerance:
                words = [_worded(what, one) for one in (value, second[what])]
                rest.append(Difference(topic, what, words[0], words[1], _finite(share)))
        counts = first["messages"], second["messages"]
        own = [
            {
                n: row
                for n, row in one.fields[topic].items()
                if counters or not _COUNTED.fullmatch(n)
            }
            for one in sides
        ]
        rest += _of_fields(topic, own[0], own[1], tolerance, counts)
    return Rows(found + rest)


def _shared(a: Recordings, b: Recordings) -> tuple[Sequence[Range], list[str]] | None:
    """The time that two recordings of different length share: the same, else since the begin.

    It is for each of them, ns, with words for what only that one has. None if both have about the
    same, or if there are more recordings.
    """
    if len(a) != 1 or len(b) != 1:
        return None
    spans = [one.summaries[0].extent for one in (a, b)]
    lengths = [end - begin for begin, end in spans]
    begins, ends = zip(*spans, strict=True)
    if max(begins) < min(ends):
        ranges = [(max(begins), min(ends))] * 2
    else:
        ranges = [(begin, begin + min(lengths)) for begin in begins]
    others = []
    for (first, last), (begin, end) in zip(spans, ranges, strict=True):
        parts = (first, begin), (end, last)
        least = _LEAST_SHARE * max(lengths)
        told = [
            f"from +{_to_ms(low - first)} to +{_to_ms(high - first)}"
            for low, high in parts
            if high - low > least
        ]
        others.append(", ".join(told))
    return (ranges, others) if any(others) else None


def _to_ms(duration: int) -> str:
    return format_duration(round(duration / 1e6) * 10**6)


def _of_fields(
    topic: str,
    a: Mapping[str, FieldStatistics],
    b: Mapping[str, FieldStatistics],
    tolerance: float,
    messages: tuple[Value, Value],
) -> Iterator[Difference]:
    """A difference for each field whose statistics are not the same.

    A count of values that equals the number of messages is left out, as that is told already.
    What is shown alike counts as the same: a sum depends on the order of its values.
    """
    for field in sorted({*a, *b}):
        if field not in a or field not in b:
            words = ["" if field not in side else "there" for side in (a, b)]
            yield Difference(topic, field, words[0], words[1])
            continue
        names, shares = [], []
        for name in _STATISTICS:
            one, other = (getattr(side[field], name) for side in (a, b))
            share = _share(one, other)
            is_shown = _worded(name, one) != _worded(name, other)
            if share > tolerance and is_shown and (name, (one, other)) != ("count", messages):
                names.append(name)
                shares.append(share)
        if names:
            words = [
                ", ".join(f"{name} {_worded(name, getattr(side[field], name))}" for name in names)
                for side in (a, b)
            ]
            yield Difference(topic, field, words[0], words[1], _finite(max(shares)))


def _greatest(values: Iterator[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _share(a: Value, b: Value) -> float:
    """The difference of two values, as a share of the greater one; infinite if there is none."""
    if isinstance(a, str) or isinstance(b, str) or a is None or b is None:
        return 0.0 if a == b else math.inf
    if a == b or (math.isnan(a) and math.isnan(b)):
        return 0.0
    greater = max(abs(a), abs(b))
    share = abs(a - b) / greater
    return share if share <= 2 else math.inf  # NaN, too


def _finite(share: float) -> float | None:
    return share if math.isfinite(share) else None


def _worded(what: str, value: Value) -> str:
    if value is None:
        return "unknown" if what == "lost" else ""
    if isinstance(value, str):
        return value
    if what in {"longest_gap", "jitter", "late_start", "early_stop"}:
        return format_duration(round(value))
    return str(value) if isinstance(value, int) else f"{value:.10g}"
