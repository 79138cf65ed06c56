"""One topic of an alignment: its messages as tables, with their times on a clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from hybridlog.across.match import UNKNOWN, quaternion_paths
from hybridlog.frames.names import free_name
from hybridlog.query.answers.last_message import message_at
from hybridlog.query.answers.lost import lost_times
from hybridlog.query.counters import Counters
from hybridlog.query.intervals import joined
from hybridlog.query.planner import Planner
from hybridlog.schema.arrow_types import common_type, converted
from hybridlog.schema.column import STAMP
from hybridlog.tf.in_frame import stream
from hybridlog.wording import listed
from hybridlog_storage.errors import TimeError, UsageError
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Clock, Question
    from hybridlog.session import Session


TIME: Final = "log_time"
"""Column of the time of a row."""
RECORDING: Final = "recording"
"""Column of the recording of a row."""
_MAX_NAMES: Final = 3  # recordings in a message


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic of an alignment.

    Attributes:
        question: The question about the topic.
        prefix: Beginning of its columns' names; empty for none.
        is_apart: Its messages may be of other recordings than the rows.
        counters: What reading it costs.
    """

    question: Question
    prefix: str
    is_apart: bool = False
    counters: Counters = field(default_factory=Counters, compare=False)


class TopicReader:
    """Reads one topic with its times on a clock."""

    def __init__(self, session: Session, stream: Stream, clock: Clock) -> None:
        question = stream.question
        if not question.returns_all or question.reverse:
            raise UsageError(
                "An alignment uses all messages; it cannot be combined with limit, every or "
                "reverse."
            )
        self.prefix = stream.prefix
        self._is_apart = stream.is_apart
        if stream.is_apart:
            question = replace(question, names_recording=True)
        self._session = session
        self._counters = stream.counters
        known = session.field_types(question.topics, question.recordings)
        self.quaternions = quaternion_paths(known)
        self._own: str | None = None  # column that only tells the time
        self._clock_column = TIME
        if clock != "log":
            # Refused where the topic does not have the clock.
            on_clock = replace(question, clock=clock, bounds=question.bounds or (None, None))
            Planner(session, on_clock, Counters()).parts()
            self._clock_column = STAMP if clock == "header" else "publish_time"
            question = self._with_clock(question, known)
        self.question = question

    def _with_clock(self, question: Question, known: dict[str, str] | None) -> Question:
        name, fields = self._clock_column, question.fields
        if fields is None:
            if name == STAMP:
                return question
            if known is None:
                raise UsageError("The fields of this topic are not fixed: name them.")
            fields = tuple(dict.fromkeys(path.split(".")[0].split("[")[0] for path in known))
        if not any(path == name or name.startswith(f"{path}.") for path in fields):
            self._own = name
            fields = (*fields, name)
        return replace(question, fields=fields)

    def empty(self) -> tuple[NDArray[np.int64], pa.Table]:
        """No rows, with the columns of all recordings."""
        question = replace(self.question, limit=0, bounds=None, during=None, predicate=None)
        table = next(stream(Planner(self._session, question, Counters())))
        return self._times(table), table

    def tables(
        self, recording: str, span: tuple[int, int] | None = None
    ) -> Iterator[tuple[NDArray[np.int64], pa.Table]]:
        """Times, ns, and columns of the messages of a recording, by log time.

        Args:
            recording: Id of the recording.
            span: Log time `[begin, end)`, ns, of a question without a range.
        """
        if self.elsewhere(recording) is not None:
            return
        question = self._beside(recording)
        if span is not None:
            question = replace(question, bounds=span)
        counters = Counters()
        try:
            for table in stream(Planner(self._session, question, counters)):
                if table.num_rows:
                    yield self._times(table), table
        except TimeError:
            return  # the range does not touch this recording
        finally:
            self._counters.add(counters)

    def elsewhere(self, recording: str) -> str | None:
        """Why no message can be beside the rows of a recording; None if there may be some."""
        snapshot = self._session.snapshot()
        place, places = snapshot.by_id[recording], self._session.chosen(self.question)
        if self._is_apart or place in places:
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
        if self._clock_column == TIME and self.elsewhere(recording) is None:
            with suppress(TimeError):  # the range does not touch this recording
                lost = lost_times(self._session, self._beside(recording))
                # Those that may be of any time explain no row.
                known = (one for one in lost if one.begin_ns > BEGIN)
                spans = sorted((one.begin_ns, one.end_ns, 0) for one in known)
        return joined(np.array(spans, np.int64).reshape(-1, 3))[:, :2]

    def _beside(self, recording: str) -> Question:
        """The question about the messages that may be beside the rows of a recording."""
        return self.question if self._is_apart else replace(self.question, recordings=(recording,))

    def latest(self, recording: str, moment: int) -> int | None:
        """Log time of the last message beside a recording by a time, ns."""
        if moment >= END:
            return None
        question = self._beside(recording)
        found = message_at(self._session, question, self._counters, moment)
        return None if found is None else found.log_time_ns

    def following(self, recording: str, moment: int) -> int | None:
        """Log time just behind the first message beside a recording from a time on, ns."""
        later = replace(self._beside(recording), bounds=(moment, END), limit=1)
        counters = Counters()
        try:
            for run in Planner(self._session, later, counters).runs():
                return min(int(run.batch.log_time[0]) + 1, END)
        except TimeError:
            return moment  # the recording ends before
        finally:
            self._counters.add(counters)
        return moment

    def _times(self, table: pa.Table) -> NDArray[np.int64]:
        column = table[self._clock_column]
        if column.null_count:
            column = column.cast(pa.int64()).fill_null(UNKNOWN)
        whole = column.chunk(0) if column.num_chunks == 1 else column
        times: NDArray[np.int64] = whole.to_numpy().view(np.int64)
        return times

    def named(self, table: pa.Table, first: str, column: Any) -> pa.Table:
        """The columns of the answer, under their names in it.

        Args:
            table: The messages.
            first: Name of the first column, which no field takes.
            column: That column.
        """
        found: dict[str, Any] = {first: column}
        own = {TIME, self._own, *(() if self._is_apart else (RECORDING,))}
        for name, values in zip(table.column_names, table.columns, strict=True):
            if name not in own:
                found[free_name(self.prefix + name, found)] = values
        return pa.table(found)


def concatenated(tables: Sequence[pa.Table]) -> pa.Table:
    """Tables one after the other; a column has the common exact type of all of them."""
    if len(tables) == 1:
        return tables[0]
    if all(table.schema == tables[0].schema for table in tables):
        return pa.concat_tables(tables)
    columns: dict[str, Any] = {}
    for name in dict.fromkeys(chain.from_iterable(table.column_names for table in tables)):
        chunks = [
            table[name].combine_chunks() if name in table.column_names else table.num_rows
            for table in tables
        ]
        arrays = [
            pa.concat_arrays(chunk.chunks) if isinstance(chunk, pa.ChunkedArray) else chunk
            for chunk in chunks
        ]
        kind = common_type([array for array in arrays if not isinstance(array, int)])
        parts = [
            pa.nulls(array, kind) if isinstance(array, int) else converted(array, kind)
            for array in arrays
        ]
        columns[name] = pa.chunked_array(parts, kind)
    return pa.table(columns)
