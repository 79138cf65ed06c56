"""Files with what is left of expired messages: the rows of their table, and their documents.

Such a file has the columns of a table, in the order of the chunks. Its `ref` also has the
sender's sequence number, and `left`: size, hash and index document of each message
(`reduced_codec.py`). Unlike a table it is never made again.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.columns.column_file import ChunkFile
from hybridlog.columns.fields import FieldShape, without
from hybridlog.columns.layout import OWN_COLUMNS
from hybridlog.columns.payload_rows import Piece, bytes_of
from hybridlog.columns.rows import Messages, own_columns
from hybridlog.columns.rows import Piece as TablePiece
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.reduced_codec import expired_payloads
from hybridlog.schema.states import State, state_of
from hybridlog_storage.journal import FIELDS
from hybridlog_storage.messages import Batch
from hybridlog_storage.mongo.collection_names import collection_of
from hybridlog_storage.segments.chunk import ExpiredMessages

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from hybridlog.columns.column_file import Place
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.chunk import StoredChunk

_ROW_BYTES: Final = 160  # about what a message takes besides its fields
_OWN: Final = frozenset(OWN_COLUMNS)


def fields_folder(topic: str) -> str:
    """Name of the folder of what is left of a topic's expired messages."""
    return f"{FIELDS}{collection_of(topic)}"


class FieldColumns:
    """Turns messages of one type into rows of what is left of them."""

    arrays: Sequence[Any] = ()

    def __init__(self, channel: Channel) -> None:
        self.folder = fields_folder(channel.topic)
        self._codec = codec_for(channel)
        self._is_reduced = state_of(channel.message_encoding) is State.REDUCED
        self._shape = FieldShape()
        self.replaces: Sequence[str] = ()
        """Paths of the files whose rows the new one has, if there are any."""

    def about(self, layout: object) -> dict[str, Any]:
        """Further metadata of a file."""
        return {"replaces": [*self.replaces]} if self.replaces else {}

    def piece(
        self, chunk: StoredChunk, rows: NDArray[np.intp], has_publish_time: Mapping[int, bool]
    ) -> Piece:
        """Rows of messages.

        Args:
            chunk: The chunk that holds them.
            rows: Their rows in it, ascending; one at least.
            has_publish_time: Whether messages of a channel have a publish time, by channel id.
        """
        batch = chunk.batch.take(rows)
        state = State.REDUCED if self._is_reduced else State.EXPIRED
        piece = TablePiece(chunk.segment, Messages.of(chunk, 0).take(rows), None, state=state)
        decoded = None
        if self._codec.indexed and not self._is_reduced:
            decoded = self._codec.columns(batch.buffer, batch.offset, batch.length)
            piece.errors += [(bad.rows, bad.reason) for bad in decoded.unreadable]
            if len(decoded.rows):
                columns = self._shape.columns(decoded.arrow())
                piece.fields = without(columns, decoded.rows, len(rows))
        if self._is_reduced:
            left = [bytes(batch.payload(row)) for row in range(len(batch))]
        else:
            left = expired_payloads(batch, decoded)
        segment = np.full(len(rows), chunk.segment, np.int32)
        own = own_columns([piece], piece.messages, segment, piece.fields, has_publish_time)
        own["pub"] = pa.array(batch.publish_time)
        ref = own["ref"]
        more = {"sequence": pa.array(batch.sequence), "left": pa.array(left, pa.binary())}
        names = [field.name for field in ref.type]
        own["ref"] = structs({**dict(zip(names, ref.flatten(), strict=True)), **more}, len(rows))
        schema = [pa.field(name, column.type) for name, column in own.items()]
        arrays = [*own.values()]
        if piece.fields is not None:
            schema += list(piece.fields.type)
            arrays += piece.fields.flatten()
        table = pa.Table.from_arrays(arrays, schema=pa.schema(schema))
        size = _ROW_BYTES * len(rows) + sum(map(len, left))
        return Piece(table, table.schema, size)


