"""One topic of an alignment: its messages as tables, with their times on a clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from hybridlog.across.match import UNKNOWN, quaternion_paths
from hybridlog.frames.names import free_name
from hybridlog.query.answers.current import message_at
from hybridlog.query.answers.lost import lost_times
from hybridlog.query.intervals import joined
from hybridlog.query.planner import Planner
from hybridlog.query.question import Counters
from hybridlog.schema.arrow_types import column_of, common_schema
from hybridlog.schema.column import STAMP
from hybridlog.tf.epochs import Epochs, epochs_of
from hybridlog.tf.in_frame import stream
from hybridlog.wording import listed
from hybridlog_storage.errors import TimeError, UsageError
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Clock, Question
    from hybridlog.session import Session

Block = tuple["NDArray[np.int64]", pa.Table]
"""Times of some messages, ns, and their columns."""
TIME: Final = "log_time"
"""Column of the time of a row."""
RECORDING: Final = "recording"
"""Column of the recording of a row."""
_NO_VALUE: Final = "the message has no such value"
_MAX_NAMES: Final = 3  # recordings in a message


class TopicReader:
    """One topic of an alignment: its messages with their times on a clock.

    The names of its columns begin with the prefix. If it `is_apart`, its messages may be of other
    recordings than the rows.
    """

    def __init__(
        self,
        session: Session,
        question: Question,
        clock: Clock = "log",
        *,
        prefix: str = "",
        is_apart: bool = False,
    ) -> None:
        if not question.returns_all or question.reverse:
            raise UsageError(
                "An alignment uses all messages; it cannot be combined with limit, every or "
                "reverse."
            )
        self.asked = question
        self.prefix = prefix
        self.is_apart = is_apart
        self.counters = Counters()
        self._epochs: dict[str, Epochs] = {}
        self.is_by_log_time = clock == "log"
        self._session = session
        known = session.field_types(question.topics, question.recordings)
        self.quaternions = quaternion_paths(known)
        self._time = {"log": TIME, "publish": "publish_time", "header": STAMP}[clock]
        self._hidden = {TIME} if is_apart else {TIME, RECORDING}
        if is_apart:
            question = replace(question, names_recording=True)
        if clock != "log":
            # Refused where the topic does not have the clock.
            on_clock = replace(question, clock=clock, bounds=(None, None), during=None)
            Planner(session, on_clock).split()
            question = replace(question, fields=self._with_time(question.fields, known))
        self.question = question

    def _with_time(
        self, fields: tuple[str, ...] | None, known: dict[str, str] | None
    ) -> tuple[str, ...] | None:
        """The requested fields and the time on the clock, which is hidden if only we ask."""
        name = self._time
        if fields is None:
            if name == STAMP:
                return None
            if known is None:
                raise UsageError("The fields of this topic are not fixed: name them.")
            fields = tuple(dict.fromkeys(path.split(".")[0].split("[")[0] for path in known))
        if any(path == name or name.startswith(f"{path}.") for path in fields):
            return fields
        self._hidden.add(name)
        return (*fields, name)

    @contextmanager
    def _planned(self, question: Question) -> Iterator[Planner]:
        """A planner whose cost counts; a range that does not touch the recording is left."""
        counters = Counters()
        try:
            with suppress(TimeError):
                yield Planner(self._session, question, counters)
        finally:
            self.counters.add(counters)

    def empty(self) -> pa.Table:
        """No rows, with the columns of all recordings."""
        question = replace(self.question, limit=0, bounds=None, during=None, predicate=None)
        return next(stream(Planner(self._session, question)))

    def tables(self, recording: str, span: tuple[int, int] | None = None) -> Iterator[Block]:
        """The messages beside a recording, by log time.

        The span, log time `[begin, end)` in ns, is for a question without a range.
        """
        if self.elsewhere(recording) is not None:
            return
        question = self._beside(recording)
        if span is not None:
            question = replace(question, bounds=span)
        with self._planned(question) as planner:
            for table in stream(planner):
                if table.num_rows:
                    yield self._times(table, recording), table

    def epochs(self, recording: str) -> Epochs:
        """The epochs of a recording on the clock, looked up once."""
        if self._time != STAMP:
            return Epochs("", np.empty(0, np.int64))
        if recording not in self._epochs:
            self._epochs[recording] = epochs_of(self._session, recording)
        return self._epochs[recording]

    @property
    def remarks(self) -> list[str]:
        """Sentences about recordings whose times start again, as far as they were read."""
        return [one.sentence() for one in self._epochs.values() if len(one.begins)]

    def _times(self, table: pa.Table, recording: str) -> NDArray[np.int64]:
        """Times of messages on the clock, ns, those of other epochs far apart.

        `UNKNOWN` where a stamp is missing or not set.
        """
        times = _ns(table[self._time])
        if self._time != STAMP:
            return times
        offsets = 0 if self.is_apart else self.epochs(recording).offsets(_ns(table[TIME]))
        return np.where((times == 0) | (times == UNKNOWN), UNKNOWN, times + offsets)

    def by_clock(self, recording: str) -> Block:
        """The messages beside a recording that have a time, in memory, by their times."""
        none = self.empty()
        found = [(self._times(none, recording), none), *self.tables(recording)]
        times = np.concatenate([part for part, _ in found])
        order = np.argsort(times, kind="stable")
        order = order[times[order] != UNKNOWN]
        return times[order], concatenated([part for _, part in found]).take(pa.array(order))

    def times(self, recording: str) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Log times of the messages beside a recording, and their times, as of `tables`."""
        if self._time == STAMP:
            yield from ((_ns(table[TIME]), times) for times, table in self.tables(recording))
            return
        with self._planned(replace(self._beside(recording), fields=None)) as planner:
            if not self.is_by_log_time:
                for run in planner.runs():
                    yield run.batch.log_time, run.batch.publish_time
                return
            for part in planner.parts():
                for found in planner.outcomes(part):
                    times = found.log_time[found.holds]
                    planner.counters.messages += len(times)
                    yield times, times

    def elsewhere(self, recording: str) -> str | None:
        """The reason why no message can be beside a recording's rows; None if one may be."""
        snapshot = self._session.snapshot()
        place, places = snapshot.by_id[recording], self._session.chosen(self.question)
        if self.is_apart or place in places:
            return None
        is_near = (snapshot.begin[places] < snapshot.end[place]) & (
            snapshot.begin[place] < snapshot.end[places]
        )
        names = [snapshot.summaries[n].name for n in places[is_near].tolist()]
        if not names:
            return "the messages are of other recordings"
        return (
            "the messages of that time are of other recordings "
            f"({listed(names, _MAX_NAMES)}), which --beside or across_recordings takes"
        )

    def lost(self, recording: str) -> NDArray[np.int64]:
        """int64[n, 2], log time in which messages beside a recording are lost, ns, in order."""
        spans: list[tuple[int, int, int]] = []
        if self.is_by_log_time and self.elsewhere(recording) is None:
            with suppress(TimeError):  # the range does not touch this recording
                lost = lost_times(self._session, self._beside(recording))
                # Those that may be of any time explain no row.
                known = (one for one in lost if one.begin_ns > BEGIN)
                spans = sorted((one.begin_ns, one.end_ns, 0) for one in known)
        return joined(np.array(spans, np.int64).reshape(-1, 3))[:, :2]

    def _beside(self, recording: str) -> Question:
        """The question about the messages that may be beside the rows of a recording."""
        if self.is_apart:
            return self.question
        return replace(self.question, recordings=(recording,))

    def latest(self, recording: str, moment: int) -> int:
        """Log time of the last message beside a recording by a time, ns; that without any."""
        if moment >= END:
            return moment
        found = message_at(self._session, self._beside(recording), self.counters, moment)
        return moment if found is None else found.log_time_ns

    def following(self, recording: str, moment: int) -> int:
        """Log time just behind the first message beside a recording from a time on, ns."""
        later = replace(self._beside(recording), bounds=(moment, END), limit=1)
        with self._planned(later) as planner:
            for run in planner.runs():
                return min(int(run.batch.log_time[0]) + 1, END)
        return moment

    def add(
        self, columns: dict[str, Any], table: pa.Table, blank: Counter[tuple[str, str]], known: int
    ) -> None:
        """Add the columns of messages to those of the rows, under free names.

        `blank` counts rows that have no value, by column and reason, but for those `known` to have
        no message.
        """
        for name, column in zip(table.column_names, table.columns, strict=True):
            if name not in self._hidden:
                free = free_name(self.prefix + name, columns)
                columns[free] = column
                if column.null_count > known:
                    blank[free, _NO_VALUE] += column.null_count - known


def _ns(column: pa.ChunkedArray[Any]) -> NDArray[np.int64]:
    if column.null_count:
        column = column.cast(pa.int64()).fill_null(UNKNOWN)
    whole = column.chunk(0) if column.num_chunks == 1 else column
    times: NDArray[np.int64] = whole.to_numpy().view(np.int64)
    return times


def concatenated(tables: Sequence[pa.Table]) -> pa.Table:
    """Tables one after the other; a column has the common exact type of all of them."""
    if all(table.schema == tables[0].schema for table in tables):
        return pa.concat_tables(tables)
    schema = common_schema(tables)
    columns = [
        pa.chunked_array([c for table in tables for c in column_of(table, one).chunks], one.type)
        for one in schema
    ]
    return pa.Table.from_arrays(columns, schema=schema)
