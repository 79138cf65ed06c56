"""Differences between two recordings, or two choices of them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from hybridlog.contract.judge import broken, judge
from hybridlog.query.times import format_duration
from hybridlog.record.marks import MARKS
from hybridlog.wording import counted

if TYPE_CHECKING:
    from hybridlog.contract.contract import Contract
    from hybridlog.query.answers.field_statistics import FieldStatistics
    from hybridlog.query.answers.regularity import TopicCheck
    from hybridlog.query.query import Query
    from hybridlog.recordings import Recordings
    from hybridlog.session import Session

Value = float | str | None
_STATISTICS: Final = ("count", "nan", "infinite", "min", "max", "mean", "std")


@dataclass(frozen=True, slots=True)
class Difference:
    """Something that differs.

    Attributes:
        topic: Full name of the topic; empty for the whole recording.
        what: `topic`, `type`, `messages`, `rate`, `longest_gap`, `jitter`, `late_start`,
            `early_stop`, `lost`, the path of a field, or a rule of the contract.
        a: What the first choice has, in words; empty if it has no such thing.
        b: The same for the second one.
    """

    topic: str
    what: str
    a: str
    b: str


class _Side:
    """Figures of some recordings together, to be compared."""

    def __init__(self, recordings: Recordings) -> None:
        self.query: Query = recordings.all_topics()
        self.summaries = recordings.summaries
        self.topics: dict[str, list[TopicCheck]] = defaultdict(list)
        for one in self.query.check():
            self.topics[one.topic].append(one)
        self.fields: dict[str, dict[str, FieldStatistics]] = defaultdict(dict)
        for row in self.query.stats():
            self.fields[row.topic][row.field] = row

    def values(self, topic: str) -> dict[str, Value]:
        """Figures of a topic, by name; durations in ns."""
        ones = self.topics[topic]
        rated = [one for one in ones if one.rate_hz]
        steps = sum(one.messages - 1 for one in rated)
        seconds = sum((one.messages - 1) / one.rate_hz for one in rated if one.rate_hz)
        return {
            "type": ", ".join(sorted({one.type for one in ones})),
            "messages": sum(one.messages for one in ones),
            "rate": steps / seconds if seconds else None,
            "longest_gap": _greatest(one.gap_ns for one in ones),
            "jitter": _greatest(one.jitter_ns for one in ones),
            "late_start": _greatest(one.late_ns for one in ones),
            "early_stop": _greatest(one.early_ns for one in ones),
            "lost": None if any(o.lost is None for o in ones) else sum(o.lost or 0 for o in ones),
        }


def diff(
    session: Session,
    a: Recordings,
    b: Recordings,
    *,
    tolerance: float = 0.0,
    contract: Contract | None = None,
) -> list[Difference]:
    """Differences between two choices of recordings, by topic.

    Args:
        session: The open store.
        a: The first choice.
        b: The second one.
        tolerance: Numbers are equal that differ by at most this share of the greater one.
        contract: Also compare which of its rules are broken; None for no contract.
    """
    sides = _Side(a), _Side(b)
    found: list[Difference] = []
    # Marks are about a recording, and not of it.
    for topic in sorted({*sides[0].topics, *sides[1].topics} - {MARKS}):
        if not all(topic in side.topics for side in sides):
            words = [
                ""
                if topic not in side.topics
                else counted(sum(one.messages for one in side.topics[topic]), "message")
                for side in sides
            ]
            found.append(Difference(topic, "topic", *words))
            continue
        first, second = (side.values(topic) for side in sides)
        for what, value in first.items():
            if not _same(value, second[what], tolerance):
                words = [_worded(what, one) for one in (value, second[what])]
                found.append(Difference(topic, what, *words))
        found += _of_fields(topic, sides[0].fields[topic], sides[1].fields[topic], tolerance)
    if contract is not None:
        broke = [_broken(session, contract, side) for side in sides]
        rules = sorted({*broke[0], *broke[1]})
        changed = [rule for rule in rules if (rule in broke[0]) != (rule in broke[1])]
        for topic, rule, wanted in changed:
            words = [one.get((topic, rule, wanted), "holds") for one in broke]
            found.append(Difference(topic, f"{rule} {wanted}", *words))
    return found


def _of_fields(
    topic: str,
    a: Mapping[str, FieldStatistics],
    b: Mapping[str, FieldStatistics],
    tolerance: float,
) -> Iterator[Difference]:
    """A difference for each field whose statistics are not the same."""
    for field in sorted({*a, *b}):
        if field not in a or field not in b:
            words = ["" if field not in side else "there" for side in (a, b)]
            yield Difference(topic, field, *words)
            continue
        values = [[getattr(side[field], name) for name in _STATISTICS] for side in (a, b)]
        names = [
            name
            for name, one, other in zip(_STATISTICS, *values, strict=True)
            if not _same(one, other, tolerance)
        ]
        if names:
            words = [
                ", ".join(f"{name} {_worded(name, getattr(side[field], name))}" for name in names)
                for side in (a, b)
            ]
            yield Difference(topic, field, *words)


def _broken(session: Session, contract: Contract, side: _Side) -> dict[tuple[str, str, str], str]:
    """Values of the recordings where they break rules, by topic, rule and what it wants."""
    results = [one for summary in side.summaries for one in judge(session, contract, summary)]
    return {(one.topic, one.rule, one.wanted): one.found for one in broken(results)}


def _greatest(values: Iterator[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _same(a: Value, b: Value, tolerance: float) -> bool:
    if isinstance(a, str) or isinstance(b, str) or a is None or b is None:
        return a == b
    if a == b or (math.isnan(a) and math.isnan(b)):
        return True
    return abs(a - b) <= tolerance * max(abs(a), abs(b)) < math.inf


def _worded(what: str, value: Value) -> str:
    if value is None:
        return "unknown" if what == "lost" else ""
    if isinstance(value, str):
        return value
    if what in {"longest_gap", "jitter", "late_start", "early_stop"}:
        return format_duration(round(value))
    return str(value) if isinstance(value, int) else f"{value:.10g}"
