"""Chooses recordings among the summaries of a store.

Only `where` asks about messages: the index or the tables of the recordings that satisfy the
other conditions.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.query.planner import Planner
from hybridlog.query.question import Question
from hybridlog.query.times import (
    TIME_LIMIT,
    format_time,
    is_relative,
    parse_duration,
    parse_range,
)
from hybridlog.query.topics import fitting, split_topic
from hybridlog.wording import listed, meant
from hybridlog_storage.errors import TimeError, TopicError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.choice import Choice
    from hybridlog.query.times import DurationLike, TimeLike
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

_GLOB = frozenset("*?[")


class Chosen(NamedTuple):
    """The recordings of a choice, oldest first; the `problem` is why there is none, or empty."""

    summaries: list[RecordingSummary]
    problem: str


class _NothingLeftError(Exception):
    """No recording satisfies the conditions so far; its text is the hint."""


def choose(session: Session, choice: Choice) -> Chosen:
    """The recordings of a store that satisfy a choice."""
    choosing = _Choosing(session)
    try:
        if not choosing.left and not choice.is_everything:
            raise _NothingLeftError(session.when_empty)
        if choice.name:
            choosing.by_name(choice.name)
        choosing.look()
        for key, value in choice.tag:
            choosing.by_tag(key, value)
        for topic in choice.has:
            choosing.by_topic(topic)
        for name in choice.type:
            choosing.by_type(name)
        if choice.during is not None:
            choosing.by_time(*choice.during)
        if choice.older_than is not None:
            choosing.by_age(choice.older_than)
        for condition in choice.where:
            choosing.by_content(condition)
    except _NothingLeftError as nothing:
        described, hint = ", ".join(choosing.conditions), str(nothing)
        what = f"There is no recording {described}. " if described else ""
        return Chosen([], f"{what}{hint[:1].upper()}{hint[1:]}")
    return Chosen(choosing.summaries, "")


def topics_of_types(session: Session, types: Sequence[str], recordings: Sequence[str]) -> list[str]:
    """The topics of recordings, by id, with messages of some types, as `--type` names these.

    Raises:
        TopicError: There is none.
    """
    snapshot = session.look(recordings)
    places = snapshot.having(session.topics_of(recordings), recordings)
    found = {
        channel.topic: channel.type
        for summary in snapshot.differing(places)
        for channel in session.entry_of(summary).channels
    }
    chosen = [topic for topic, name in found.items() if any(_is_type(name, one) for one in types)]
    if not chosen:
        hint = meant(types[0], {*found.values()} - {""})
        raise TopicError(f"there is no topic of type {listed(types)}; {hint}")
    return sorted(chosen)


def placed(session: Session, names: Iterable[str]) -> dict[int, None]:
    """Positions of recordings by names and globs."""
    snapshot = session.snapshot()
    found: dict[int, None] = {}
    for name in names:
        if _GLOB & set(name) and not snapshot.called(name):
            fitting = snapshot.matching(name) or snapshot.named(name)
            found.update(dict.fromkeys(fitting))
        else:
            found.update(dict.fromkeys(session.named([name])))
    return found


class _Choosing:
    """Narrows down the recordings of a store, one condition after the other."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._snapshot = session.snapshot()
        self.left: list[int] = [*range(len(self._snapshot))]
        self.conditions: list[str] = []

    @property
    def summaries(self) -> list[RecordingSummary]:
        """Those that are left. Positions are of the snapshot at hand: a later one sorts anew."""
        return [self._snapshot.summaries[place] for place in self.left]

    @property
    def _places(self) -> NDArray[np.intp]:
        """Positions of those that are left."""
        return np.array(self.left, np.intp)

    def look(self) -> None:
        """See what those that go on have flushed."""
        ids = [summary.id for summary in self.summaries]
        self._snapshot = self._session.look(ids)
        self.left = sorted(self._snapshot.by_id[one] for one in ids)

    def _keep(self, places: Iterable[int], condition: str, hint: str) -> None:
        """Keep those at some positions; `hint` is what helps if none is left."""
        self.conditions.append(condition)
        remaining = {*places}
        self.left = [place for place in self.left if place in remaining]
        if not self.left:
            raise _NothingLeftError(hint)

    def by_name(self, names: Sequence[str]) -> None:
        condition = f"named {' or '.join(map(repr, names))}"
        there = listed(summary.name for summary in self._snapshot.summaries)
        self._keep(placed(self._session, names), condition, f"There are: {there}.")

    def by_tag(self, key: str, value: str | None) -> None:
        tags = self._snapshot.tags
        values = tags.get(key, {})
        chosen = values if value is None else [value]
        places = [place for one in chosen for place in values.get(one, ())]
        hint = f"The tags of the store are: {listed(sorted(tags))}."
        if not tags:
            hint = "No recording has a tag; `hybridlog tag RECORDING KEY=VALUE` sets one."
        elif values and not places:
            hint = f"The store has {listed(f'{key}={one}' for one in sorted(values))}."
        self._keep(places, f"with the tag {key if value is None else f'{key}={value}'}", hint)

    def by_topic(self, pattern: str) -> None:
        topics, hint = self._topics(pattern)
        self._keep(self._snapshot.having(topics).tolist(), f"with the topic {pattern!r}", hint)

    def _topics(self, pattern: str) -> tuple[list[str], str]:
        """The topics of the recordings that fit a pattern, and what to say if none does."""
        known = self._snapshot.topics_at(self._places)
        return fitting(pattern, known), meant(pattern, known)

    def by_type(self, name: str) -> None:
        names = self._session.type_names()
        schemas = {digest for digest, known in names.items() if _is_type(known, name)}
        found = self._snapshot.with_schemas(schemas).tolist()
        self._keep(found, f"with messages of the type {name!r}", meant(name, names.values()))

    def by_time(self, begin: TimeLike | None, end: TimeLike | None) -> None:
        for moment in (begin, end):
            if is_relative(moment) and str(moment).strip() not in {"start", "end"}:
                raise TimeError(
                    f"A time for choosing recordings is absolute, not {moment!r}: write a date "
                    "such as 2025-06-03, seconds since the epoch, `now`, `start` or `end`."
                )
        low, high = parse_range(begin, end, start=0, end=TIME_LIMIT - 1)
        known = [one.span for one in self.summaries if one.span is not None]
        hint = "`hybridlog ls` shows the times of all."
        if known:
            first = format_time(min(span[0] for span in known))
            hint = f"The others lie between {first} and {format_time(max(s[1] for s in known))}."
        places = self._snapshot.during(self._places, low, high, time.time_ns())
        condition = f"with messages from {begin or 'start'} to {end or 'end'}"
        self._keep(places.tolist(), condition, hint)

    def by_age(self, age: DurationLike) -> None:
        latest = time.time_ns() - parse_duration(age)
        old = [
            place
            for place, one in zip(self.left, self.summaries, strict=True)
            if one.status != "open" and one.extent[0] < one.extent[1] <= latest + 1
        ]
        condition = f"whose last message is from {format_time(latest)} or before"
        self._keep(old, condition, "`hybridlog ls` shows the times of all.")

    def by_content(self, condition: str) -> None:
        pattern, predicate = split_topic(condition)
        if not pattern:
            raise UsageError(
                f"Write TOPIC: PREDICATE, such as 'scan: ranges.min < 0.5', not {condition!r}."
            )
        topics, hint = self._topics(pattern)
        there = np.intersect1d(self._snapshot.having(topics), self._places)
        found: set[int] = set()
        if len(there):
            ids = tuple(self._snapshot.summaries[place].id for place in there.tolist())
            question = Question(tuple(topics), ids)
            if predicate:
                checked = self._session.predicate(predicate, tuple(topics), ids)
                if checked.is_across:
                    raise UsageError(f"A condition for recordings is of one topic: {condition!r}.")
                question = Question(tuple(topics), ids, predicate=checked)
            planner = Planner(self._session, question)
            found = {self._snapshot.by_id[one] for one in planner.recordings_with_any()}
        hint = f"{len(there)} with {listed(topics)} were asked." if topics else hint
        self._keep(found, f"with a message for which {condition!r} holds", hint)


def _is_type(name: str, pattern: str) -> bool:
    """True if a type is meant: `sensor_msgs/msg/Imu` by itself, `sensor_msgs/Imu` or `Imu`."""
    short = name.replace("/msg/", "/")  # as ROS 1 spells it
    spelled = {name, short, short.replace(".", "/").rpartition("/")[2]}
    wanted = {pattern, pattern.replace("/msg/", "/")}
    return any(fnmatchcase(one, want) or one == want for one in spelled for want in wanted)
