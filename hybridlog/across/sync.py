"""Sets of messages with about the same time, read when they are looked at.

The policy is `ApproximateTime` of ROS, see `approximate_sets`.
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from hybridlog.message import messages_in
from hybridlog.query.answers.last_message import message_at
from hybridlog.query.answers.lost import completeness_of
from hybridlog.query.answers.video import picture_of
from hybridlog.query.counters import Counters
from hybridlog.query.intervals import Intervals
from hybridlog.query.planner import Planner
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import DurationLike, parse_duration
from hybridlog.schema.codec import stamp_array
from hybridlog.schema.column import STAMP
from hybridlog.wording import counted
from hybridlog_storage.errors import StoreError, TimeError, UsageError
from hybridlog_storage.times import span_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog.query.question import Clock, Question
    from hybridlog.session import Session


@dataclass(frozen=True, slots=True)
class _Found:
    """The messages of one topic that are in sets.

    Attributes:
        time: int64[n], ns on the clock.
        log_time: int64[n], ns.
        number: int64[n], its place among the messages of that log time that the question finds.
        is_alone: bool[n], True if the topic has no other message of that log time.
    """

    time: NDArray[np.int64]
    log_time: NDArray[np.int64]
    number: NDArray[np.int64]
    is_alone: NDArray[np.bool_]


class Synced(Sequence[tuple["Message", ...]]):
    """Sets of messages with about the same time, one of each topic.

    A map-style data set: `len`, `[n]`, slices and iteration. Only times have been read; the
    messages of a set are read when it is asked for. It can be pickled and used after a fork,
    such as in workers of a data loader: each process opens the store for itself.

    Attributes:
        topics: Full names of the topics, in the order of each set.
        recordings: Id of each set's recording.
        times: int64[n, topics], times of the messages on the clock, ns.
        left_out: Number of messages of each topic that are in no set, in the order of `topics`.
        counters: What reading has cost in this process, with the times at first.
    """

    def __init__(
        self,
        session: Session,
        open_again: Callable[[], Session],
        questions: Sequence[Question],
        tolerance: DurationLike | None,
        clock: Clock,
    ) -> None:
        if len(questions) < 2:
            raise UsageError("A set is of two topics or more: name them.")
        if any(not q.returns_all or q.reverse for q in questions):
            raise UsageError("Sets use all messages: leave out limit, every and reverse.")
        if any(q.frame is not None for q in questions):
            raise UsageError("Sets are of messages as they came: leave out in_frame.")
        self.counters = Counters()
        self._open_again = open_again
        self._sessions: dict[int, Session] = {os.getpid(): session}  # by process
        self.topics = tuple(question.topics[0] for question in questions)
        limit = None if tolerance is None else parse_duration(tolerance)
        snapshot = session.look()
        shared = [set(session.chosen(question).tolist()) for question in questions]
        ids: list[str] = []
        found: list[list[_Found]] = []
        known = np.zeros((2, len(questions)), np.int64)  # messages, those with a time
        places = sorted(set.intersection(*shared))
        in_range = set.union(*map(partial(_in_range, session), questions))
        for place in sorted(in_range.intersection(places)):
            recording = snapshot.summaries[place].id
            columns = [
                _times_of(session, replace(q, recordings=(recording,)), clock, self.counters)
                for q in questions
            ]
            rows = approximate_sets([column.time for column in columns], limit)
            ids += [recording] * len(rows)
            found.append([column.take(rows[:, n]) for n, column in enumerate(columns)])
            known += [[len(c.log_time) for c in columns], [len(c.time) for c in columns]]
        self.recordings = tuple(ids)
        left_out = [
            _left_out(session, question, read, places, len(ids))
            for question, read in zip(questions, known.T.tolist(), strict=True)
        ]
        self.left_out = tuple(messages for messages, _ in left_out)
        self._why_left_out = [why for _, why in left_out if why]
        by_topic = [_joined([part[n] for part in found]) for n in range(len(questions))]
        self.times: NDArray[np.int64] = np.stack([column.time for column in by_topic], axis=1)
        self._topics = list(zip(questions, by_topic, strict=True))

    def __repr__(self) -> str:
        left_out = ", ".join(map(str, self.left_out))
        return f"<Synced {', '.join(self.topics)}; {len(self)} sets, left out: {left_out}>"

    def __getstate__(self) -> dict[str, Any]:
        """All but the open store."""
        return {**vars(self), "_sessions": {}, "counters": Counters()}

    def _opened(self) -> Session:
        """The store, opened by this process."""
        process = os.getpid()
        if process not in self._sessions:  # the parent's stays: closing it is not the child's
            self._sessions[process] = self._open_again()
        return self._sessions[process]

    def remarks(self) -> list[str]:
        """Sentences about the sets: messages that are in none, and what the topics may lack."""
        session, found = self._opened(), list(self._why_left_out)
        for question, _ in self._topics:
            found += completeness_of(session, question).sentences
        return [*dict.fromkeys(found)]

    def __len__(self) -> int:
        """Number of sets."""
        return len(self.recordings)

    @overload
    def __getitem__(self, place: int) -> tuple[Message, ...]: ...

    @overload
    def __getitem__(self, place: slice) -> list[tuple[Message, ...]]: ...

    def __getitem__(self, place: int | slice) -> tuple[Message, ...] | list[tuple[Message, ...]]:
        """The messages of a set, in the order of the topics; a list for a slice.

        Raises:
            StoreError: the messages are not in the store any more.
        """
        if isinstance(place, slice):
            return [self[n] for n in range(*place.indices(len(self)))]
        row = range(len(self))[place]
        session = self._opened()
        recording = self.recordings[row]
        return tuple(self._read(session, *topic, recording, row) for topic in self._topics)

    def __iter__(self) -> Iterator[tuple[Message, ...]]:
        """The sets, one after the other."""
        return (self[n] for n in range(len(self)))

    def _read(
        self, session: Session, question: Question, topic: _Found, recording: str, row: int
    ) -> Message:
        time, number = int(topic.log_time[row]), int(topic.number[row])
        plain = replace(
            question,
            recordings=(recording,),
            bounds=None,
            during=None,
            predicate=None,
            clock="log",
        )
        if topic.is_alone[row]:
            found = message_at(session, plain, self.counters, time)
            if found is not None and found.log_time_ns == time:
                return found
        span = Intervals.of([(recording, np.array([[*span_of(time, time), 1]], np.int64))])
        question = replace(question, recordings=(recording,), during=span)
        counters = Counters()
        runs = Planner(session, question, counters).runs()
        picture = picture_of(session)
        messages = [message for run in runs for message in messages_in(run, picture)]
        self.counters.add(counters)
        if number >= len(messages):
            raise StoreError(
                f"A message of {question.topics[0]} is not in the store any more: make the "
                "sets again."
            )
        return messages[number]


@dataclass(frozen=True, slots=True)
class _Times:
    """Times of the messages of a topic of a recording.

    Attributes:
        time: int64[n], ns on the clock, ascending.
        log_time: int64[m], ns, ascending; m > n if some have no time on the clock.
        rows: int64[n], place of each time in `log_time`; None for the same place.
        is_whole: True if these are all messages of the topic.
    """

    time: NDArray[np.int64]
    log_time: NDArray[np.int64]
    rows: NDArray[np.int64] | None
    is_whole: bool

    def take(self, chosen: NDArray[np.int64]) -> _Found:
        """The messages of some times."""
        rows = chosen if self.rows is None else self.rows[chosen]
        log_time = self.log_time[rows]
        begin = np.searchsorted(self.log_time, log_time, "left")
        end = np.searchsorted(self.log_time, log_time, "right")
        is_alone = (end - begin == 1) & self.is_whole
        return _Found(self.time[chosen], log_time, rows - begin, is_alone)


def _joined(parts: Sequence[_Found]) -> _Found:
    none = np.empty(0, np.int64)
    empty = _Found(none, none, none, np.empty(0, np.bool_))
    whole = [empty, *parts]
    return _Found(
        np.concatenate([part.time for part in whole]),
        np.concatenate([part.log_time for part in whole]),
        np.concatenate([part.number for part in whole]),
        np.concatenate([part.is_alone for part in whole]),
    )


def _in_range(session: Session, question: Question) -> set[int]:
    """Places of the recordings that a question's range touches."""
    try:
        return set(RangeResolver(session, question).resolve().places.tolist())
    except TimeError:
        return set()


