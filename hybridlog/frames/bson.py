"""Index documents as columns: what the index answers without a payload.

Index documents hold the nearest BSON type; the wire types are given back here. Fields
that a document lacks have no place in a column, so documents are parted by the fields
they have, and a `TableBuilder` puts the parts together again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

import numpy as np

from hybridlog.schema.column import Arrays, Column, Records, Scalars, Strings, concatenate, take
from hybridlog_storage.bson_columns import BsonStringArrays, BsonStrings, read_columns
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from hybridlog_storage.bson_columns import BsonColumn, BsonGroup

INDEX_TYPES: Final[Mapping[str, np.dtype[Any] | None]] = {
    "bool": np.dtype(np.bool_),
    "char": np.dtype(np.uint8),
    **{name: np.dtype(name) for size in (8, 16, 32, 64) for name in (f"int{size}", f"uint{size}")},
    "float32": np.dtype(np.float32),
    "float64": np.dtype(np.float64),
    "time": None,
    "duration": None,
    "string": None,
}
"""Types of single values that come back from the index as they were on the wire. `byte`
is none of them: its sign differs between the ROS versions."""

WireType: TypeAlias = "np.dtype[Any] | str"
"""A dtype or a key of `INDEX_TYPES`."""

INSTANTS: Final[Mapping[str, Literal["time", "duration"]]] = {
    "time": "time",
    "duration": "duration",
}
_ID_BYTES = 24
_KEY = np.dtype([("time", ">u8"), ("recording", ">u8"), ("seq", ">u8")])
_KEY_HEAD = np.void(b"\x27\0\0\0\x05_id\0\x18\0\0\0\0")
"""What stands before the key in a document that has nothing else: 35 bytes, binary, 20 bytes."""
_KEY_DOCUMENT = np.dtype([("head", "V14"), ("key", _KEY), ("end", "u1")])
_REFERENCE = {"seg": "_meta.ref.seg", "chunk": "_meta.ref.chunk", "off": "_meta.ref.off"}


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceColumns:
    """What index documents say about their messages.

    Attributes:
        t: int64[n], log time, ns.
        seq: int64[n], arrival number in the recording.
        seg: int64[n], segment number; -1 when the documents came without it.
        chunk: int64[n], number of the chunk in the segment; -1 likewise.
        off: int64[n], start of the payload in the uncompressed chunk; -1 likewise.
        length: int64[n], bytes of the payload; -1 likewise.
    """

    t: NDArray[np.int64]
    seq: NDArray[np.int64]
    seg: NDArray[np.int64]
    chunk: NDArray[np.int64]
    off: NDArray[np.int64]
    length: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of documents."""
        return len(self.t)

    def take(self, rows: NDArray[np.intp]) -> ReferenceColumns:
        """The chosen documents."""
        return ReferenceColumns(
            self.t[rows],
            self.seq[rows],
            self.seg[rows],
            self.chunk[rows],
            self.off[rows],
            self.length[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class KeyColumns:
    """The keys of index documents.

    Attributes:
        time: int64[n], log time, ns.
        recording: uint64[n], key of the recording.
        seq: int64[n], arrival number in the recording.
    """

    time: NDArray[np.int64]
    recording: NDArray[np.uint64]
    seq: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of keys."""
        return len(self.time)

    def take(self, rows: NDArray[np.intp] | slice) -> KeyColumns:
        """The chosen keys."""
        return KeyColumns(self.time[rows], self.recording[rows], self.seq[rows])

    def place_after(self, time: int, seq: int) -> int:
        """How many keys of one recording, in order, are not after a place."""
        low = int(np.searchsorted(self.time, time, "left"))
        high = int(np.searchsorted(self.time, time, "right"))
        return low + int(np.searchsorted(self.seq[low:high], seq, "right"))


@dataclass(frozen=True, slots=True, eq=False)
class BsonPart:
    """Documents of a batch that have the same fields.

    Attributes:
        rows: Their numbers in the batch, ascending.
        reference: What they say about their messages.
        records: Their fields.
    """

    rows: NDArray[np.intp]
    reference: ReferenceColumns
    records: Records


@dataclass(slots=True)
class _Piece:
    """Documents with the same fields in the same kinds of columns."""

    rows: NDArray[np.intp]
    columns: dict[str, BsonColumn]


def reference_columns(batch: bytes) -> ReferenceColumns:
    """What the index documents of a batch say about their messages, in document order.

    Log time and arrival number are taken from `_meta.t` and `_meta.seq`, or else from
    `_id`.

    Args:
        batch: Documents one after the other, projected to `_meta` or parts of it.

    Raises:
        StoreError: A document is malformed, or has neither `_meta.t` and `_meta.seq`
            nor an `_id`.
    """
    return _references(_pieces(read_columns(batch)))


def key_columns(batch: bytes) -> KeyColumns:
    """The keys of the index documents of a batch, in document order.

    Args:
        batch: Documents one after the other, projected to `_id`.

    Raises:
        StoreError: A document is malformed, or its `_id` is no key of ours.
    """
    if len(batch) % _KEY_DOCUMENT.itemsize:
        raise _strange("_id")
    documents = np.frombuffer(batch, _KEY_DOCUMENT)
    if len(documents) and (documents["head"] != _KEY_HEAD).any():
        raise _strange("_id")
    keys = documents["key"]
    return KeyColumns(
        keys["time"].astype(np.int64),
        keys["recording"].astype(np.uint64),
        keys["seq"].astype(np.int64),
    )


def records_from_bson(
    batch: bytes,
    types: Mapping[str, WireType],
    *,
    with_id: bool = False,
    with_meta: bool = False,
) -> tuple[BsonPart, ...]:
    """The fields of the index documents of a batch as columns.

    Args:
        batch: Documents one after the other.
        types: Wire type by dotted path; for arrays the type of their elements. Paths
            that are not named keep the type of their BSON values, as do values that do
            not fit the named type. Dates come as times.
        with_id: Keep `_id`, as bytes.
        with_meta: Keep `_meta`.

    Returns:
        Documents with the same fields together, in document order within each part.
        Null counts as absent. Nearly always there is one part.

    Raises:
        StoreError: A document is malformed, or says nothing about its place in time.
    """
    pieces = _pieces(read_columns(batch))
    references = _references(pieces)
    families: dict[frozenset[str], list[tuple[NDArray[np.intp], dict[str, Column]]]] = {}
    for piece in pieces:
        columns = {
            path: _column(column, types.get(path))
            for path, column in piece.columns.items()
            if column is not None
            and (with_id or path != "_id")
            and (with_meta or not path.startswith("_meta."))
        }
        families.setdefault(frozenset(columns), []).append((piece.rows, columns))
    parts = []
    for members in families.values():
        for rows, columns in _joined(members):
            parts.append(BsonPart(rows, references.take(rows), _nested(columns, len(rows))))
    return tuple(sorted(parts, key=lambda part: int(part.rows[0])))


def _dtype(wanted: WireType) -> np.dtype[Any] | None:
    if isinstance(wanted, str):
        return INDEX_TYPES.get(wanted)
    return wanted


def _pieces(groups: Iterable[BsonGroup]) -> list[_Piece]:
    """Groups, with documents that were decoded one by one gathered into columns again."""
    pieces = []
    for group in groups:
        if group.documents is None:
            pieces.append(_Piece(group.rows, group.columns))
            continue
        alike: dict[tuple[tuple[str, type], ...], list[int]] = {}
        leaves = [dict(_leaves(document)) for document in group.documents]
        for place, leaf in enumerate(leaves):
            alike.setdefault(tuple((k, type(v)) for k, v in leaf.items()), []).append(place)
        for shape, places in alike.items():
            columns = {path: _values([leaves[p][path] for p in places]) for path, _ in shape}
            pieces.append(_Piece(group.rows[places], columns))
    return pieces


def _leaves(document: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
    """Values by dotted path."""
    pending = list(document.items())[::-1]
    while pending:
        path, value = pending.pop()
        if isinstance(value, dict) and value:
            pending.extend(reversed([(f"{path}.{name}", v) for name, v in value.items()]))
        else:
            yield path, value


def _values(values: list[Any]) -> BsonColumn:
    """Values of one Python type as `read_columns` would give them."""
    first = values[0]
    if first is None:
        return None
    if isinstance(first, (bool, int, float)):
        kinds = {bool: np.bool_, float: np.float64}
        return np.array(values, kinds.get(type(first), np.int64))
    if isinstance(first, (str, bytes)):
        cells = [v.encode("utf-8", "replace") if isinstance(v, str) else v for v in values]
        offset = np.zeros(len(cells) + 1, np.int64)
        np.cumsum([len(cell) for cell in cells], out=offset[1:])
        data = np.frombuffer(b"".join(cells), np.uint8)
        return BsonStrings(data, offset, None if isinstance(first, str) else 0)
    return values


def _references(pieces: Sequence[_Piece]) -> ReferenceColumns:
    rows = sum(len(piece.rows) for piece in pieces)
    found = {name: np.full(rows, -1, np.int64) for name in ("t", "seq", "length", *_REFERENCE)}
    paths = {"length": "_meta.ref.len", **_REFERENCE}
    for piece in pieces:
        found["t"][piece.rows], found["seq"][piece.rows] = _place_in_time(piece)
        for name, path in paths.items():
            column = piece.columns.get(path)
            if column is not None:
                found[name][piece.rows] = _integers(column, path)
    return ReferenceColumns(**found)


def _place_in_time(piece: _Piece) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    time, seq = piece.columns.get("_meta.t"), piece.columns.get("_meta.seq")
    if time is not None and seq is not None:
        return _integers(time, "_meta.t"), _integers(seq, "_meta.seq")
    key = piece.columns.get("_id")
    if isinstance(key, BsonStrings) and bool((np.diff(key.offset) == _ID_BYTES).all()):
        parts = np.ascontiguousarray(key.data[: key.offset[-1]]).view(_KEY)
        return parts["time"].astype(np.int64), parts["seq"].astype(np.int64)
    raise _strange("_meta.t and _meta.seq")


def _integers(column: BsonColumn, path: str) -> NDArray[np.int64]:
    if isinstance(column, np.ndarray) and column.dtype.kind == "i" and column.ndim == 1:
        return column.astype(np.int64, copy=False)
    raise _strange(path)


def _strange(path: str) -> StoreError:
    return StoreError(
        f"index documents do not hold what hybridlog writes as {path}; "
        "rebuild the index with `hybridlog reindex`"
    )


def _column(column: BsonColumn, wanted: WireType | None) -> Column:
    """One BSON column as wire values."""
    if isinstance(column, BsonStrings):
        if column.subtype is None:
            return Strings(column.data, column.offset)
        return Arrays(Scalars(column.data), column.offset)
    if isinstance(column, BsonStringArrays):
        strings = Strings(column.strings.data, column.strings.offset)
        return Arrays(strings, np.arange(len(column) + 1, dtype=np.int64) * column.width)
    if isinstance(column, np.ndarray):
        if column.ndim == 1:
            return _typed(column, wanted)
        rows, width = column.shape
        offset = np.arange(rows + 1, dtype=np.int64) * width
        return Arrays(_typed(column.reshape(-1), wanted), offset)
    return _objects(column or [])


def _typed(values: NDArray[Any], wanted: WireType | None) -> Scalars:
    if values.dtype.kind == "M":
        # Saturating: milliseconds reach further than nanoseconds.
        most = np.iinfo(np.int64).max // 10**6
        return Scalars(np.clip(values.view(np.int64), -most, most) * 10**6, "time")
    if isinstance(wanted, str) and (kind := INSTANTS.get(wanted)) is not None:
        fits = values.dtype.kind == "i"
        return Scalars(values.astype(np.int64), kind) if fits else Scalars(values)
    dtype = None if wanted is None else _dtype(wanted)
    return Scalars(values if dtype is None else _cast(values, dtype))


def _cast(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Values in their wire type; as they are where they do not fit it."""
    found = values.dtype.kind
    if dtype.kind == "f" and found in "if":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    if dtype == np.uint64 and found == "f":
        # Doubles stand for integers from 2^63 on; the last ones round up to 2^64.
        inside = np.clip(values, 0.0, np.nextafter(2.0**64, 0.0))
        integers: NDArray[Any] = np.nan_to_num(inside).astype(dtype)
        return integers
    if dtype.kind in "iu" and found == "i":
        limits = np.iinfo(dtype)
        fits = values.min(initial=0) >= limits.min and values.max(initial=0) <= limits.max
        return values.astype(dtype) if fits else values
    return values


def _objects(values: Sequence[Any]) -> Column:
    """Python values as a column; what is irregular becomes JSON text."""
    kinds = {type(value) for value in values}
    kind = kinds.pop() if len(kinds) == 1 else object
    if issubclass(kind, list):
        offset = np.zeros(len(values) + 1, np.int64)
        np.cumsum([len(value) for value in values], out=offset[1:])
        flat = [item for value in values for item in value]
        return Arrays(_objects(flat) if flat else Scalars(np.empty(0)), offset)
    if issubclass(kind, dict) and len({tuple(value) for value in values}) == 1:
        names = list(values[0])
        return Records({n: _objects([v[n] for v in values]) for n in names}, len(values))
    if issubclass(kind, (bool, int, float, str)):
        return _column(_values(list(values)), None)
    texts = [json.dumps(value, ensure_ascii=False, default=str) for value in values]
    return _column(_values(texts), None)


def _joined(
    members: list[tuple[NDArray[np.intp], dict[str, Column]]],
) -> list[tuple[NDArray[np.intp], dict[str, Column]]]:
    """Pieces with the same fields as one, in document order; apart if kinds differ."""
    if len(members) == 1:
        return members
    signatures: dict[tuple[str, ...], list[tuple[NDArray[np.intp], dict[str, Column]]]] = {}
    paths = list(members[0][1])
    for rows, columns in members:
        signature = tuple(_signature(columns[path]) for path in paths)
        signatures.setdefault(signature, []).append((rows, columns))
    joined = []
    for alike in signatures.values():
        rows = np.concatenate([rows for rows, _ in alike])
        order = np.argsort(rows)
        columns = {
            path: take(concatenate([each[path] for _, each in alike]), order) for path in paths
        }
        joined.append((rows[order], columns))
    return joined


def _signature(column: Column) -> str:
    """What columns must share to be put one after the other."""
    if isinstance(column, Scalars):
        return column.kind
    if isinstance(column, Strings):
        return "string"
    if isinstance(column, Arrays):
        empty = not len(column.values) and isinstance(column.values, Scalars)
        return "[]" if empty else f"[{_signature(column.values)}]"
    inner = (f"{name}:{_signature(value)}" for name, value in column.fields.items())
    return f"{{{','.join(inner)}}}"


def _nested(columns: Mapping[str, Column], rows: int) -> Records:
    """Columns by dotted path as records within records."""
    top = Records({}, rows)
    for path, column in columns.items():
        *parents, name = path.split(".")
        inner = top
        for parent in parents:
            below = inner.fields.setdefault(parent, Records({}, rows))
            if not isinstance(below, Records):
                # A name with a dot in it stands beside the field it seems to be part of.
                inner, name = top, path
                break
            inner = below
        while name in inner.fields:
            name += "_"
        inner.fields[name] = column
    return top
