"""Sets of messages with about the same time, read when they are looked at.

The policy is `ApproximateTime` of ROS, see `approximate_sets`.
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeAlias, overload

import numpy as np
from msgspec.structs import replace

from hybridlog.across.align import TopicReader
from hybridlog.message import Message, messages_in
from hybridlog.query.answers.completeness import completeness_of
from hybridlog.query.answers.current import picture_of
from hybridlog.query.planner import Planner, bounds_in, resolved
from hybridlog.query.question import Clock, Counters, Question
from hybridlog.query.times import DurationLike, parse_duration
from hybridlog.wording import MAX_ROWS, counted, table_html
from hybridlog_storage.errors import StoreError, TimeError, UsageError
from hybridlog_storage.times import span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session


_Times: TypeAlias = "NDArray[np.int64]"
"""int64[3, n] of messages: time on the clock, ns; log time, ns; place among the messages of that
log time that the question finds."""


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
        in_range = [_in_range(session, question) for question in questions]
        near = [one for one in in_range[0] if all(one in other for other in in_range)]
        asked = (replace(question, recordings=tuple(near)) for question in questions)
        readers = [TopicReader(session, question, clock) for question in asked]
        ids: list[str] = []
        # By topic int64[3, n] of each recording, as of `_Times`.
        found = [[np.empty((3, 0), np.int64)] for _ in questions]
        for recording in near:
            read = [reader.moments(recording) for reader in readers]
            if not all(len(one.time) for one in read):
                continue
            epochs = readers[0].epochs(recording)
            longest = min((one for one in (limit, epochs.apart) if one is not None), default=None)
            rows = approximate_sets([one.time for one in read], longest)
            ids += [recording] * len(rows)
            for n, one in enumerate(read):
                message = one.place[rows[:, n]]
                log = one.log_time[message]
                own = one.time[rows[:, n]] - epochs.offsets(log)
                found[n].append(np.stack([own, log, message - one.log_time.searchsorted(log)]))
        for reader in readers:
            self.counters.add(reader.counters)
        self._restarts = readers[0].remarks
        self.recordings = tuple(ids)
        self.left_out = tuple(_count(session, question) - len(ids) for question in questions)
        by_topic = [np.concatenate(parts, axis=1) for parts in found]
        self.times: NDArray[np.int64] = np.stack([times[0] for times in by_topic], axis=1)
        self._topics = list(zip(questions, by_topic, strict=True))

    def __repr__(self) -> str:
        left_out = ", ".join(map(str, self.left_out))
        return f"<Synced {', '.join(self.topics)}; {len(self)} sets, left out: {left_out}>"

    def _repr_html_(self) -> str:
        return table_html(repr(self), [self.topics, *self.times[:MAX_ROWS].tolist()])

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
        session, found = self._opened(), [*self._restarts]
        named = zip(self.topics, self.left_out, strict=True)
        found += (f"In no set: {counted(n, 'message')} of {topic}." for topic, n in named if n)
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
        self, session: Session, question: Question, times: _Times, recording: str, row: int
    ) -> Message:
        _, time, number = map(int, times[:, row])
        span = np.array([span_of(time, time)], np.int64)
        (summary,) = session.summaries_of(replace(question, recordings=(recording,)))
        bounds = None
        if not question.is_by_log_time:
            bounds = bounds_in(session, question, summary)
        planner = Planner(session, question, self.counters)
        runs = planner.scan([*planner.parts_in(summary, span, bounds)], keeps=True).runs()
        messages = [one for run in runs for one in messages_in(run, picture_of(session))]
        if number >= len(messages):
            raise StoreError(
                f"A message of {question.topics[0]} is not in the store any more: make the "
                "sets again."
            )
        return messages[number]


def _in_range(session: Session, question: Question) -> list[str]:
    """Ids of the recordings that a question's range touches, oldest first."""
    with suppress(TimeError):
        return [one.summary.id for one in resolved(session, question)]
    return []


def _count(session: Session, question: Question) -> int:
    with suppress(TimeError):  # the range does not touch the recordings
        return Planner(session, question).count()
    return 0


def approximate_sets(
    times: Sequence[NDArray[np.int64]], tolerance: int | None = None
) -> NDArray[np.int64]:
    """The sets that `ApproximateTime` makes, int64[k, n]: rows of the n topics' messages.

    `message_filters` matches messages of several topics so that each is used once, sets do not
    cross, and no smaller set can be made of the messages between two sets. The latest of the first
    messages of all topics is the *pivot*: the set with the shortest duration that holds it is the
    answer. Later sets have to be shorter by the *age penalty* to be preferred.

    This is the algorithm of its C++ version with the defaults: an age penalty of 0.1, no lower
    bounds between messages. Its queue has no limit here, so that nothing is dropped, and a log has
    an end: there, the best set found so far is taken, where a robot would wait for more.

    Times of the messages of each topic are ns, ascending. The tolerance is the longest duration of
    a set, ns (`setMaxIntervalDuration`); None for any.
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
