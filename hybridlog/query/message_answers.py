"""Answers of a question that are messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hybridlog.query.planner import Planner
from hybridlog.query.steps import Steps, of_now
from hybridlog.query.times import parse_time
from hybridlog_storage.errors import (
    DefinitionError,
    PayloadError,
    TopicError,
    UsageError,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog.query.answers.follow import Following
    from hybridlog.query.question import RecordedChannel
    from hybridlog.query.times import TimeLike
    from hybridlog_storage.messages import Batch


class MessageAnswers(Steps):
    """Answers with the messages themselves."""

    def __iter__(self) -> Iterator[Message]:
        """The messages as they came, ordered by log time, recording and arrival.

        Raises:
            UsageError: it has `in_frame`, which is for tables and arrays.
        """
        self._as_they_came("Loops and `at`")
        from hybridlog.message import messages_in
        from hybridlog.query.answers.video import picture_of

        planner = self._planner()
        picture = picture_of(planner.session)
        for run in planner.runs():
            yield from messages_in(run, picture)

    def follow(self, *names: str) -> Following:
        """The messages that running recordings flush from now on, until all of them have ended.

        With `between`, also those that are flushed already. Each comes once; those that are
        flushed together are in order of log time. MongoDB is not needed.

        Args:
            names: The topics as they were written: globs take topics that appear later.

        Raises:
            UsageError: No recording of the question is running, or it has `reverse`, `during`
                or a filter that MongoDB answers.
        """
        from hybridlog.query.answers.follow import Following

        self.counters.reset()
        return Following(self.source, self.question, self.counters, names)

    def at(self, moment: TimeLike) -> Message:
        """The message of `at_time`. Its arrays are read-only: copy to change them.

        Raises:
            TopicError: no such message exists.
            UsageError: the question has a time range, `in_frame`, or another clock than log
                time.
        """
        self._as_they_came("Loops and `at`")
        return _message_at(self, moment)

    def at_time(self, moment: TimeLike) -> Self:
        """Only the message that was current at a time: the last one not after it.

        Raises:
            TopicError: no such message exists.
            UsageError: the question has a time range, or another clock than log time.
        """
        from hybridlog.query.answers.last_message import just_before

        now = of_now(self)
        found = _message_at(now, moment)
        time = found.log_time_ns
        question = just_before(self.question, found.recording, time, time)
        # What is lost between the message and the moment may have been the current one.
        snapshot = now.session.snapshot()
        place = snapshot.by_id[found.recording]
        start, end = int(snapshot.begin[place]), int(snapshot.end[place])
        latest = max(parse_time(moment, start=start, end=end), time)
        since = type(self)(self.source, replace(question, bounds=(time, latest + 1)))
        return type(self)(self.source, question, (*self.conditions, since))

    def batches(self) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
        """The messages in order, many at once; `batch.channel` indexes the channels.

        Messages without payload are left out; `counters.reduced` counts them.
        """
        for run in self._planner().runs():
            whole = np.array([not channel.is_reduced for channel in run.channels], np.bool_)
            batch = run.batch if whole.all() else run.batch.take(whole[run.batch.channel])
            for number in np.flatnonzero(~whole).tolist():
                left = int((run.batch.channel == number).sum())
                self.counters.leave_out(left, run.channels[number].state)
            if len(batch):
                yield batch, run.channels

    def latched(
        self, *, original_times: bool = False
    ) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
        """Latched messages from before the time range that are in force when it begins.

        They are those that a subscriber receives which joins at that time, and the frames of
        video topics from the last key frame on. Their log time is the beginning of the range.
        Take them before `batches`, and with separate counters.
        """
        from hybridlog.query.answers.latched import in_force

        self.counters.reset()
        return in_force(self.session, self.question, self.counters, original_times=original_times)

    def count(self) -> int:
        """Number of messages."""
        with self.counters.timed():
            found = Planner(self.session, self.question, self.counters).count()
            self.counters.messages = found
        return found

    def to_numpy(self, frame: str | None = None) -> NDArray[Any] | list[NDArray[Any]]:
        """Every message as an array (`Message.to_numpy`): stacked if all are alike.

        Messages that cannot be arrays are left out; `counters.unreadable` counts them.

        Args:
            frame: The frame of points; see `in_frame`. Their `x`, `y` and `z` are float64, NaN
                without a transform, before their other fields. None for that of each message.

        Raises:
            PayloadError: None of the messages can be an array.
            DefinitionError: The first of them has no definition.
        """
        frame = self.question.frame if frame is None else frame
        if frame is not None:
            from hybridlog.tf.in_frame import points_of

            self.counters.reset()
            framed = replace(self.question, frame=frame)
            return _stacked([one.points for one in points_of(self.session, framed, self.counters)])
        now = of_now(self)
        scans = _scans_of(now)
        if scans is not None:
            return scans
        arrays: list[NDArray[Any]] = []
        refused: PayloadError | DefinitionError | None = None
        unreadable = 0
        for message in now:
            try:
                arrays.append(message.to_numpy())
            except (PayloadError, DefinitionError) as error:
                refused = refused or error
                unreadable += 1
        if refused is not None and not arrays:
            raise refused
        self.counters.unreadable += unreadable
        return _stacked(arrays)


def _stacked(arrays: list[NDArray[Any]]) -> NDArray[Any] | list[NDArray[Any]]:
    alike = {(a.shape, a.dtype) for a in arrays}
    return np.stack(arrays) if len(alike) == 1 else arrays


def _message_at(query: Steps, moment: TimeLike) -> Message:
    if not query.question.is_unbounded or query.question.clock != "log":
        raise UsageError(
            "A message at a time is the last one by log time; `between`, `during` and "
            "`clock` cannot be combined with it."
        )
    from hybridlog.query.answers.last_message import message_at

    with query.counters.timed():
        found = message_at(query.session, query.question, query.counters, moment)
    if found is None:
        raise TopicError(f"No message of {', '.join(query.topics)} is at or before {moment}.")
    return found


def _scans_of(query: Steps) -> NDArray[Any] | None:
    """Laser scans of one length as an array, from columns; None for everything else."""
    from hybridlog.frames.answer import FIELDS, are_scans, scans_in

    if not are_scans(Planner(query.session, query.question, query.counters).channels()):
        return None
    query.counters.reset()
    question = replace(query.question, fields=FIELDS, tags=())
    found = scans_in(Planner(query.session, question, query.counters))
    return None if query.counters.unreadable or query.counters.reduced else found
