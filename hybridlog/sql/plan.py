"""The rows of a topic that a query needs: the parts that may have some, and their columns."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import acero

from hybridlog.columns.layout import POINTS
from hybridlog.query.question import Counters
from hybridlog.query.rows import offsets_by_chunk, places_of
from hybridlog.schema.states import State
from hybridlog.sql.columns import (
    OWN,
    ViewColumn,
    fitted,
    lacks,
    summary_values,
)
from hybridlog.sql.pieces import Rows, RowSource, TopicOfRecording
from hybridlog.sql.usage import EVERYTHING, Usage
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog_storage.catalog import RecordingEntry

_TABLE_OWN: Final = frozenset({"log_time", "t", "seq", "pub", "stamp", "state", "error"})
_WORD: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(slots=True)
class Reading:
    """One execution of a query: what it reads, what it may lack, and the first error in that.

    Attributes:
        usage: Fields that the query names.
        counters: Chunks and payloads that were read.
        groups: Row groups that were read, by file and number.
        recordings: Recordings that were read, by id.
        topics: Topics that were read.
        absent: Messages without fields, by topic and state.
        undefined: Topics without fields, with the reason.
    """

    usage: Usage = EVERYTHING
    counters: Counters = field(default_factory=Counters)
    groups: set[tuple[Path, int]] = field(default_factory=set)
    recordings: dict[str, RecordingEntry] = field(default_factory=dict)
    topics: set[str] = field(default_factory=set)
    absent: Counter[tuple[str, State]] = field(default_factory=Counter)
    undefined: dict[str, str] = field(default_factory=dict)
    error: Exception | None = None

    def add(self, recording: TopicOfRecording) -> None:
        """Note a topic of a recording that is read."""
        self.recordings[recording.entry.id] = recording.entry
        self.topics.add(recording.topic)
        for channel in recording.channels.values():
            if channel.codec.reason is not None:
                self.undefined[recording.topic] = channel.codec.reason


def in_window(where: Any, window: tuple[int, int] | None) -> Any:
    """An expression that holds for rows of a window of log time for which another one holds."""
    if window is None:
        return where
    begin, end = window
    inside = pc.field("t") >= begin
    if end < END:  # a range without an end holds the last time, too
        inside &= pc.field("t") < end
    return inside if where is None else inside & where


class Plan:
    """Reads some columns of a topic, where the expression `where` holds (None for all rows)."""

    def __init__(
        self,
        schema: Any,
        fields: Mapping[str, ViewColumn],
        columns: Sequence[str],
        where: Any,
        reading: Reading,
    ) -> None:
        self.where = where
        self._reading = reading
        self._columns = list(columns)
        self._schema = schema
        self._tested = [] if where is None else _named(str(where), schema.names)
        read = list(dict.fromkeys([*self._columns, *self._tested]))
        self._fields = {name: fields[name] for name in read if name in fields}
        self._leaves = {
            leaf.source + (("",) if leaf.is_summary else ()): leaf
            for column in self._fields.values()
            for path, leaf in column.leaves()
            if reading.usage.uses(path)
        }
        self._own = {name for name in read if name in _TABLE_OWN}

    def read(self, recording: TopicOfRecording, source: RowSource) -> Iterator[pa.RecordBatch]:
        """The rows of a source."""
        absent = {key: leaf for key, leaf in self._leaves.items() if _is_absent(leaf, source)}
        # The summary of a nested array tells where the struct above it is missing.
        held = [
            leaf for key, leaf in self._leaves.items() if key not in absent or len(leaf.source) > 1
        ]
        own = self._own | ({"ref"} if absent else set())
        own |= {POINTS for leaf in held if leaf.is_points}
        held = [leaf for leaf in held if not leaf.is_points]
        paths = _paths(held, summaries=source.has_summaries)
        self._reading.groups |= source.groups
        for rows in source.read(paths, own, self._reading.counters):
            self._remark(recording.topic, rows, lacks_arrays=bool(absent))
            if absent:
                yield from self._with_payloads(recording, rows, absent)
            else:
                yield from self._finished(recording, rows, self.where)

    def _with_payloads(
        self,
        recording: TopicOfRecording,
        rows: Rows,
        absent: Mapping[tuple[str, ...], ViewColumn],
    ) -> Iterator[pa.RecordBatch]:
        """Rows with arrays from payloads; of these as few as possible are decoded."""
        where, chosen = self.where, np.ones(rows.size, np.bool_)
        if where is not None and not _named(str(where), [one.name for one in absent.values()]):
            known = self._batch(recording, rows, self._tested, absent)
            chosen = _mask(known, where).to_numpy(zero_copy_only=False)
            where = None
        is_whole = chosen
        if "state" in rows.own:
            states = pc.equal(rows.own["state"], State.WHOLE.value)
            is_whole = chosen & states.to_numpy(zero_copy_only=False)
            gone = np.flatnonzero(chosen & ~is_whole)
            if len(gone):
                yield from self._finished(recording, _taken(rows, gone), where, absent)
        places = offsets_by_chunk(recording.entry.id, places_of(rows.own["ref"])[is_whole])
        paths = _paths(self._leaves.values())
        own = {POINTS for leaf in self._leaves.values() if leaf.is_points}
        for (_, segment, chunk), offsets in places.items():
            source = recording.chunk_rows(segment, chunk)
            for part in source.read(paths, own, self._reading.counters, offsets):
                yield from self._finished(recording, part, where)

    def _finished(
        self,
        recording: TopicOfRecording,
        rows: Rows,
        where: Any,
        absent: Collection[tuple[str, ...]] = (),
    ) -> Iterator[pa.RecordBatch]:
        """Rows for which an expression holds, with the columns to return."""
        mask = None
        if where is not None:
            mask = _mask(self._batch(recording, rows, self._tested, absent), where)
            if not mask.true_count:
                return
        batch = self._batch(recording, rows, self._columns, absent)
        found = batch if mask is None or mask.true_count == len(mask) else batch.filter(mask)
        if found.num_rows:
            yield found

    def _batch(
        self,
        recording: TopicOfRecording,
        rows: Rows,
        names: Sequence[str],
        absent: Collection[tuple[str, ...]],
    ) -> pa.RecordBatch:
        """Columns of some rows; those of absent fields are null."""

        def leaf(column: ViewColumn) -> Any:
            key = column.source + (("",) if column.is_summary else ())
            if key not in self._leaves or key in absent:
                return None
            is_points = column.is_points
            array = rows.own.get(POINTS) if is_points else _at(rows.records, column.source)
            if array is None:
                return None
            return (summary_values if column.is_summary else fitted)(array, column.kind)

        def missing(path: tuple[str, ...]) -> Any:
            array = _at(rows.records, path)
            if array is None:
                return pa.array(np.ones(rows.size, np.bool_))
            return array.is_null() if array.null_count else None

        arrays = []
        schema = pa.schema([self._schema.field(name) for name in names])
        for name in names:
            if name in self._fields:
                arrays.append(self._fields[name].values(leaf, rows.size, missing))
            elif name in rows.own:
                arrays.append(rows.own[name].cast(schema.field(name).type))
            else:
                arrays.append(_constant(name, recording.entry, rows.size))
        return pa.RecordBatch.from_arrays(arrays, schema=schema)

    def _remark(self, topic: str, rows: Rows, *, lacks_arrays: bool) -> None:
        states = rows.own.get("state")
        if states is None:
            return  # all are whole
        for found in pc.value_counts(states).to_pylist():
            state = State(found["values"])
            is_told = lacks_arrays or state is State.UNREADABLE
            if is_told and state is not State.WHOLE:
                self._reading.absent[topic, state] += found["counts"]


def _mask(batch: pa.RecordBatch, where: Any) -> Any:
    """For each row, whether an expression holds; false where it is null."""
    options = acero.ProjectNodeOptions([where], ["holds"])
    source = acero.TableSourceNodeOptions(pa.Table.from_batches([batch]))
    plan = acero.Declaration.from_sequence(
        [acero.Declaration("table_source", source), acero.Declaration("project", options)]
    )
    found = plan.to_table(use_threads=False).column(0).combine_chunks()
    return found.fill_null(False) if found.null_count else found


def _named(text: str, names: Sequence[str]) -> list[str]:
    """Names of columns that may be in the text of an expression; some of them are not."""
    words = set(_WORD.findall(text))
    return [name for name in names if name in words or not _WORD.fullmatch(name)]


def _is_absent(leaf: ViewColumn, source: RowSource) -> bool:
    """True if a source has only summaries of an array."""
    if leaf.is_points:
        return not source.has_points
    if leaf.is_summary or source.is_whole:
        return False
    kinds = (_type_at(kind, leaf.source) for kind in source.kinds(_paths([leaf])))
    return any(kind is not None and lacks(kind, leaf.kind) for kind in kinds)


def _paths(leaves: Collection[ViewColumn], *, summaries: bool = False) -> list[str] | None:
    """Dotted paths of fields, or of numbers of their summaries; None if a name has a dot itself."""
    if any("." in name or "[" in name for leaf in leaves for name in leaf.source):
        return None
    found: dict[str, None] = {}
    for leaf in leaves:
        path = ".".join(leaf.source)
        if summaries and leaf.is_summary:
            found |= dict.fromkeys(f"{path}.{field.name}" for field in leaf.kind)
        else:
            found[path] = None
    return list(found)


def _at(records: Any, path: Sequence[str]) -> Any:
    """Values at a path, null where a struct above is; None if there are none."""
    return None if _type_at(records.type, path) is None else pc.struct_field(records, [*path])


def _type_at(kind: Any, path: Sequence[str]) -> Any:
    for name in path:
        place = kind.get_field_index(name) if pa.types.is_struct(kind) else -1
        if place < 0:
            return None
        kind = kind.field(place).type
    return kind


def _constant(name: str, entry: RecordingEntry, rows: int) -> Any:
    """A column with the same value for all rows of a recording."""
    if name == "recording":
        return pa.repeat(pa.scalar(entry.name), rows)
    tags = pa.array([list(entry.tags.items())], OWN.field("tags").type)
    return tags.take(pa.array(np.zeros(rows, np.int64)))


def _taken(rows: Rows, chosen: NDArray[np.intp]) -> Rows:
    places = pa.array(chosen)
    own = {name: column.take(places) for name, column in rows.own.items()}
    return Rows(own, rows.records.take(places), len(chosen))
