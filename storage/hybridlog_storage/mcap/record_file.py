"""The bytes of an MCAP file, and the search for its next record behind damage."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog_storage.mcap.mcap_content import RECORD_HEAD

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

HEAD: Final = RECORD_HEAD.size
_SEARCHED: Final = 1 << 20  # bytes searched at once


class RecordFile:
    """A file of records that is read forward; `read` takes an offset and a length.

    `window` bytes are read at once around the heads of records.
    """

    def __init__(self, read: Callable[[int, int], memoryview], size: int, window: int) -> None:
        self.size = size
        self._read = read
        self._ahead = window
        self.forget()

    def forget(self) -> None:
        """Read again what was read before: the file may have changed."""
        self._window = memoryview(b"")
        self._start = 0  # of the window

    def at(self, offset: int, length: int, *, move: bool = False) -> memoryview:
        """Bytes of the file, fewer at its end; `move` reads more than that, for what follows."""
        length = min(length, self.size - offset)
        if length <= 0:
            return memoryview(b"")
        begin = offset - self._start
        if begin >= 0 and begin + length <= len(self._window):
            return self._window[begin : begin + length]
        if not move:
            return self._read(offset, length)
        wanted = max(length, min(self._ahead, self.size - offset))
        self._start, self._window = offset, self._read(offset, wanted)
        if len(self._window) < wanted:  # the file was cut meanwhile
            self.size = offset + len(self._window)
        return self._window[:length]

    def rest(self, offset: int) -> memoryview:
        """The bytes that are in memory, from one on."""
        return self._window[offset - self._start :]

    def search(
        self, start: int, end: int, kinds: Collection[int], proves: Callable[[int], bool]
    ) -> int | None:
        """The first byte of a range where a record of certain kinds proves itself."""
        wanted = np.zeros(256, np.bool_)
        wanted[list(kinds)] = True
        for block in range(start, end - HEAD + 1, _SEARCHED):
            raw = self._read(block, min(_SEARCHED + HEAD - 1, end - block))
            if len(raw) < HEAD:
                return None
            data = np.frombuffer(raw, np.uint8)
            # No length reaches 2^40, which excludes nearly all positions.
            sieve = wanted[data[: 1 - HEAD]]
            sieve &= (data[6:-2] == 0) & (data[7:-1] == 0) & (data[8:] == 0)
            for place in np.flatnonzero(sieve).tolist():
                if proves(block + place):
                    return block + int(place)
        return None
