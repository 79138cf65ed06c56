"""Contracts: YAML files of rules for a recording and its topics, which are untrusted.

Imports: across, arrays, formats, query, record.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from msgspec import Meta, Struct, ValidationError, convert, field

from hybridlog.formats.yaml_values import YamlError, parse_yaml, read_yaml
from hybridlog.query.intervals import GAP_PERIODS
from hybridlog.query.predicate.parser import parse
from hybridlog.query.times import format_duration, parse_duration
from hybridlog.record.marks import MARKS
from hybridlog.wording import listed
from hybridlog_storage.errors import HybridlogError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.answers.statistics import TopicCheck


MAX_RULES: Final = 1000
"""Predicates and offsets of a contract: each is a question."""
_REGULAR_FROM: Final = 10  # messages from which a rate is a rule


class Duration(int):
    """Nanoseconds, written like `500ms` or `-1ms`."""


class Share(float):
    """From 0 to 1, written like `95%`."""


_Count = Annotated[int, Meta(ge=0)]


class TopicRules(Struct, frozen=True):
    """Rules for a topic; None is no rule.

    Attributes:
        type: Type of the messages, of ROS 1, ROS 2 or others.
        rate: Mean rate, Hz.
        tolerance: Greatest difference from the rate, as a share of it.
        longest_gap: Longest time without a message, also before the first and after the last, ns.
        jitter: Greatest standard deviation of the times from one message to the next, ns.
        late_start: Longest time before the first message, ns.
        early_stop: Longest time after the last message, ns.
        lost: Greatest number of lost messages.
        least_age: Least log time minus header stamp, ns.
        greatest_age: Greatest log time minus header stamp, ns.
        stamps_in_order: No header stamp is before that of the message before.
        offset: By topic, the greatest distance to its nearest message by log time, ns.
        share: By predicate, the least share of the messages for which it holds.
        optional: The topic may be missing.
    """

    type: str | None = None
    rate: Annotated[float, Meta(gt=0, le=1e9)] | None = None
    tolerance: Share = Share(0.1)
    longest_gap: Duration | None = None
    jitter: Duration | None = None
    late_start: Duration | None = None
    early_stop: Duration | None = None
    lost: _Count | None = None
    least_age: Duration | None = None
    greatest_age: Duration | None = None
    stamps_in_order: bool = False
    offset: Mapping[str, Duration] = field(default_factory=dict)
    share: Mapping[str, Share] = field(default_factory=dict)
    optional: bool = False

    def __post_init__(self) -> None:
        for predicate in map(parse, self.share):
            if predicate.is_across:
                raise ValueError("share: it is of two topics: leave the other topic out")
            if not predicate.asks_fields:
                raise ValueError("share: it is not about fields of the message")


class Contract(Struct, frozen=True):
    """Rules that a good recording keeps.

    Attributes:
        topics: Rules by full name of the topic.
        lost: Greatest number of lost messages of the whole recording; None for no rule.
    """

    topics: Mapping[str, TopicRules]
    lost: int | None = None

    @classmethod
    def read(cls, path: str | Path) -> Contract:
        """Read a contract from a file.

        Raises:
            UsageError: It cannot be read, or breaks the schema; names topic, rule and cure.
        """
        return cls.parse(read_yaml(path, "contract"), str(path))

    @classmethod
    def parse(cls, text: str | bytes, name: str = "contract") -> Contract:
        """Parse a contract.

        Raises:
            UsageError: It breaks the schema; names topic, rule and cure.
        """
        try:
            given = convert(parse_yaml(text), _Given)
            topics = {topic: _rules(topic, rules or {}) for topic, rules in given.topics.items()}
            if sum(len(one.offset) + len(one.share) for one in topics.values()) > MAX_RULES:
                raise UsageError(f"there are more than {MAX_RULES} offsets and shares")
        except (YamlError, ValidationError, UsageError) as error:
            raise UsageError(f"{name} is no contract: {str(error).removesuffix('.')}.") from error
        return cls(topics, given.lost)


def _rules(topic: str, given: Mapping[str, Any]) -> TopicRules:
    known = TopicRules.__struct_fields__
    for key in given:
        if key not in known:
            raise UsageError(f"{topic}: there is no rule `{key}`; there are {listed(known, 20)}")
    try:
        return convert(given, TopicRules, strict=False, dec_hook=_value)
    except (HybridlogError, ValidationError) as error:
        raise UsageError(f"{topic}: {error}") from error


def _value(kind: type[Any], given: object) -> object:
    text = str(given).strip()
    try:
        if kind is Share:
            return kind(parse_share(text))
        sign = -1 if text.startswith("-") else 1
        return kind(sign * parse_duration(text.removeprefix("-")))
    except HybridlogError as error:
        raise ValueError(str(error)) from error


class _Given(Struct, forbid_unknown_fields=True):
    """A contract as it is written."""

    topics: dict[str, dict[str, Any] | None]
    lost: _Count | None = None


def parse_share(text: str) -> float:
    """A share from `5%` or `0.05`; UsageError if it is none, or more than 1."""
    number = text.strip().removesuffix("%")
    try:
        found = float(number) / (1 if number == text.strip() else 100)
    except ValueError:
        found = math.nan
    if not 0 <= found <= 1:
        raise UsageError(f"{text!r} is no share: write 95% or 0.95.")
    return found


def contract_of(topics: Sequence[TopicCheck]) -> str:
    """A contract in YAML that good recordings keep, with room for the next one.

    Topics whose messages come now and then, latched ones and those of few messages get no
    times. Marks are no part of it: another recording need not have any.
    """
    recordings = sorted({one.recording for one in topics})
    made_from = ", ".join(map(json.dumps, recordings)) or "no topic"
    lines = [f"# Made by `hybridlog check --make` from {made_from}.", "topics:"]
    for topic in sorted({one.topic for one in topics if one.messages} - {MARKS}):
        lines.append(f"  {json.dumps(topic, ensure_ascii=False)}:")
        own = [one for one in topics if one.topic == topic and one.messages]
        lines += [f"    {key}: {value}" for key, value in _made(own, len(recordings))]
    return "\n".join(lines) + "\n"


def _made(own: Sequence[TopicCheck], recordings: int) -> Iterator[tuple[str, str]]:
    """The rules of a topic that all of these keep."""
    if len({one.type for one in own}) == 1:
        yield "type", json.dumps(own[0].type, ensure_ascii=False)
    if len(own) < recordings:
        yield "optional", "true"
    losses = [one.lost for one in own if one.lost is not None]
    if len(losses) == len(own):
        yield "lost", str(max(losses))
    rates = [one.rate_hz for one in own if one.rate_hz is not None]
    is_steady = len(rates) == len(own) and not any(one.is_latched for one in own)
    if not is_steady or min(one.messages for one in own) < _REGULAR_FROM:
        return
    if max(one.silent_periods for one in own) > GAP_PERIODS:
        return
    rate = sum(rates) / len(rates)
    spread = max(abs(one - rate) for one in rates) / rate
    period = 1e9 / rate
    late, early = (max(getattr(one, f"{end}_ns") or 0 for one in own) for end in ("late", "early"))
    gap = max(one.gap_ns or 0 for one in own)
    yield "rate", f"{rate:.4g}"
    yield "tolerance", f"{max(20, math.ceil(200 * spread))}%"
    yield "longest_gap", _roomy(max(gap, late, early), GAP_PERIODS * period)
    yield "jitter", _roomy(max(one.jitter_ns or 0 for one in own), period / 2)
    yield "late_start", _roomy(late, 5e9)
    yield "early_stop", _roomy(early, 5e9)


def _roomy(ns: float, least: float) -> str:
    """Twice a duration, and at least some ns; rounded up to two digits."""
    wanted = math.ceil(max(2 * ns, least))
    step = 10 ** max(len(str(wanted)) - 2, 0)
    return format_duration(-(-wanted // step) * step)