def _times_of(session: Session, question: Question, clock: Clock, counters: Counters) -> _Times:
    """The messages of a question about one recording, ordered by their time on a clock.

    Raises:
        TopicError: the topic does not have the clock.
    """
    if clock != "log":
        # Refused where the topic does not have the clock.
        on_clock = replace(question, clock=clock, bounds=(None, None), during=None)
        Planner(session, on_clock, Counters()).parts()
    planner = Planner(session, question, counters)
    log_times, times, has = (
        [np.empty(0, np.int64)],
        [np.empty(0, np.int64)],
        [np.empty(0, np.bool_)],
    )
    try:
        for log_time, time, known in _read_times(planner, clock):
            log_times.append(log_time)
            times.append(time)
            has.append(known)
    except TimeError:
        pass  # the range does not touch this recording
    log_time, time, known = np.concatenate(log_times), np.concatenate(times), np.concatenate(has)
    is_whole = question.is_unbounded and question.predicate is None
    if known.all() and not np.any(time[1:] < time[:-1]):
        return _Times(time, log_time, None, is_whole)
    order = np.argsort(time, kind="stable")
    order = order[known[order]]
    return _Times(time[order], log_time, order, is_whole)


_Block = tuple["NDArray[np.int64]", "NDArray[np.int64]", "NDArray[np.bool_]"]


