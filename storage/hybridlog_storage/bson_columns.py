"""Raw BSON batches as columns: thousands of documents, one numpy operation a field.

Documents of one collection mostly differ in their values only: lengths, element types
and names stand at the same bytes. One document of such a group is walked in Python and
tells where each value lies; the others are compared with it under a mask that leaves
the values out, and each field is then one strided copy. Documents that fit no group
worth its walk are decoded by `bson`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_LENGTH = struct.Struct("<i")
_SMALLEST = 5  # length prefix and terminating NUL
_DEEPEST = 100  # MongoDB's own limit

# Every group costs one walk in Python, about as much as decoding this many documents.
_SMALL_GROUP = 8
_FREE_GROUPS = 32
# Bytes compared for grouping, as a multiple of the batch: documents of one length but
# of very many shapes must not make grouping quadratic.
_COMPARE_BUDGET = 32
_BLOCK_BYTES = 1 << 18  # compared at a time, so that the intermediate arrays stay in cache

_NUMBERS: dict[int, np.dtype[Any]] = {
    0x01: np.dtype("<f8"),
    0x08: np.dtype("?"),
    0x09: np.dtype("<M8[ms]"),
    0x10: np.dtype("<i4"),
    0x12: np.dtype("<i8"),
}


@dataclass(slots=True)
class BsonStrings:
    """A column of strings or binary values.

    Attributes:
        data: uint8, the bytes of all rows one after the other, without terminating NUL.
            UTF-8 is not checked.
        offset: int64[n + 1], row i is `data[offset[i]:offset[i + 1]]`; offset[0] is 0.
        subtype: None for strings, else the subtype of the binary values.
    """

    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    subtype: int | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.offset) - 1


@dataclass(slots=True)
class BsonStringArrays:
    """A column of string arrays of equal length.

    Attributes:
        strings: Row i of the arrays is rows `i * width` to `(i + 1) * width` of these.
        width: Strings a row, at least 1.
    """

    strings: BsonStrings
    width: int

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.strings) // self.width


BsonColumn: TypeAlias = "NDArray[Any] | BsonStrings | BsonStringArrays | list[Any] | None"
"""A column: numbers (n,), arrays of numbers (n, k), dates as datetime64[ms], strings and
binary values, Python values for other types, None if all are null."""


@dataclass(slots=True)
class BsonGroup:
    """Documents of one shape, as columns.

    Attributes:
        rows: Numbers of the documents in the batch, ascending.
        columns: Each leaf by its dotted path, in the order of the documents.
        documents: Only for documents that were decoded one by one; `columns` is empty
            then.
    """

    rows: NDArray[np.intp]
    columns: dict[str, BsonColumn]
    documents: list[dict[str, Any]] | None = None


def split(batch: bytes) -> NDArray[np.int64]:
    """Start of each document in a concatenation of BSON documents.

    Args:
        batch: Documents one after the other, as `find_raw_batches` gives them.

    Returns:
        int64[n], start of each document; each ends where the next starts, the last one
        at the end of `batch`.

    Raises:
        StoreError: The lengths do not add up to the batch.
    """
    end = len(batch)
    pieces: list[NDArray[np.int64]] = []
    single: list[int] = []
    position = 0
    last = equal = 0
    while position < end:
        if end - position < _SMALLEST:
            raise _damaged(position, "the batch ends within a document")
        (length,) = _LENGTH.unpack_from(batch, position)
        if length < _SMALLEST or length > end - position:
            raise _damaged(position, f"a document claims {length} bytes")
        if batch[position + length - 1]:
            raise _damaged(position, "a document does not end with NUL")
        single.append(position)
        position += length
        equal = equal + 1 if length == last else 0
        last = length
        if equal >= 8:
            count = _run(batch, position, length)
            if count:
                pieces.append(np.array(single, np.int64))
                pieces.append(position + length * np.arange(count, dtype=np.int64))
                single = []
                position += count * length
            equal = 0
    pieces.append(np.array(single, np.int64))
    return np.concatenate(pieces)


def _run(batch: bytes, position: int, length: int) -> int:
    """Number of documents of exactly `length` bytes in a row from `position`."""
    possible = (len(batch) - position) // length
    count, window = 0, 32
    while count < possible:
        window = min(window * 4, possible - count)
        start = position + count * length
        lengths = np.ndarray((window,), "<i4", batch, start, (length,))
        ends = np.ndarray((window,), np.uint8, batch, start + length - 1, (length,))
        other = np.flatnonzero((lengths != length) | (ends != 0))
        if len(other):
            return count + int(other[0])
        count += window
    return count


def read_columns(batch: bytes) -> list[BsonGroup]:
    """Read a concatenation of BSON documents by columns.

    Doubles, int32, int64, dates, booleans, nulls, strings, binary values, nested
    documents (by dotted path), arrays of numbers and of strings become columns. An
    empty nested document is a column of empty dicts; an array of anything else is a
    column of lists. Documents with other types, with a dot or a repetition in their
    names, or with a shape that is rare in the batch are decoded with `bson.decode`.

    Args:
        batch: Documents one after the other, as `find_raw_batches` gives them.

    Returns:
        Groups that together hold every document once.

    Raises:
        StoreError: A document is malformed.
    """
    start = split(batch)
    if not len(start):
        return []
    length = np.diff(start, append=len(batch))
    groups: list[BsonGroup] = []
    singles: list[NDArray[np.intp]] = []
    budget = _COMPARE_BUDGET * len(batch)
    most_small = _FREE_GROUPS
    order = np.argsort(length, kind="stable")
    bounds = np.flatnonzero(np.diff(length[order])) + 1
    for rows in np.split(order, bounds):
        rest = rows
        while len(rest):
            size = int(length[rest[0]])
            if budget <= 0 or (len(rest) < _SMALL_GROUP and most_small <= 0):
                singles.append(rest)
                break
            shape = _Shape.of(batch, int(start[rest[0]]), size)
            if shape is None:
                # Each costs a walk without gain; after a few the others are not tried.
                most_small -= 1
                tried = 1 if most_small > 0 else len(rest)
                singles.append(rest[:tried])
                rest = rest[tried:]
                continue
            documents = _gather(batch, start[rest], size)
            budget -= documents.size
            same = _matches(documents, shape)
            found = int(np.count_nonzero(same))
            if found < _SMALL_GROUP:
                most_small -= 1
            if found < len(rest):
                documents = documents[same]
            groups.append(BsonGroup(rest[same], shape.columns(documents)))
            rest = rest[~same]
    if singles:
        groups.append(_decoded(batch, start, length, np.sort(np.concatenate(singles))))
    return groups


def _decoded(
    batch: bytes, start: NDArray[np.int64], length: NDArray[np.int64], rows: NDArray[np.intp]
) -> BsonGroup:
    """Decode documents one by one."""
    documents = [
        _decode(batch[begin : begin + size], begin)
        for begin, size in zip(start[rows].tolist(), length[rows].tolist(), strict=True)
    ]
    return BsonGroup(rows, {}, documents)


def _decode(document: bytes, position: int) -> dict[str, Any]:
    import bson
    from bson.codec_options import CodecOptions, DatetimeConversion

    options: CodecOptions[dict[str, Any]] = CodecOptions(
        datetime_conversion=DatetimeConversion.DATETIME_AUTO
    )
    try:
        return bson.decode(document, options)
    except (bson.errors.BSONError, ValueError, OverflowError, RecursionError) as error:
        raise _damaged(position, str(error)) from error


def _damaged(position: int, what: str) -> StoreError:
    return StoreError(
        f"a batch of index documents is malformed at byte {position}: {what}; "
        "rebuild the index with `hybridlog reindex`"
    )


def _gather(batch: bytes, start: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
    """Copy documents of one size to the rows of a matrix, padded to whole 8-byte words."""
    window = np.ndarray((len(batch) - size + 1,), f"V{size}", batch, 0, (1,))
    documents = np.zeros((len(start), (size + 7) // 8 * 8), np.uint8)
    target = np.ndarray((len(start),), f"V{size}", documents, 0, (documents.shape[1],))
    target[:] = window[start]
    return documents


def _matches(documents: NDArray[np.uint8], shape: _Shape) -> NDArray[np.bool_]:
    """A mask of the documents that equal the template outside its values, shape (n,)."""
    words = documents.shape[1] // 8
    template = np.zeros(words * 8, np.uint8)
    template[: len(shape.template)] = shape.template
    mask = np.zeros(words * 8, np.uint8)
    mask[: len(shape.fixed)] = np.where(shape.fixed, 0xFF, 0)
    wanted, relevant = template.view("<u8"), mask.view("<u8")
    same = np.empty(len(documents), np.bool_)
    step = max(1, _BLOCK_BYTES // (words * 8))
    for begin in range(0, len(documents), step):
        block = documents[begin : begin + step].view("<u8") ^ wanted
        block &= relevant
        np.equal(np.bitwise_or.reduce(block, axis=1), 0, out=same[begin : begin + step])
    return same


class _Unshapely(Exception):  # noqa: N818
    """A document with values that have no column form; `bson` decodes it."""


@dataclass(slots=True)
class _Leaf:
    """Position of a value in every document of a shape.

    Attributes:
        code: BSON type of the value.
        spans: Start and length in bytes of the value; of each element for an array.
        item: For an array of numbers or strings the type of its elements, else 0.
        subtype: Of a binary value.
    """

    code: int
    spans: list[tuple[int, int]]
    item: int = 0
    subtype: int | None = None


@dataclass(slots=True)
class _Shape:
    """The common layout of a group of documents.

    Attributes:
        template: uint8, one of the documents.
        fixed: bool, True at bytes that are not part of a value.
        leaves: Values by dotted path.
    """

    template: NDArray[np.uint8]
    fixed: NDArray[np.bool_]
    leaves: dict[str, _Leaf] = field(default_factory=dict)

    @classmethod
    def of(cls, batch: bytes, start: int, size: int) -> _Shape | None:
        """Walk one document.

        Returns:
            None when the document has to be decoded by `bson`.

        Raises:
            StoreError: The document is malformed.
        """
        document = batch[start : start + size]
        shape = cls(np.frombuffer(document, np.uint8), np.ones(size, np.bool_))
        walk = _Walk(document, start)
        try:
            walk.document(0, size, "", 0)
        except _Unshapely:
            return None
        shape.leaves = walk.leaves
        for leaf in walk.leaves.values():
            for begin, length in leaf.spans:
                shape.fixed[begin : begin + length] = False
        return shape

    def columns(self, documents: NDArray[np.uint8]) -> dict[str, BsonColumn]:
        """The values of documents of this shape.

        Args:
            documents: Shape (n, at least the document's length).

        Returns:
            A column of n rows for each leaf.

        Raises:
            StoreError: A boolean is neither 0 nor 1, or an array is malformed.
        """
        return {path: _column(documents, leaf) for path, leaf in self.leaves.items()}


def _column(documents: NDArray[np.uint8], leaf: _Leaf) -> BsonColumn:
    rows = len(documents)
    if leaf.code in _NUMBERS:
        return _numbers(documents, leaf.code, leaf.spans).reshape(rows)
    if leaf.code in {0x02, 0x05}:
        return _strings(documents, leaf.spans, leaf.subtype)
    if leaf.code == 0x0A:
        return None
    if leaf.code == 0x03:
        return [{}] * rows
    return _arrays(documents, leaf)


def _arrays(documents: NDArray[np.uint8], leaf: _Leaf) -> BsonColumn:
    if leaf.item == 0x02:
        return BsonStringArrays(_strings(documents, leaf.spans, None), len(leaf.spans))
    if leaf.item:
        return _numbers(documents, leaf.item, leaf.spans)
    if not leaf.spans:
        return np.empty((len(documents), 0))
    (begin, length) = leaf.spans[0]
    return _lists(documents[:, begin : begin + length])


def _numbers(
    documents: NDArray[np.uint8], code: int, spans: Sequence[tuple[int, int]]
) -> NDArray[Any]:
    """Values of one type, shape (n, number of spans), native byte order."""
    dtype = _NUMBERS[code]
    out = np.empty((len(documents), len(spans)), dtype.newbyteorder("="))
    for place, (begin, length) in enumerate(spans):
        raw = documents[:, begin : begin + length]
        if code == 0x08 and np.any(raw > 1):
            raise _damaged(begin, "a boolean is neither 0 nor 1")
        out[:, place] = raw.view(dtype)[:, 0]
    return out


def _strings(
    documents: NDArray[np.uint8], spans: Sequence[tuple[int, int]], subtype: int | None
) -> BsonStrings:
    """Strings, document by document and span by span within each."""
    lengths = [length for _, length in spans]
    data = np.concatenate([documents[:, begin : begin + n] for begin, n in spans], axis=1)
    offset = np.zeros(len(documents) * len(spans) + 1, np.int64)
    np.cumsum(np.tile(np.array(lengths, np.int64), len(documents)), out=offset[1:])
    return BsonStrings(data.reshape(-1), offset, subtype)


def _lists(values: NDArray[np.uint8]) -> list[Any]:
    """Arrays of other values as lists; equal bytes are decoded once.

    Args:
        values: Shape (n, bytes of the array, which is a BSON document itself).
    """
    known: dict[bytes, Any] = {}
    out = []
    size = values.shape[1] + 8
    head = _LENGTH.pack(size) + b"\x04v\x00"
    for row in values:
        raw = row.tobytes()
        if raw not in known:
            if len(known) >= 1024:
                known.clear()
            known[raw] = _decode(head + raw + b"\x00", 0)["v"]
        out.append(known[raw])
    return out


class _Walk:
    """Walks one document element by element and checks every length."""

    def __init__(self, document: bytes, origin: int) -> None:
        self._bytes = document
        self._origin = origin
        self.leaves: dict[str, _Leaf] = {}

    def document(self, start: int, end: int, prefix: str, depth: int) -> None:
        """Collect the leaves of the document in bytes `start` to `end`."""
        names: set[str] = set()
        for code, raw_name, position in self._elements(start, end, depth):
            try:
                name = raw_name.decode()
            except UnicodeDecodeError as error:
                raise _damaged(self._origin + position, "a name is not UTF-8") from error
            if "." in name or name in names:
                raise _Unshapely
            names.add(name)
            path = prefix + name
            size = self._size(code, position, end)
            if code == 0x03 and size > _SMALLEST:
                self.document(position, position + size, path + ".", depth + 1)
            elif code == 0x03:
                self._empty(position, size)
                self._add(path, _Leaf(code, []))
            elif code == 0x04:
                self._add(path, self._array(position, position + size, depth + 1))
            else:
                self._add(path, self._value(code, position, size))

    def _add(self, path: str, leaf: _Leaf) -> None:
        self.leaves[path] = leaf

    def _empty(self, position: int, size: int) -> None:
        if self._bytes[position + size - 1]:
            raise self._bad(position, "a document does not end with NUL")

    def _array(self, start: int, end: int, depth: int) -> _Leaf:
        """Collect an array: numbers of one type, strings, or a list of Python values."""
        spans: list[tuple[int, int]] = []
        codes: set[int] = set()
        for code, _, position in self._elements(start, end, depth):
            size = self._size(code, position, end)
            codes.add(code)
            if len(codes) == 1 and (code in _NUMBERS or code == 0x02):
                spans.extend(self._value(code, position, size).spans)
        if len(codes) == 1 and spans:
            return _Leaf(0x04, spans, item=codes.pop())
        if not codes:
            return _Leaf(0x04, [])
        # All bytes but the length are the value: its content may differ.
        return _Leaf(0x04, [(start, end - start)])

    def _value(self, code: int, position: int, size: int) -> _Leaf:
        if code in _NUMBERS:
            return _Leaf(code, [(position, size)])
        if code == 0x02:
            if self._bytes[position + size - 1]:
                raise self._bad(position, "a string does not end with NUL")
            return _Leaf(code, [(position + 4, size - 5)])
        if code == 0x05:
            subtype = self._bytes[position + 4]
            if subtype == 2:  # the old form, with a second length inside
                raise _Unshapely
            return _Leaf(code, [(position + 5, size - 5)], subtype=subtype)
        return _Leaf(code, [])

    def _elements(self, start: int, end: int, depth: int) -> list[tuple[int, bytes, int]]:
        """Type, name and position of each element of a document."""
        data = self._bytes
        (length,) = _LENGTH.unpack_from(data, start)
        if length != end - start or data[end - 1]:
            raise self._bad(start, "a document's length is wrong")
        if depth > _DEEPEST:
            raise self._bad(start, f"documents are nested deeper than {_DEEPEST}")
        found = []
        position = start + 4
        while position < end - 1:
            code = data[position]
            nul = data.find(b"\x00", position + 1, end - 1)
            if nul < 0:
                raise self._bad(position, "a name does not end")
            found.append((code, data[position + 1 : nul], nul + 1))
            position = nul + 1 + self._size(code, nul + 1, end)
        if position != end - 1:
            raise self._bad(position, "a value reaches past its document")
        return found

    def _size(self, code: int, position: int, end: int) -> int:
        """Size of a value in bytes; it ends before byte `end - 1`."""
        if code in _NUMBERS:
            size = _NUMBERS[code].itemsize
        elif code == 0x0A:
            size = 0
        elif code in {0x02, 0x03, 0x04, 0x05}:
            if end - 1 - position < 4:
                raise self._bad(position, "a value reaches past its document")
            (claimed,) = _LENGTH.unpack_from(self._bytes, position)
            least, extra = {0x02: (1, 4), 0x05: (0, 5)}.get(code, (_SMALLEST, 0))
            if claimed < least:
                raise self._bad(position, f"a value claims {claimed} bytes")
            size = claimed + extra
        else:
            raise _Unshapely
        if size > end - 1 - position:
            raise self._bad(position, "a value reaches past its document")
        return size

    def _bad(self, position: int, what: str) -> StoreError:
        return _damaged(self._origin + position, what)
