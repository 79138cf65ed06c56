"""Turns conditions on other topics into intervals of log time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from hybridlog.query.answers.marks import mark_topics
from hybridlog.query.intervals import Intervals
from hybridlog.query.predicate.tree import And, Condition, Near, Node, Not, Or, nodes
from hybridlog.query.question import Question
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import TIME_LIMIT
from hybridlog_storage.errors import WhereError

if TYPE_CHECKING:
    from hybridlog.query.times import DurationLike
    from hybridlog.session import Session

Windows: TypeAlias = Callable[[Near], Intervals]
"""Gives the intervals around the messages that satisfy a condition."""


def everything(session: Session, question: Question) -> Intervals:
    """All log time of the recordings of a question."""
    whole = np.array([[0, TIME_LIMIT - 1, 0]], np.int64)
    return Intervals.of((one.id, whole) for one in session.summaries_of(question))


def question_about(
    session: Session, question: Question, topic: str, before: DurationLike, after: DurationLike
) -> Question:
    """The question about another topic, in the same recordings and only where it matters.

    Wanted messages are at most `before` in front of one of the other topic, and `after` behind it.
    """
    found = session.question([topic], question.recordings)
    if question.is_unbounded or not question.is_by_log_time:
        return found
    if {*found.topics} <= {*mark_topics(session)}:
        return found  # marks may last
    spans = RangeResolver(session, question).spans()
    rows = ((one.id, np.array([[begin, end, 0]], np.int64)) for one, (begin, end) in spans)
    near = Intervals.of(rows).widened(after, before).merged()
    return replace(found, during=near)


def split_own(node: Node) -> tuple[list[Node], list[Node]]:
    """The conditions on the message itself, and those on other topics. All of both must hold."""
    if not any(isinstance(inner, Near) for inner in nodes(node)):
        return [node], []
    if isinstance(node, And):
        found = [split_own(item) for item in node.items]
        return [one for own, _ in found for one in own], [one for _, far in found for one in far]
    for inner in nodes(node):
        if isinstance(inner, Condition):
            raise WhereError(
                f"{inner.field.path!r} is of the message itself, and can only be joined by "
                "`and` with conditions on other topics. Name its topic to let any message near "
                "in time satisfy it."
            )
    return [], [node]


def intervals_of(node: Node, windows: Windows, whole: Intervals) -> Intervals:
    """The log time in which a condition on other topics holds.

    `windows` gives the intervals around the messages of a topic, `whole` is all log time asked
    about.
    """
    if isinstance(node, Near):
        return windows(node).merged()
    if isinstance(node, Not):
        return whole.without(intervals_of(node.item, windows, whole))
    assert isinstance(node, And | Or)
    found = [intervals_of(item, windows, whole) for item in node.items]
    return reduce(Intervals.common if isinstance(node, And) else Intervals.union, found)
