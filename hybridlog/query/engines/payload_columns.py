"""Answers from columns of payloads: arrays in full, without reading messages."""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload"

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.losses import lost_spans
from hybridlog.query.chunk_scan import ChunkKey, RowSelection
from hybridlog.query.engines.base import (
    Need,
    Outcomes,
    UndecidedError,
    Values,
    offsets_by_chunk,
    places_of,
)
from hybridlog.query.predicate.tree import is_meta
from hybridlog_storage.times import inside, touches

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.payloads.reader import PayloadReader
    from hybridlog.query.chunk_scan import ChunkTask
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part
    from hybridlog.session import Session

_OPEN_S = 5e-4  # seconds to query an open file
_BYTE_S = 4e-9  # seconds to read and decode a stored byte
_ROW_S = 2e-7  # seconds for a row


class PayloadColumns:
    """Reads only the columns of the question.

    Args:
        session: The open store.
        counters: Count the bytes that are read.
    """

    def __init__(self, session: Session, counters: Counters) -> None:
        self._session = session
        self._counters = counters

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """By the stored bytes of the columns; None if they cannot tell."""
        readers = self._readers(part, need, fields)
        if readers is None:
            return None
        wanted = _paths(part, fields if need is Need.VALUES else ())
        size = 0
        for reader in readers:
            columns = reader.columns_of(part.channels[0].arrow_type(wanted))
            if columns is None:
                return None
            groups = [g for g in range(reader.file.groups) if not _is_excluded(part, reader, g)]
            size += reader.size(groups, columns)
        each = _BYTE_S * size + _ROW_S * part.messages
        return _OPEN_S + each * max(part.share, 0.01)

    def _readers(
        self, part: Part, need: Need, fields: Collection[str] | None
    ) -> list[PayloadReader] | None:
        """The files of a part in the order of time; None if they cannot answer."""
        listed = [file for file in part.recording.payloads if file["topic"] == part.topic]
        if not listed or sum(file["messages"] for file in listed) != part.messages:
            return None
        if not part.is_by_log_time or (part.predicate is None and need is not Need.VALUES):
            return None
        if any(c.is_reduced or not c.codec.indexed for c in part.channels):
            return None
        if any(True for _ in lost_spans(part.recording)):
            return None
        if not _are_known(part, fields if need is Need.VALUES else ()):
            return None
        return self._session.payload_readers(part.recording, part.topic)

    def count(self, parts: Sequence[Part]) -> int:
        """Number of rows for which the predicate holds.

        Raises:
            UndecidedError: The columns cannot decide.
            StoreError: A file is damaged.
        """
        return sum(int(holds.sum()) for part in parts for _, holds, *_ in self._rows(part))

    def outcomes(self, part: Part) -> Iterator[Outcomes]:
        """The outcome for each row, in order."""
        for keys, holds, *_ in self._rows(part, every=True):
            yield Outcomes(keys[0], keys[1], holds)

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Columns of the rows for which the predicate holds, in order."""
        kind = part.channels[0].arrow_type(fields)
        for (time, seq), holds, table, rows in self._rows(part, fields):
            if not holds.any():
                continue
            yield Values(time[holds], seq[holds], _taken(records_of(table, kind), rows[holds]))

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """References of the rows for which the predicate holds."""
        wanted = {task.key for task in tasks}
        found: dict[ChunkKey, list[NDArray[np.int64]]] = defaultdict(list)
        for part in parts:
            for _, holds, table, rows in self._rows(part, own=("ref",)):
                places = places_of(table.column("ref").combine_chunks())[rows[holds]]
                for key, offsets in offsets_by_chunk(part.recording.id, places).items():
                    if key in wanted:
                        found[key].append(offsets)
        return RowSelection({key: np.sort(np.concatenate(o)) for key, o in found.items()})

    def _rows(
        self,
        part: Part,
        fields: Collection[str] | None = (),
        own: Collection[str] = (),
        *,
        every: bool = False,
    ) -> Iterator[
        tuple[
            tuple[NDArray[np.int64], NDArray[np.int64]],
            NDArray[np.bool_],
            pa.Table,
            NDArray[np.intp],
        ]
    ]:
        """Rows of the part's time: keys, outcomes, a table, and their places in it.

        Row groups whose zones exclude the predicate are left out, or read without their arrays.

        Args:
            part: The part.
            fields: Requested fields.
            own: Columns of ours.
            every: True for rows of all row groups, whatever their zones say.
        """
        readers = self._session.payload_readers(part.recording, part.topic)
        if readers is None:
            raise UndecidedError(f"The columns of {part.topic} are missing.")
        wanted = _paths(part, fields)
        channel = part.channels[0]
        kind, asked = channel.arrow_type(wanted), channel.arrow_type(_paths(part, ()))
        for reader in readers:
            columns = reader.columns_of(kind)
            if columns is None:
                raise UndecidedError(f"The columns of {part.topic} lack a field.")
            names = ["t", "seq", *own, *columns]
            for group in range(reader.file.groups):
                _, first, _, last, _ = reader.file.about.bounds[group]
                if not touches(part.log_windows, first, last):
                    continue
                is_excluded = _is_excluded(part, reader, group)
                if is_excluded and not every:
                    continue
                read = ["t", "seq"] if is_excluded else names
                self._counters.bytes_read += reader.size([group], read)
                table = reader.table(group, read)
                time, seq = (table.column(n).to_numpy() for n in ("t", "seq"))
                rows = np.flatnonzero(inside(time, part.log_windows))
                holds = np.full(len(rows), not is_excluded)
                if part.predicate is not None and not is_excluded:
                    holds = self._holds(part, records_of(table, asked))[rows]
                yield (time[rows], seq[rows]), holds, table, rows

    def _holds(self, part: Part, records: pa.StructArray) -> NDArray[np.bool_]:
        from hybridlog.query.predicate.to_mask import to_mask

        assert part.predicate is not None
        found = to_mask(part.predicate, part.field_types, records)
        if found is None:
            raise UndecidedError(f"The columns of {part.topic} cannot tell.")
        return found


def _taken(records: pa.StructArray, rows: NDArray[np.intp]) -> pa.StructArray:
    """Some rows in their order, without a copy if they are neighbours."""
    first, last = int(rows[0]), int(rows[-1])
    if last - first + 1 == len(rows):
        return records.slice(first, len(rows))
    return records.take(rows)


def _is_excluded(part: Part, reader: PayloadReader, group: int) -> bool:
    """True if zones tell that the predicate holds for no row of a row group."""
    from hybridlog.payloads.zones import may_hold

    return part.predicate is not None and not may_hold(part.predicate.root, reader.zones[group])


def _paths(part: Part, fields: Collection[str] | None) -> set[str] | None:
    """Top-level fields of the predicate, and the requested fields; None for all."""
    if fields is None:
        return None
    asked = part.predicate.fields() if part.predicate is not None else ()
    found = {path.split(".")[0].split("[")[0] for path in asked}
    return found | {path.replace("[]", "") for path in fields}


def _are_known(part: Part, fields: Collection[str] | None) -> bool:
    """True if all fields exist, and the predicate asks for nothing else."""
    types = part.field_types
    if types is None:
        return False
    predicate = part.predicate
    if predicate is not None and any(map(is_meta, predicate.fields())):
        return False
    return all(
        any(name == path or name.startswith((f"{path}.", f"{path}[")) for name in types)
        for path in fields or ()
    )


def records_of(table: pa.Table, kind: Any) -> pa.StructArray:
    """Rows of columns as messages.

    Args:
        table: Has the columns of the fields.
        kind: The type of the messages.
    """
    import pyarrow as pa

    from hybridlog.tables.fields import original_name

    columns = {original_name(table.schema.field(n)): table.column(n) for n in table.column_names}
    arrays = []
    for field in kind:
        column = columns[field.name]
        array = column.chunk(0) if column.num_chunks == 1 else pa.concat_arrays(column.chunks)
        arrays.append(_converted(array, field.type))
    if not arrays:
        return pa.array([{}] * table.num_rows, pa.struct([]))
    return pa.StructArray.from_arrays(arrays, fields=list(kind))


def _converted(array: Any, kind: Any) -> Any:
    """A column as the field of a message."""
    import pyarrow as pa

    from hybridlog.tables.fields import original_name

    if array.type == kind:
        return array
    if pa.types.is_struct(kind) and pa.types.is_struct(array.type):
        names = {original_name(array.type.field(n)): n for n in range(array.type.num_fields)}
        inner = [_converted(array.field(names[field.name]), field.type) for field in kind]
        return pa.StructArray.from_arrays(inner, fields=list(kind))
    if pa.types.is_binary(array.type) and pa.types.is_list(kind):
        _, places, data = array.buffers()
        size = data.size if data is not None else 0
        values = pa.Array.from_buffers(kind.value_type, size, [None, data or pa.py_buffer(b"")])
        return pa.Array.from_buffers(
            kind, len(array), [None, places], offset=array.offset, children=[values]
        )
    try:
        return array.cast(kind)
    except pa.ArrowException as error:
        raise UndecidedError(f"a column has another type: {error}") from error
