"""Keys and references of index documents as columns, read from projected documents.

A projection of index documents to their key, or to the place of the payload, has the same
layout in every document. So a batch of thousands of them is read as one numpy array.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog_storage.errors import StoreError
from hybridlog_storage.index_documents import KEY_BYTES, PREFIX_BYTES

if TYPE_CHECKING:
    from numpy.typing import NDArray

KEY: Final = {"_id": 1}
"""The projection that `key_columns` reads."""
REFERENCE: Final = {"_id": 1, "_meta.ref": 1}
"""The projection that `reference_columns` reads."""

_LONG_KEY = bytes([KEY_BYTES + PREFIX_BYTES])
_KEY_VALUE = np.dtype([("time", ">u8"), ("recording", ">u8"), ("seq", ">u8")])


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
        """Number of sorted keys of one recording that are not after a place."""
        low = int(np.searchsorted(self.time, time, "left"))
        high = int(np.searchsorted(self.time, time, "right"))
        return low + int(np.searchsorted(self.seq[low:high], seq, "right"))


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceColumns:
    """Positions of the payloads of messages.

    Attributes:
        recording: uint64[n], key of the recording.
        segment: int64[n], number of the segment.
        chunk: int64[n], number of the chunk in the segment.
        offset: int64[n], start of the payload in the uncompressed chunk.
    """

    recording: NDArray[np.uint64]
    segment: NDArray[np.int64]
    chunk: NDArray[np.int64]
    offset: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of references."""
        return len(self.offset)

    def by_chunk(self) -> Iterator[tuple[tuple[int, int, int], NDArray[np.int64]]]:
        """Recording, segment and chunk with the offsets there, in the order of the documents."""
        order = np.lexsort((self.chunk, self.segment, self.recording))
        places = (self.recording[order], self.segment[order], self.chunk[order])
        is_new = np.any([column[1:] != column[:-1] for column in places], axis=0)
        for rows in np.split(order, np.flatnonzero(is_new) + 1):
            if len(rows):
                first = rows[0]
                place = int(self.recording[first]), int(self.segment[first]), int(self.chunk[first])
                yield place, self.offset[rows]


def key_columns(batch: bytes) -> KeyColumns:
    """The keys of index documents, in document order.

    Args:
        batch: Documents one after the other, projected to `KEY`.

    Raises:
        StoreError: a document is not one of hybridlog's.
    """
    layout, head = _key_layout(_prefix_bytes(batch))
    documents = _documents(batch, layout)
    if len(documents) and (documents["head"] != head).any():
        raise _strange("_id")
    keys = documents["key"]
    return KeyColumns(
        keys["time"].astype(np.int64),
        keys["recording"].astype(np.uint64),
        keys["seq"].astype(np.int64),
    )


def reference_columns(batch: bytes) -> ReferenceColumns:
    """Positions of the payloads of messages, in document order.

    Args:
        batch: Documents one after the other, projected to `REFERENCE`.

    Raises:
        StoreError: a document is not one of hybridlog's.
    """
    layout, text = _reference_layout(_prefix_bytes(batch))
    documents = _documents(batch, layout)
    for name, expected in text.items():
        if len(documents) and (documents[name] != expected).any():
            raise _strange("_meta.ref")
    return ReferenceColumns(
        documents["key"]["recording"].astype(np.uint64),
        documents["seg"].astype(np.int64),
        documents["chunk"].astype(np.int64),
        documents["off"].astype(np.int64),
    )


def _documents(batch: bytes, layout: np.dtype[np.void]) -> NDArray[np.void]:
    if len(batch) % layout.itemsize:
        raise _strange("layout")
    return np.frombuffer(batch, layout)


def _strange(what: str) -> StoreError:
    return StoreError(
        f"An index document has an unexpected {what}. `hybridlog reindex` makes the index anew."
    )


def _prefix_bytes(batch: bytes) -> int:
    """Bytes before the keys of documents, which come from one collection."""
    return PREFIX_BYTES if batch[9:10] == _LONG_KEY else 0


@cache
def _key_layout(prefix: int) -> tuple[np.dtype[np.void], np.void]:
    """The layout of a projected document, and the bytes before its key.

    Args:
        prefix: Bytes before the key.
    """
    size = KEY_BYTES + prefix
    head = struct.pack("<i", size + 15) + b"\x05_id\0" + struct.pack("<iB", size, 0)
    fields = [("head", f"V{len(head)}"), ("prefix", f"V{prefix}"), ("key", _KEY_VALUE)]
    return np.dtype([*fields, ("end", "u1")]), np.void(head)


@cache
def _reference_layout(prefix: int) -> tuple[np.dtype[np.void], dict[str, np.void]]:
    """The layout of a projected document, and the bytes between its values.

    Args:
        prefix: Bytes before the key.
    """
    integers = [("seg", 0x10, "<i4"), ("chunk", 0x12, "<i8"), ("off", 0x12, "<i8")]
    integers.append(("len", 0x12, "<i8"))
    sizes = {"<i4": 4, "<i8": 8}
    inner = 4 + sum(2 + len(name) + sizes[kind] for name, _, kind in integers) + 1
    meta = 4 + len(b"\x03ref\0") + inner + 1
    key = b"\x05_id\0" + struct.pack("<iB", KEY_BYTES + prefix, 0)
    whole = 4 + len(key) + KEY_BYTES + prefix + len(b"\x03_meta\0") + meta + 1
    head = struct.pack("<i", whole) + key
    fields: list[tuple[str, Any]] = [("before key", f"V{len(head)}")]
    fields += [("prefix", f"V{prefix}"), ("key", _KEY_VALUE)]
    expected = {"before key": np.void(head)}
    text = b"\x03_meta\0" + struct.pack("<i", meta)
    text += b"\x03ref\0" + struct.pack("<i", inner)
    for name, tag, kind in integers:
        text += bytes([tag]) + name.encode() + b"\0"
        fields += [(f"before {name}", f"V{len(text)}"), (name, kind)]
        expected[f"before {name}"] = np.void(text)
        text = b""
    fields.append(("end", "V3"))
    expected["end"] = np.void(b"\0\0\0")
    return np.dtype(fields), expected
