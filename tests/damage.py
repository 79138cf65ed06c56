"""Ways to damage files of a store, and what it derives from its recordings."""

from __future__ import annotations

from pathlib import Path


def flip(path: Path, *places: float, bits: int = 1) -> None:
    """Flip bits of some bytes of a file: from its begin or its end, or a share of its length."""
    data = bytearray(path.read_bytes())
    for at in places:
        data[at if isinstance(at, int) else int(len(data) * at)] ^= bits
    path.write_bytes(data)