def _read_times(planner: Planner, clock: Clock) -> Iterator[_Block]:
    """Log times, times on a clock, and whether these are known, in order."""
    if clock == "publish":
        for run in planner.runs():
            batch = run.batch
            yield batch.log_time, batch.publish_time, np.ones(len(batch), np.bool_)
        return
    for part in planner.parts():
        if clock == "log":
            for outcome in planner.outcomes(part):
                chosen = outcome.log_time[outcome.holds]
                yield chosen, chosen, np.ones(len(chosen), np.bool_)
            continue
        for values in planner.values(part, (STAMP,)):
            stamps = stamp_array(values.records)
            if stamps is None:
                none = np.zeros(len(values.log_time), np.int64)
                yield values.log_time, none, none.astype(np.bool_)
                continue
            known = stamps.is_valid().to_numpy(zero_copy_only=False)
            filled = stamps.view("int64").fill_null(0).to_numpy()
            yield values.log_time, filled, known


def _left_out(
    session: Session,
    question: Question,
    read: Sequence[int],
    places: Collection[int],
    sets: int,
) -> tuple[int, str]:
    """The number of messages of a topic that are in no set, and a sentence about them.

    Args:
        session: The open store.
        question: The question about the topic.
        read: Messages in the recordings with all topics, and those with a time on the clock.
        places: Places of these recordings.
        sets: Number of sets.
    """
    summaries = session.snapshot().summaries

    def count(chosen: Collection[int]) -> int:
        own = replace(question, recordings=tuple(summaries[place].id for place in chosen))
        try:
            return Planner(session, own, Counters()).count() if chosen else 0
        except TimeError:
            return 0  # the range does not touch them

    found, timed = read
    if question.predicate is None:
        found = count(places)  # with those that are unreadable
    apart = count({*session.chosen(question).tolist()} - {*places})
    left_out, topic = found + apart - sets, question.topics[0]
    if not left_out:
        return 0, ""
    are = "is" if left_out == 1 else "are"
    text = f"{left_out} of {counted(found + apart, 'message')} of {topic} {are} in no set"
    why = [f"{apart} in recordings without another of the topics"] if apart else []
    if found > timed:
        why.append(f"{found - timed} without a time on the clock")
    return left_out, f"{': '.join([text, ', '.join(why)] if why else [text])}."


def approximate_sets(
    times: Sequence[NDArray[np.int64]], tolerance: int | None = None
) -> NDArray[np.int64]:
    """The sets that `ApproximateTime` makes of the messages of some topics.

    `message_filters` matches messages of several topics so that each is used once, sets do not
    cross, and no smaller set can be made of the messages between two sets. The latest of the
    first messages of all topics is the *pivot*: the set with the shortest duration that holds it
    is the answer. Later sets have to be shorter by the *age penalty* to be preferred.

    This is the algorithm of its C++ version with the defaults: an age penalty of 0.1, no lower
    bounds between messages. Its queue has no limit here, so that nothing is dropped, and a log
    has an end: there, the best set found so far is taken, where a robot would wait for more.

    Args:
        times: Times of the messages of each topic, ns, ascending.
        tolerance: Longest duration of a set, ns (`setMaxIntervalDuration`); None for any.

    Returns:
        int64[k, n]: the row of each topic's message, set by set.
    """
    topics = range(len(times))
    # Views give Python numbers one by one, and take no memory.
    rows = [np.ascontiguousarray(column, np.int64).data for column in times]
    # `first` is the earliest message of a topic that may be in a set with the pivot, and the
    # candidate's, once there is one; `now` is the one that is looked at.
    first = [0] * len(rows)
    now = [0] * len(rows)
    counts = [len(column) for column in rows]
    found = array("q")
    pivot, pivot_time = -1, 0  # the topic; -1 while there is no candidate
    begin = end = 0  # of the candidate
    while True:
        is_over = any(now[n] == counts[n] for n in topics)
        if not is_over:
            heads = [rows[n][now[n]] for n in topics]
            start_time, end_time = min(heads), max(heads)
            start = heads.index(start_time)
            if pivot < 0 and tolerance is not None and end_time - start_time > tolerance:
                now[start] += 1
                first[start] += 1
                continue
            # A later set must be shorter by a tenth of what it ends later.
            is_better = pivot < 0 or 11 * (end_time - end) < 10 * (start_time - begin)
            if pivot < 0:
                pivot = max(n for n in topics if heads[n] == end_time)
                pivot_time = end_time
            if is_better:
                first = list(now)
                begin, end = start_time, end_time
            now[start] += 1
            # Later sets contain the time from the pivot to here, or lack the pivot.
            if start != pivot and 11 * (end_time - end) < 10 * (pivot_time - begin):
                continue
        elif pivot < 0:
            break
        found.extend(first)
        first = [row + 1 for row in first]
        now = list(first)
        pivot = -1
    return np.array(found, np.int64).reshape(-1, len(rows))
