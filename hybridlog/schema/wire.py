"""Reads the wire formats of ROS 1 and ROS 2 (CDR) by columns.

For all messages of one type in a chunk, each field is gathered with one numpy operation.
Payloads are untrusted: rows that do not fit their definition are reported with a reason,
and all other rows are read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from msgspec import Struct, field

from hybridlog.schema.codec import Decoded, Unreadable, no_rows
from hybridlog.schema.column import Records, concatenate, take
from hybridlog.schema.wire_program import Wire, compile_type
from hybridlog.schema.wire_walk import MisfitError, Scanner, Source, Walker
from hybridlog_storage.messages import distinct

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from hybridlog.schema.definition import MessageType
    from hybridlog_storage.messages import Buffer

_HEADER = 4  # bytes in front of a message in CDR
_LITTLE = 0x0001
_ORDERS: dict[int, Literal["<", ">"]] = {_LITTLE: "<", 0x0000: ">"}
"""Byte orders of plain CDR, by the first two bytes."""


class _Odd(Struct):
    """Rows to remark: unreadable ones by reason, and those with bytes left over."""

    bad: dict[str, list[NDArray[np.intp]]] = field(default_factory=dict)
    surplus: list[NDArray[np.intp]] = field(default_factory=list)


class WireReader:
    """Reads payloads of one message type.

    `fields` are dotted paths of those to read, top-level or nested (`header.stamp`,
    `transforms[].child_frame_id`; the brackets are optional), each with everything below it; None
    for all. Unknown paths are ignored. Fields that are not read are still checked.
    """

    def __init__(
        self, message_type: MessageType, wire: Wire, fields: Collection[str] | None = None
    ) -> None:
        self._wire: Wire = wire
        self._program = compile_type(message_type, wire, fields)

    def read(self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]) -> Decoded:
        """Read payloads at `offset` of `length` bytes (int64[n]). Never raises for their content.

        Large arrays of a single row may be views into `buffer`.
        """
        offset = np.asarray(offset, np.int64)
        end = offset + np.asarray(length, np.int64)
        odd = _Odd()
        outside = (offset < 0) | (end < offset) | (end > memoryview(buffer).nbytes)
        rows = np.flatnonzero(~outside)
        if len(rows) < len(offset):
            odd.bad["lies outside of the chunk"] = [np.flatnonzero(outside)]
        sources, start = [(Source(buffer, "<"), rows)], offset
        if self._wire == "cdr":
            sources, start = self._by_order(buffer, rows, offset, end, odd), offset + _HEADER
        (good, records), *others = (self._read(*one, start, end, odd) for one in sources)
        for other, more in others:
            both = np.concatenate([good, other])
            order = np.argsort(both)
            good, records = both[order], take(concatenate([records, more]), order)
        unreadable = [Unreadable(np.sort(np.concatenate(r)), why) for why, r in odd.bad.items()]
        surplus = np.sort(np.concatenate(odd.surplus)) if odd.surplus else no_rows()
        return Decoded(good, records, unreadable, surplus)

    def message_in(self, payload: Buffer) -> memoryview:
        """A payload without the bytes that are left over behind its message."""
        view = memoryview(payload)
        start = 0 if self._wire == "ros1" else _HEADER
        order: Literal["<", ">"] = ">" if start and view[:2].tobytes() == b"\0\0" else "<"
        scanner = Scanner(Source(payload, order), self._wire)
        return view[: scanner.walk(self._program, start, len(view), start)]

    def _by_order(
        self,
        buffer: Buffer,
        rows: NDArray[np.intp],
        offset: NDArray[np.int64],
        end: NDArray[np.int64],
        odd: _Odd,
    ) -> list[tuple[Source, NDArray[np.intp]]]:
        """The rows of each byte order of CDR, at least of one, and the buffer for these."""
        short = end[rows] - offset[rows] < _HEADER
        if bool(short.any()):
            odd.bad["is shorter than a CDR header"] = [rows[short]]
            rows = rows[~short]
        little, begin = Source(buffer, "<"), offset[rows]
        kind = little.u1(begin, 0).astype(np.int64) << 8
        kind |= little.u1(begin, 1)
        if bool((kind == _LITTLE).all()):
            return [(little, rows)]
        found = []
        for code in distinct(kind).tolist():
            own = rows[kind == code]
            if code in _ORDERS:
                found.append((Source(buffer, _ORDERS[code]), own))
            else:
                odd.bad[f"encapsulation 0x{code:04x} is not read"] = [own]
        return found or [(little, rows[:0])]

    def _read(
        self,
        source: Source,
        rows: NDArray[np.intp],
        start: NDArray[np.int64],
        end: NDArray[np.int64],
        odd: _Odd,
    ) -> tuple[NDArray[np.intp], Records]:
        """Read rows of one byte order; those that do not fit go to `odd`."""
        walker = Walker(source, self._wire)
        try:
            column, surplus = walker.read(self._program, start[rows], end[rows])
        except MisfitError:
            rows = self._sort_out(source, rows, start, end, odd)
            column, surplus = walker.read(self._program, start[rows], end[rows])
        if surplus is not None:
            odd.surplus.append(rows[surplus])
        if column is None:
            return rows, Records({}, len(rows))
        assert isinstance(column, Records)
        return rows, column

    def _sort_out(
        self,
        source: Source,
        rows: NDArray[np.intp],
        start: NDArray[np.int64],
        end: NDArray[np.int64],
        odd: _Odd,
    ) -> NDArray[np.intp]:
        """Check each row separately; return the valid ones."""
        scanner = Scanner(source, self._wire)
        good = np.ones(len(rows), np.bool_)
        places = zip(rows.tolist(), start[rows].tolist(), end[rows].tolist(), strict=True)
        for index, (row, begin, finish) in enumerate(places):
            try:
                scanner.check(self._program, begin, finish)
            except MisfitError as misfit:
                good[index] = False
                odd.bad.setdefault(str(misfit), []).append(np.array([row], np.intp))
        return rows[good]
