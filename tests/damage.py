"""Ways to damage files of a store, and what it derives from its recordings."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path


def flip(path: Path, *places: float, bits: int = 1) -> None:
    """Flip bits of some bytes of a file: from its begin or its end, or a share of its length."""
    data = bytearray(path.read_bytes())
    for at in places:
        data[at if isinstance(at, int) else int(len(data) * at)] ^= bits
    path.write_bytes(data)


def _garble(path: Path, first: int = 0) -> None:
    """From a byte on; mongod starts with a collection whose head is whole, and fails later."""
    content = path.read_bytes()
    path.write_bytes(content[:first] + random.Random(1).randbytes(len(content) - first))


def _biggest(data: Path) -> Path:
    return max(data.glob("collection-*"), key=lambda path: path.stat().st_size)


OF_MONGOD: dict[str, Callable[[Path], object]] = {
    "turtle garbled": lambda data: _garble(data / "WiredTiger.turtle"),
    "collection removed": lambda data: _biggest(data).unlink(),
    "collection garbled": lambda data: _garble(_biggest(data), 4096),
}
"""What becomes of the directory `mongod/data` of a store: mongod does not start, or ends when a
question needs the file, or when it reads it."""
