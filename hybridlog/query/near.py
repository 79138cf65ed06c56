"""Conditions on other topics: each becomes the log time around the messages that satisfy it."""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from hybridlog.query.answers.interval_queries import IntervalQueries
from hybridlog.query.answers.marks import mark_topics
from hybridlog.query.intervals import Intervals
from hybridlog.query.predicate.tree import And, Condition, Near, Node, Not, Or, Predicate, nodes
from hybridlog.query.predicate.types import check
from hybridlog.query.question import Counters
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import TIME_LIMIT
from hybridlog_storage.errors import WhereError

if TYPE_CHECKING:
    from hybridlog.query.question import Question
    from hybridlog.query.times import DurationLike
    from hybridlog.session import Session


class Windows:
    """The log time around messages of other topics, in the recordings of a question.

    Args:
        session: The open store.
        question: The question.
        text: The predicate as written.
        before: Time before such a message, a duration.
        after: Time after it.

    Attributes:
        question: The question, with the times that have been found so far.
        asked: The questions about other topics, and what their answers have cost.
    """

    def __init__(
        self,
        session: Session,
        question: Question,
        text: str,
        before: DurationLike,
        after: DurationLike,
    ) -> None:
        self.question = question
        self.asked: list[tuple[Question, Counters]] = []
        self._session = session
        self._text = text
        self._reach = before, after
        whole = np.array([[0, TIME_LIMIT - 1, 0]], np.int64)
        self._whole = Intervals((one.id, whole) for one in session.summaries_of(question))

    def answer(self, nodes: list[Node]) -> None:
        """Find the times at which some conditions hold, each asked in those of the last one."""
        for node in nodes:
            self.question = self.question.within(self._holding(node))

    def _holding(self, node: Node) -> Intervals:
        """The log time in which a condition holds."""
        if isinstance(node, Near):
            return self._around(node).merged()
        if isinstance(node, Not):
            return self._whole.without(self._holding(node.item))
        assert isinstance(node, And | Or)
        join = Intervals.common if isinstance(node, And) else Intervals.union
        return reduce(join, map(self._holding, node.items))

    def _around(self, node: Near) -> Intervals:
        session, predicate = self._session, Predicate(node.item, self._text)
        question = _question_about(session, self.question, node.topic, *self._reach)
        if predicate:
            check(predicate, session.field_types(question.topics, question.recordings))
            question = replace(question, predicate=predicate)
        self.asked.append((question, Counters()))
        with self.asked[-1][1].timed():
            return IntervalQueries(session, *self.asked[-1]).windows(*self._reach)


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


def _question_about(
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
    near = Intervals(rows).widened(after, before).merged()
    return replace(found, during=near)
