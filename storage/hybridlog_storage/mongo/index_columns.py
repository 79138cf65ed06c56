"""Keys of index documents as columns, read from projected documents.

A projection of index documents to their key has the same layout in every document. So a batch
of thousands of them is read as one numpy array.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog_storage.errors import StoreError
from hybridlog_storage.mongo.index_documents import KEY_BYTES

if TYPE_CHECKING:
    from numpy.typing import NDArray

KEY: Final = {"_id": 1}
"""The projection that `key_columns` reads."""

_HEAD = struct.pack("<i", KEY_BYTES + 15) + b"\x05_id\0" + struct.pack("<iB", KEY_BYTES, 0)
_LAYOUT = np.dtype(
    [
        ("head", f"V{len(_HEAD)}"),
        ("time", ">u8"),
        ("recording", ">u8"),
        ("seq", ">u8"),
        ("end", "u1"),
    ]
)
"""A projected document."""


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
    if len(batch) % _LAYOUT.itemsize:
        raise _strange("layout")
    keys = np.frombuffer(batch, _LAYOUT)
    if (keys["head"] != np.void(_HEAD)).any():
        raise _strange("_id")
    return KeyColumns(
        keys["time"].astype(np.int64),
        keys["recording"].astype(np.uint64),
        keys["seq"].astype(np.int64),
    )


def _strange(what: str) -> StoreError:
    return StoreError(f"An index document has an unexpected {what}: run `hybridlog index rebuild`.")
