"""Keys of index documents as columns, read from projected documents.

A projection of index documents to their key has the same layout in every document. So a batch
of thousands of them is read as one numpy array.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog_storage.errors import StoreError
from hybridlog_storage.mongo.index_documents import KEY_BYTES, PREFIX_BYTES

if TYPE_CHECKING:
    from numpy.typing import NDArray

KEY: Final = {"_id": 1}
"""The projection that `key_columns` reads."""

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


def _documents(batch: bytes, layout: np.dtype[np.void]) -> NDArray[np.void]:
    if len(batch) % layout.itemsize:
        raise _strange("layout")
    return np.frombuffer(batch, layout)


def _strange(what: str) -> StoreError:
    return StoreError(f"An index document has an unexpected {what}: run `hybridlog index rebuild`.")


def _prefix_bytes(batch: bytes) -> int:
    """Bytes before the keys of documents, which come from one collection."""
    return PREFIX_BYTES if batch[9:10] == _LONG_KEY else 0


@cache
def _key_layout(prefix: int) -> tuple[np.dtype[np.void], np.void]:
    """The layout of a projected document, and the bytes before its key."""
    size = KEY_BYTES + prefix
    head = struct.pack("<i", size + 15) + b"\x05_id\0" + struct.pack("<iB", size, 0)
    fields = [("head", f"V{len(head)}"), ("prefix", f"V{prefix}"), ("key", _KEY_VALUE)]
    return np.dtype([*fields, ("end", "u1")]), np.void(head)