class FieldFile(ChunkFile):
    """One file with what is left of the expired messages of a topic. Thread safe.

    Attributes:
        replaces: Paths of the files that it was joined of.
    """

    replaces: frozenset[str] = frozenset()

    def _take(self, values: Mapping[str, Any]) -> None:
        super()._take(values)
        self.replaces = frozenset(map(str, values.get("replaces", ())))

    def rows(self, segment: int, chunk: int) -> pa.StructArray:
        """The rows of a chunk; a struct has all columns.

        Raises:
            StoreError: They are damaged.
        """
        place = self.places[segment, chunk]
        return self._group(place).slice(place.begin, place.rows)

    def _group(self, place: Place) -> pa.StructArray:
        return self.cache.made(
            "column",
            self.number,
            place.group,
            make=lambda: self.read(place.group, range(len(self.leaves))).to_struct_array(),
            size_of=lambda one: int(one.nbytes),
        ).combine_chunks()


def newest(files: Sequence[FieldFile], chunk: tuple[int, int]) -> list[FieldFile]:
    """Files with rows of a chunk, without those whose rows a later one has again.

    An expiry that a crash has stopped may have written the same rows before.

    Args:
        files: The files, in the order of the journal.
        chunk: Segment and number of the chunk.

    Raises:
        StoreError: One is damaged.
    """
    if len(files) == 1:
        return [*files]
    found: list[FieldFile] = []
    seen = np.empty(0, np.int64)
    for file in reversed(files):
        offset = file.rows(*chunk).field("ref").field("off").to_numpy(zero_copy_only=False)
        if not np.isin(offset, seen).any():
            seen = np.concatenate([seen, offset])
            found.append(file)
    return found


class Rows(NamedTuple):
    """The rows of a topic in an expired chunk, as table writers and SQL take them.

    Attributes:
        fields: Columns of fields, a struct each; None without any.
        errors: Unreadable rows, each with the reason.
    """

    fields: Any
    errors: list[tuple[NDArray[np.intp], str]]


def rows_of(columns: pa.StructArray) -> Rows:
    """The fields and errors of rows of a file."""
    present = [field for field in columns.type if field.name not in _OWN]
    fields = None
    if present:
        arrays = [columns.field(field.name) for field in present]
        fields = pa.StructArray.from_arrays(arrays, fields=present)
    errors = []
    error = columns.field("error")
    for reason in pc.unique(error.drop_null()).to_pylist():
        found = pc.equal(error, reason).fill_null(fill_value=False)
        errors.append((np.flatnonzero(found.to_numpy(zero_copy_only=False)), reason))
    return Rows(fields, errors)


def expired_messages(parts: Sequence[pa.StructArray]) -> ExpiredMessages:
    """The remains of the messages of a chunk, in its order."""
    batches = [_batch(part) for part in parts]
    offset = np.concatenate([batch.places[0] for batch in batches])
    order = np.argsort(offset, kind="stable")
    row = np.empty(len(order), np.intp)
    row[order] = np.arange(len(order))
    bounds = np.cumsum([0, *map(len, batches)]).tolist()
    fields = [
        (row[begin:end], part) for part, begin, end in zip(parts, bounds, bounds[1:], strict=False)
    ]
    starts = np.cumsum([0, *(len(batch.buffer) for batch in batches)]).tolist()
    batch = Batch(
        b"".join(batch.buffer for batch in batches),
        np.concatenate([b.offset + at for b, at in zip(batches, starts, strict=False)])[order],
        np.concatenate([b.length for b in batches])[order],
        np.concatenate([b.channel for b in batches])[order],
        np.concatenate([b.log_time for b in batches])[order],
        np.concatenate([b.publish_time for b in batches])[order],
        np.concatenate([b.sequence for b in batches])[order],
        np.concatenate([np.stack(b.places, axis=1) for b in batches])[order],
    )
    return ExpiredMessages(batch, fields)


def _batch(part: pa.StructArray) -> Batch:
    def numbers(array: Any, kind: Any) -> NDArray[Any]:
        return array.to_numpy(zero_copy_only=False).astype(kind)

    ref = part.field("ref")
    data, bounds = bytes_of(ref.field("left"))
    place = [numbers(ref.field(name), np.int64) for name in ("off", "len")]
    return Batch(
        data.tobytes(),
        bounds[:-1],
        np.diff(bounds),
        numbers(part.field("channel"), np.int32),
        numbers(part.field("t"), np.int64),
        numbers(part.field("pub"), np.int64),
        numbers(ref.field("sequence"), np.uint32),
        np.stack(place, axis=1),
    )
