"""Answers of a question that are intervals of time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog.query.steps import Steps
from hybridlog_storage.errors import (
    UsageError,
)

if TYPE_CHECKING:
    from hybridlog.query.intervals import Intervals
    from hybridlog.query.times import DurationLike


class IntervalAnswers(Steps):
    """Answers with times, and times as conditions."""

    def intervals(
        self,
        at_least: DurationLike | None = None,
        length: DurationLike | None = None,
        max_gap: DurationLike | None = None,
        state: str | None = None,
    ) -> Intervals:
        """The longest intervals in which the predicate of `where` holds.

        At any time, the last message of the topic (by log time, then arrival) determines the
        state. Before the first message the state is unknown, and no interval covers it.
        A state lasts until the next message, or the end of the recording. The range of
        `between` cuts intervals; the message before it determines the state at its start.
        Without `where`, any message holds: `max_gap` then finds when the topic was active.

        Args:
            at_least: Only intervals of at least this length.
            length: Each interval cut into as many pieces of exactly this length as fit,
                one after the other from its beginning.
            max_gap: Longest time for which a message is valid; by default, until the next one.
            state: `held`, `not held` or `unknown`: three parts of the asked time, without
                each other. Unknown is the time before the first message, after `max_gap`, and
                from a loss to the next stored message. Without, what the stored messages say.

        Returns:
            Intervals; their `messages` are those that satisfy the predicate, with `state` all
            of the topic in them.

        Raises:
            UsageError: several topics, `limit`, `every`, `reverse`, another clock than the
                log's, or an unknown state.
            TimeError: no duration, or a range outside of all recordings.
        """
        with self.counters.timed():
            found = self._intervals().states(max_gap, state)
        if at_least is not None:
            found = found.at_least(at_least)
        return found if length is None else found.cut(length)

    def changes(
        self, *fields: str, pause: DurationLike = "1s", tolerance: float = 0.0
    ) -> Intervals:
        """Changes of fields: runs of messages that differ from the one before them.

        Steps are found among the messages of one recording that satisfy `where`. A step is a
        message with any of the fields different from the message before it. Steps at most
        `pause` apart belong to one change, whatever messages are between them. A change begins
        at the log time of its first step, and ends 1 ns after that of its last one.

        Args:
            fields: Paths (`position`, `position.x`); arrays are compared element by element.
            pause: Longest time between steps of one change.
            tolerance: Numbers are equal if they differ by at most this.

        Returns:
            Intervals; their `messages` are the steps.

        Raises:
            TopicError: no such field exists.
            UsageError: no field, several topics, `limit`, `every`, `reverse`, or another
                clock than the log's.
            TimeError: no duration, or a range outside of all recordings.
        """
        if not fields:
            raise UsageError("Name at least one field; `hybridlog info -t TOPIC` lists them.")
        self._as_they_came("Changes")
        self.fields(*fields)  # refuses unknown fields
        with self.counters.timed():
            return self._intervals().changes(fields, pause, tolerance)

    def gaps(
        self, longer_than: DurationLike | None = None, periods: float | None = None
    ) -> Intervals:
        """Times without messages of a topic, in its recordings.

        A gap lasts from one message to the next, from the beginning of the recording (or of
        the range) to the first message, or from the last message to the end. The usual period
        is the 0.9 quantile of the times from one message to the next in the recording.

        Args:
            longer_than: Only gaps longer than this, a duration.
            periods: Only gaps longer than so many usual periods; without both, 5.

        Returns:
            Intervals; their `messages` are 0.

        Raises:
            UsageError: several topics, `limit`, `every`, `reverse`, another clock than the
                log's, or no number of periods.
            TimeError: no duration, or a range outside of all recordings.
        """
        from hybridlog.query.answers.rates import Rates

        with self.counters.timed():
            return Rates(self.session, self.question, self.counters).gaps(longer_than, periods)
