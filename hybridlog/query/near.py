"""Turns conditions on other topics into intervals of log time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from hybridlog.query.answers.marks import mark_topics
from hybridlog.query.intervals import Intervals
from hybridlog.query.predicate.across import All, AnyOf, Condition, Near, NoneOf, Own
from hybridlog.query.question import Question
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import TIME_LIMIT
from hybridlog.query.topics import namesakes, resolve
from hybridlog_storage.errors import WhereError

if TYPE_CHECKING:
    from hybridlog.query.times import DurationLike
    from hybridlog.session import Session

Windows: TypeAlias = Callable[[Near], Intervals]
"""Gives the intervals around the messages that satisfy a condition."""


def everything(session: Session, question: Question) -> Intervals:
    """All log time of the recordings of a question."""
    snapshot = session.look(question.recordings)
    places = session.chosen(question).tolist()
    whole = np.array([[0, TIME_LIMIT - 1, 0]], np.int64)
    return Intervals.of((snapshot.summaries[place].id, whole) for place in places)


def question_about(
    session: Session, question: Question, topic: str, before: DurationLike, after: DurationLike
) -> Question:
    """The question about another topic, in the same recordings and only where it matters.

    Args:
        session: The open store.
        question: The question whose messages are wanted.
        topic: The other topic, as written.
        before: Longest time of a wanted message before one of the other topic.
        after: Longest time after it.

    Raises:
        TopicError: no such topic exists in the recordings.
    """
    recordings = question.recordings
    if recordings is None:
        known = session.look(None).topics
        topics = resolve([topic], known)
    else:
        known = session.topics_of(recordings)
        topics = session.resolve_in([topic], recordings)
    others = namesakes([topic], known)
    found = Question(*session.having(topics, recordings), namesakes=others)
    if question.is_unbounded or not question.is_by_log_time:
        return found
    if {*found.topics} <= {*mark_topics(session)}:
        return found  # marks may last
    spans = RangeResolver(session, question).spans()
    rows = ((one.id, np.array([[begin, end, 0]], np.int64)) for one, (begin, end) in spans)
    near = Intervals.of(rows).widened(after, before).merged()
    return Question(found.topics, found.recordings, during=near)


def split_own(condition: Condition) -> tuple[list[str], list[Condition]]:
    """The predicates about the message itself, and the conditions on other topics.

    All of both must hold.

    Raises:
        WhereError: a predicate about the message itself is joined by `or` or negated
            together with a condition on another topic.
    """
    parts: Sequence[Condition] = condition.parts if isinstance(condition, All) else (condition,)
    own, others = [], []
    for part in parts:
        if isinstance(part, Own):
            own.append(part.predicate)
        elif isinstance(part, All):
            inner = split_own(part)
            own += inner[0]
            others += inner[1]
        else:
            _check(part)
            others.append(part)
    return own, others


def intervals_of(condition: Condition, windows: Windows, whole: Intervals) -> Intervals:
    """The log time in which a condition on other topics holds.

    Args:
        condition: Without a predicate about the message itself.
        windows: Gives the intervals around the messages of a topic.
        whole: All log time of the recordings asked about.
    """
    if isinstance(condition, Near):
        return windows(condition).merged()
    if isinstance(condition, NoneOf):
        return whole.without(intervals_of(condition.part, windows, whole))
    assert isinstance(condition, All | AnyOf)
    found = [intervals_of(part, windows, whole) for part in condition.parts]
    if isinstance(condition, All):
        return reduce(Intervals.common, found)
    return reduce(Intervals.union, found)


def _check(condition: Condition) -> None:
    if isinstance(condition, Own):
        raise WhereError(
            f"{condition.predicate!r} is about the message itself, and can only be joined by "
            "`and` with conditions on other topics. Name its topic to let any message near in "
            "time satisfy it."
        )
    if isinstance(condition, NoneOf):
        _check(condition.part)
    elif isinstance(condition, All | AnyOf):
        for part in condition.parts:
            _check(part)
