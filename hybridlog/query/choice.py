"""Choices of recordings: the conditions that they must satisfy, and the ones that do.

Only `where` asks about messages: the index or the tables of the recordings that satisfy the
other conditions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct
from msgspec.structs import replace

from hybridlog.query.times import (
    TIME_LIMIT,
    DurationLike,
    TimeLike,
    format_time,
    is_relative,
    parse_duration,
    parse_range,
)
from hybridlog.query.topics import fitting, split_topic
from hybridlog.snapshot import differing
from hybridlog.wording import listed, meant
from hybridlog_storage.errors import TimeError, TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.question import Question
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingSummary

Texts: TypeAlias = "str | Sequence[str] | None"
"""One text or several."""
Tags: TypeAlias = "str | Sequence[str] | Mapping[str, str | None] | None"
"""`"robot=7"`, `"robot"`, several of these, or values by key."""
During: TypeAlias = "tuple[TimeLike | None, TimeLike | None] | None"
"""Begin and end of a range of log time; None leaves a side open."""
_Step: TypeAlias = "tuple[Sequence[RecordingSummary], str, str, Collection[str]]"
"""Recordings that satisfy a condition; this in words; and, for a hint where there is none, the name
that was wanted and those that there are."""
Answering: TypeAlias = "Callable[[Session, Question], set[str]]"
"""Returns the ids of the recordings that have a message in an answer."""
_GLOB = frozenset("*?[")


class Choice(Struct, frozen=True):
    """Conditions for recordings; all of them must hold, and one of the names must match.

    Attributes:
        name: Names, ids, beginnings of one, globs.
        tag: Keys and values of tags; None for any value.
        has: Topics that they have, as patterns.
        type: Types of messages that they have.
        during: Range `[begin, end)` of log time that they overlap.
        where: `TOPIC: PREDICATE`; each holds for at least one of their messages.
        older_than: Age that their last message has at least.
    """

    name: tuple[str, ...] = ()
    tag: tuple[tuple[str, str | None], ...] = ()
    has: tuple[str, ...] = ()
    type: tuple[str, ...] = ()
    during: tuple[TimeLike | None, TimeLike | None] | None = None
    where: tuple[str, ...] = ()
    older_than: DurationLike | None = None

    @classmethod
    def of(
        cls,
        name: Texts = None,
        *,
        tag: Tags = None,
        has: Texts = None,
        type: Texts = None,  # noqa: A002 - the word of the command line
        during: During = None,
        where: Texts = None,
        older_than: DurationLike | None = None,
    ) -> Choice:
        """A choice from single values or several.

        Raises:
            UsageError: A tag has no key.
            TimeError: `during` is not a pair.
        """
        if during is not None and (isinstance(during, str) or len(during) != 2):
            raise TimeError(f"A range takes two times, (begin, end), not {during!r}.")
        return cls(
            _texts(name),
            _tags(tag),
            _texts(has),
            _texts(type),
            None if during is None else (during[0], during[1]),
            _texts(where),
            older_than,
        )

    @property
    def is_everything(self) -> bool:
        """True if there is no condition."""
        return self == Choice()


def _texts(given: Texts) -> tuple[str, ...]:
    if given is None:
        return ()
    found = (given,) if isinstance(given, str) else tuple(given)
    if not all(isinstance(one, str) for one in found):
        raise UsageError(f"A choice of recordings takes text, not {given!r}.")
    return found


def _tags(given: Tags) -> tuple[tuple[str, str | None], ...]:
    if isinstance(given, Mapping):
        pairs = tuple(given.items())
    else:
        split = (one.partition("=") for one in _texts(given))
        pairs = tuple((key, value if sign else None) for key, sign, value in split)
    if not all(key for key, _ in pairs):
        raise UsageError("A tag is chosen as KEY=VALUE, or as KEY for any value.")
    return pairs


def choose(
    session: Session, choice: Choice, answering: Answering | None = None
) -> tuple[list[RecordingSummary], str]:
    """The recordings of a store that satisfy a choice, oldest first, and why there is none.

    `answering` is needed for `where`.
    """
    choosing = _Choosing(session, answering)
    if not choosing.left and not choice.is_everything:
        return [], session.when_empty
    conditions: list[str] = []
    for found, condition, wanted, known in choosing.steps(choice):
        conditions.append(condition)
        remaining = {one.id for one in found}
        choosing.left = [one for one in choosing.left if one.id in remaining]
        if not choosing.left:
            problem = f"There is no recording {', '.join(conditions)}"
            return [], f"{problem}; {meant(wanted, known)}" if known else f"{problem}."
    return choosing.left, ""


def topics_of_types(session: Session, types: Sequence[str], recordings: Sequence[str]) -> list[str]:
    """The topics of recordings, by id, with messages of some types, as `--type` names these.

    Raises:
        TopicError: There is none.
    """
    found = {
        channel.topic: channel.type
        for summary in differing(session.look(recordings).some(recordings))
        for channel in session.entry_of(summary).channels
    }
    chosen = [topic for topic, name in found.items() if any(_is_type(name, one) for one in types)]
    if not chosen:
        hint = meant(types[0], {*found.values()} - {""})
        raise TopicError(f"there is no topic of type {listed(types)}; {hint}")
    return sorted(chosen)


class _Choosing:
    """Narrows down the recordings of a store, one condition after the other."""

    def __init__(self, session: Session, answering: Answering | None) -> None:
        self._session = session
        self._answering = answering
        self._snapshot = session.snapshot()
        self.left = self._snapshot.summaries

    def steps(self, choice: Choice) -> Iterator[_Step]:
        """Each condition, to be applied before the next one is asked for."""
        if choice.name:
            names = [one.name for one in self._snapshot.summaries]
            words = f"named {' or '.join(map(repr, choice.name))}"
            yield [*self._named(choice.name)], words, choice.name[0], names
        # See what those that go on have flushed.
        ids = [summary.id for summary in self.left]
        self._snapshot = self._session.look(ids)
        self.left = self._snapshot.some(ids)
        for key, value in choice.tag:
            tags = (item for one in self._snapshot.summaries for item in one.tags.items())
            tagged = [
                one for one in self.left if key in one.tags and value in {None, one.tags[key]}
            ]
            words = key if value is None else f"{key}={value}"
            yield tagged, f"with the tag {words}", words, {f"{k}={own}" for k, own in tags}
        for pattern in choice.has:
            topics = self._snapshot.topics_of(self.left)
            having = self._snapshot.having(fitting(pattern, topics))
            yield having, f"with the topic {pattern!r}", pattern, topics
        for name in choice.type:
            types = {one.type for one in self._snapshot.kinds} - {""}
            typed = self._snapshot.with_types({one for one in types if _is_type(one, name)})
            yield typed, f"with messages of the type {name!r}", name, types
        if choice.during is not None:
            yield self._in_time(*choice.during)
        if choice.older_than is not None:
            yield self._of_age(choice.older_than)
        for condition in choice.where:
            yield self._of_content(condition)

    def _named(self, names: Iterable[str]) -> Iterator[RecordingSummary]:
        for name in names:
            if _GLOB & {*name}:
                yield from self._snapshot.named(name, is_pattern=True)
            else:
                yield from self._session.named([name])

    def _in_time(self, begin: TimeLike | None, end: TimeLike | None) -> _Step:
        for moment in (begin, end):
            if is_relative(moment) and str(moment).strip() not in {"start", "end"}:
                raise TimeError(
                    f"A time for choosing recordings is absolute, not {moment!r}: write a date "
                    "such as 2025-06-03, seconds since the epoch, `now`, `start` or `end`."
                )
        low, high = parse_range(begin, end, start=0, end=TIME_LIMIT - 1)
        now = time.time_ns()
        found = [one for one in self.left if overlaps(one, low, high, now)]
        return found, f"with messages from {begin or 'start'} to {end or 'end'}", "", ()

    def _of_age(self, age: DurationLike) -> _Step:
        latest = time.time_ns() - parse_duration(age)
        old = [
            one
            for one in self.left
            if one.status != "open" and one.extent[0] < one.extent[1] <= latest + 1
        ]
        return old, f"whose last message is from {format_time(latest)} or before", "", ()

    def _of_content(self, condition: str) -> _Step:
        pattern, predicate = split_topic(condition)
        if not pattern:
            raise UsageError(
                f"Write TOPIC: PREDICATE, such as 'scan: ranges.min < 0.5', not {condition!r}."
            )
        known = self._snapshot.topics_of(self.left)
        topics = tuple(fitting(pattern, known))
        there = self._snapshot.having(topics, [one.id for one in self.left])
        found: list[RecordingSummary] = []
        if there:
            ids = tuple(one.id for one in there)
            from hybridlog.query.question import Question

            question = Question(topics, ids)
            if predicate:
                checked = self._session.predicate(predicate, topics, ids)
                if checked.is_across:
                    raise UsageError(f"A condition for recordings is of one topic: {condition!r}.")
                question = replace(question, predicate=checked)
            assert self._answering is not None
            having = self._answering(self._session, question)
            found = [one for one in there if one.id in having]
        words = f"with a message for which {condition!r} holds"
        return found, words, pattern, () if there else known


def overlaps(one: RecordingSummary, low: int, high: int, now: int) -> bool:
    """True if a recording has log times in `[low, high)`, ns.

    One that is being written begins with its first known message, or when it was started, and
    reaches until now.
    """
    begin, end = one.extent
    if one.status == "open":
        begin, end = begin if begin < end else one.created, max(end, now)
    return begin < end and begin < high and end > low


def _is_type(name: str, pattern: str) -> bool:
    """True if a type is meant: `sensor_msgs/msg/Imu` by itself, `sensor_msgs/Imu` or `Imu`."""
    short = name.replace("/msg/", "/")  # as ROS 1 spells it
    spelled = {name, short, short.replace(".", "/").rpartition("/")[2]}
    wanted = {pattern, pattern.replace("/msg/", "/")}
    return any(fnmatchcase(one, want) or one == want for one in spelled for want in wanted)
