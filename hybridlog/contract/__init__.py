"""Contracts: YAML files of rules for a recording and its topics, which are untrusted."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct, field

from hybridlog.formats.yaml_values import YamlError, parse_yaml, read_yaml
from hybridlog.query.periods import GAP_PERIODS
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
    rate: float | None = None
    tolerance: float = 0.1
    longest_gap: int | None = None
    jitter: int | None = None
    late_start: int | None = None
    early_stop: int | None = None
    lost: int | None = None
    least_age: int | None = None
    greatest_age: int | None = None
    stamps_in_order: bool = False
    offset: Mapping[str, int] = field(default_factory=dict)
    share: Mapping[str, float] = field(default_factory=dict)
    optional: bool = False


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
            UsageError: It cannot be read, or breaks the schema; names line and cure.
        """
        return cls.parse(read_yaml(path, "contract"), str(path))

    @classmethod
    def parse(cls, text: str | bytes, name: str = "contract") -> Contract:
        """Parse a contract.

        Raises:
            UsageError: It breaks the schema; names line and cure.
        """
        lines: dict[tuple[int, object], int] = {}
        try:
            root = parse_yaml(text, lines=lines)
        except YamlError as error:
            raise UsageError(f"{name} is no YAML: {error}.") from error
        return _Reader(name, lines).contract(root)


class _Reader:
    """Checks the values of a contract."""

    def __init__(self, name: str, lines: Mapping[tuple[int, object], int]) -> None:
        self._name = name
        self._lines = lines
        self._left = MAX_RULES

    def contract(self, root: object) -> Contract:
        if not isinstance(root, dict):
            raise UsageError(f"{self._name} is no contract: it begins with `topics:`.")
        self._check_keys(root, ("topics", "lost"))
        topics = self._mapping(root, "topics")
        found = {str(topic): self._rules(topics, topic) for topic in topics}
        return Contract(found, self._value(root, "lost", _count) if "lost" in root else None)

    def _rules(self, topics: Mapping[object, object], topic: object) -> TopicRules:
        if topics[topic] is None:
            return TopicRules()
        rules = self._mapping(topics, topic)
        self._check_keys(rules, [*TopicRules.__struct_fields__])
        values: dict[str, Any] = {}
        for key in map(str, rules):
            if key in {"offset", "share"}:
                inner = self._mapping(rules, key)
                self._left -= len(inner)
                if self._left < 0:
                    why = f"there are more than {MAX_RULES} offsets and shares"
                    raise self._error(rules, key, why)
                values[key] = {str(one): self._value(inner, one, _KINDS[key]) for one in inner}
                for one in inner if key == "share" else ():
                    self._value(inner, one, partial(_check_predicate, one))
            else:
                values[key] = self._value(rules, key, _KINDS[key])
        return TopicRules(**values)

    def _value(self, holder: Mapping[Any, object], key: object, read: Callable[[Any], Any]) -> Any:
        try:
            return read(holder[key])
        except (HybridlogError, ValueError) as error:
            raise self._error(holder, key, str(error)) from error

    def _mapping(self, holder: Mapping[Any, object], key: object) -> Mapping[object, object]:
        value = holder.get(key)
        if not isinstance(value, dict):
            raise self._error(
                holder, key, f"`{key}:` has names with values, each on a line of its own"
            )
        return value

    def _check_keys(self, holder: Mapping[object, object], known: Sequence[str]) -> None:
        for key in holder:
            if key not in known:
                near = difflib.get_close_matches(str(key), known, 1)
                cure = f"did you mean `{near[0]}`?" if near else f"there are {listed(known, 20)}"
                raise self._error(holder, key, f"there is no rule `{key}`; {cure}")

    def _error(self, holder: Mapping[Any, object], key: object, why: str) -> UsageError:
        line = self._lines.get((id(holder), key))
        place = f", line {line}" if line else ""
        return UsageError(f"{self._name}{place}: {why.removesuffix('.')}.")


