"""Repair of byte strings to valid UTF-8."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.schema.column import Strings

if TYPE_CHECKING:
    from numpy.typing import NDArray


def repaired(strings: Strings) -> Strings:
    """The same strings with invalid UTF-8 replaced by U+FFFD.

    Valid strings, by far the usual case, are not copied.
    """
    low, high = int(strings.offset[0]), int(strings.offset[-1])
    data = strings.data[low:high]
    if not len(data) or int(data.max()) < 0x80 or _valid(data, strings.offset - low):
        return strings
    raw = data.tobytes()
    bounds = (strings.offset - low).tolist()
    cells = [raw[begin:end].decode("utf-8", "replace").encode() for begin, end in pairwise(bounds)]
    offset = np.zeros(len(bounds), np.int64)
    np.cumsum([len(cell) for cell in cells], out=offset[1:])
    return Strings(np.frombuffer(b"".join(cells), np.uint8), offset)


def repaired_text(text: str) -> str:
    """The text, with U+FFFD for unpaired surrogates, which UTF-8 cannot encode."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return text.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")
    return text


def _valid(data: NDArray[np.uint8], offset: NDArray[np.int64]) -> bool:
    """True if every string is UTF-8: all bytes are, and no string starts within a character."""
    starts = offset[:-1]
    starts = starts[starts < len(data)]
    if bool(((data[starts] & 0xC0) == 0x80).any()):
        return False
    try:
        data.tobytes().decode()
    except UnicodeDecodeError:
        return False
    return True