def _checked(value: Any, fits: bool, why: str) -> Any:  # noqa: FBT001
    if not fits:
        raise ValueError(f"{value!r} {why}")
    return value


def _count(value: Any) -> Any:
    fits = type(value) is int and value >= 0
    return _checked(value, fits, "is no number of messages: write 0 or more")


def _number(value: object) -> float:
    try:
        found = float(value) if isinstance(value, int | str) and not isinstance(value, bool) else -1
    except ValueError:
        found = -1.0
    _checked(value, 0 <= found < math.inf, "is no number of at least 0")
    return found


def _share(value: object) -> float:
    text = str(value).strip()
    found = _number(text.removesuffix("%").strip()) / (100 if text.endswith("%") else 1)
    _checked(value, found <= 1, "is no share: write 95% or 0.95")
    return found


def parse_share(text: str) -> float:
    """A share from `5%` or `0.05`; UsageError if it is none, or more than 1."""
    try:
        return _share(text)
    except ValueError as error:
        raise UsageError(f"{error}.") from error


def _age(value: object) -> int:
    text = str(value).strip()
    return -parse_duration(text[1:]) if text.startswith("-") else parse_duration(text)


def _duration(value: object) -> int:
    return parse_duration(value if isinstance(value, int) else str(value))


def _flag(value: Any) -> Any:
    return _checked(value, isinstance(value, bool), "is neither true nor false")


def _check_predicate(given: object, _: object) -> None:
    text = _KINDS["type"](given)
    _checked(text, not parse(text).is_across, "is of two topics: leave the other topic out")
    _checked(text, parse(text).asks_fields, "is not about fields of the message")


_KINDS: Final[Mapping[str, Callable[[Any], Any]]] = {
    "type": lambda one: _checked(one, isinstance(one, str), "is no name: write it in quotes"),
    "rate": lambda one: _checked(_number(one), _number(one) > 0, "is no rate: leave out the topic"),
    "tolerance": _share,
    "lost": _count,
    "least_age": _age,
    "greatest_age": _age,
    "stamps_in_order": _flag,
    "optional": _flag,
    "share": _share,
    **dict.fromkeys(("longest_gap", "jitter", "late_start", "early_stop", "offset"), _duration),
}


def contract_of(topics: Sequence[TopicCheck]) -> str:
    """A contract in YAML that a good recording keeps, with room for the next one.

    Topics whose messages come now and then, latched ones and those of few messages get no
    times. Marks are no part of it: another recording need not have any.
    """
    recording = topics[0].recording if topics else "no topic"
    lines = [f"# Made by `hybridlog check --make` from {json.dumps(recording)}.", "topics:"]
    for one in sorted(topics, key=lambda one: one.topic):
        if one.messages and one.topic != MARKS:
            lines.append(f"  {json.dumps(one.topic, ensure_ascii=False)}:")
            lines += [f"    {key}: {value}" for key, value in _made(one)]
    return "\n".join(lines) + "\n"


def _made(one: TopicCheck) -> Iterator[tuple[str, str]]:
    yield "type", json.dumps(one.type, ensure_ascii=False)
    if one.lost is not None:
        yield "lost", str(one.lost)
    if one.is_latched or one.messages < _REGULAR_FROM or one.rate_hz is None:
        return
    if one.silent_periods > GAP_PERIODS:
        return
    late, early = one.late_ns or 0, one.early_ns or 0
    yield "rate", f"{one.rate_hz:.4g}"
    yield "tolerance", "10%"
    yield "longest_gap", _roomy(max(one.gap_ns or 0, late, early), 10**6)
    yield "jitter", _roomy(one.jitter_ns or 0, 10**6)
    yield "late_start", _roomy(late, 10**9)
    yield "early_stop", _roomy(early, 10**9)


def _roomy(ns: float, least: int) -> str:
    """Twice a duration, and at least some ns; rounded up to two digits."""
    wanted = max(math.ceil(2 * ns), least)
    step = 10 ** max(len(str(wanted)) - 2, 0)
    return format_duration(-(-wanted // step) * step)
