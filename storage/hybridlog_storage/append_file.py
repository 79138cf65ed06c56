"""A file that only grows, written past the page cache where the file system allows it.

What a recorder writes it does not read again, so copying it into the page cache first
costs a processor's time twice, then stalls whoever writes next when the kernel decides
to clean up. Direct writes take neither, but must start and end at whole blocks: so the
bytes behind the last whole block stay here too, and are written again, with zeros up to
the next block, together with what follows. A file that nobody closed may therefore end
in up to a block of zeros. Large content that starts at a block, in memory and in the
file, is written from where it lies; everything else is staged.
"""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from hybridlog_storage import files
from hybridlog_storage.buffers import buffers
from hybridlog_storage.durability import left_over, sync_file, write_all
from hybridlog_storage.messages import Buffer

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK = 4096
"""Bytes of a block; every device's own blocks divide it."""
_STAGE = 4 << 20
DIRECT: int = getattr(os, "O_DIRECT", 0)
"""Flag of direct reads and writes, 0 where there are none."""
_OWN = 1 << 18  # bytes from which content is not staged; buffers of the pool start at a block
_REFUSED = {errno.EINVAL, errno.EOPNOTSUPP}


class AppendFile:
    """One file, open for appending.

    Args:
        fd: The file; it is closed with this object.
        position: Its length, bytes; 0 for direct writes.
        direct: Whether it was opened for direct writes.
    """

    def __init__(self, fd: int, position: int = 0, *, direct: bool = False) -> None:
        self.position = position
        """Bytes in the file."""
        self._fd = fd
        self._stage = buffers.take(_STAGE) if direct else None
        self._filled = 0  # bytes in the stage
        self._begun = 0  # those before are about to be written, with other pieces behind them
        self._written = 0  # byte of the file up to which whole blocks lie there

    @classmethod
    def create(cls, path: Path) -> Self:
        """A new file of a recording.

        Raises:
            OSError: It exists, or cannot be made.
        """
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
        if DIRECT:
            try:
                return cls(files.open_file(path, flags | DIRECT), direct=True)
            except OSError as error:
                if error.errno not in _REFUSED:
                    raise
                with suppress(FileNotFoundError):
                    files.unlink(path)  # some systems refuse only after they have made it
        return cls(files.open_file(path, flags))

    @classmethod
    def reopen(cls, path: Path) -> Self:
        """An ordinary file that is there already.

        Raises:
            OSError: It cannot be opened for writing, or is no ordinary file.
        """
        fd = files.open_file(path, os.O_RDWR | os.O_NONBLOCK)
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            os.close(fd)
            raise OSError(errno.EINVAL, "it is no ordinary file", str(path))
        return cls(fd, os.lseek(fd, 0, os.SEEK_END))

    @property
    def direct(self) -> bool:
        """Whether what was appended is on the disk already, but for the file's length."""
        return self._stage is not None

    def append(self, parts: Sequence[Buffer]) -> None:
        """Write all parts at the end; they are in the file when this returns.

        Raises:
            OSError: when the system refuses; the file is then as it was before.
        """
        before = self.position
        try:
            self._append(parts)
        except OSError:
            self._step_back(before)
            raise

    def _append(self, parts: Sequence[Buffer]) -> None:
        if self._stage is None:
            self.position += write_all(self._fd, parts)
            return
        pieces: list[NDArray[np.uint8]] = []
        for part in filter(len, parts):
            content = np.frombuffer(part, np.uint8)
            if self.position % BLOCK == 0 and _is_own(content):
                whole = len(content) - len(content) % BLOCK
                pieces += [self._stage[self._begun : self._filled], content[:whole]]
                self._begun = self._filled
                self.position += whole
                content = content[whole:]
            while len(content):
                piece = content[: _STAGE - self._filled]
                self._stage[self._filled : self._filled + len(piece)] = piece
                self._filled += len(piece)
                self.position += len(piece)
                content = content[len(piece) :]
                if self._filled == _STAGE:
                    self._put(pieces)
                    pieces = []
        self._put(pieces)

    def room_before(self, content: Buffer, position: int) -> int:
        """Bytes to leave free, so that large content need not be copied to be written.

        Args:
            content: What is about to be appended.
            position: Byte of the file where it would begin.

        Returns:
            0 where it makes no difference.
        """
        if self._stage is None or not _is_own(np.frombuffer(content, np.uint8)):
            return 0
        return -position % BLOCK

    def cut(self, position: int) -> None:
        """Drop everything from a position on; not for direct writes.

        Raises:
            OSError: when the system refuses.
        """
        assert self._stage is None
        files.system.truncate(self._fd, position)
        os.lseek(self._fd, position, os.SEEK_SET)
        self.position = position

    def rewrite(self, position: int, data: Buffer) -> None:
        """Write over bytes that are in the file; not for direct writes.

        Raises:
            OSError: when the system refuses; some of them may have been written by then.
        """
        assert self._stage is None
        assert position + len(data) <= self.position
        pieces = [memoryview(data)]
        while pieces:
            done = files.system.pwritev(self._fd, pieces, position)
            position += done
            pieces = left_over(pieces, done)

    def finish(self, *, sync: bool) -> None:
        """Give the file its exact length and close it.

        Args:
            sync: Return once everything is on the disk.

        Raises:
            OSError: when the system refuses.
        """
        try:
            if os.fstat(self._fd).st_size != self.position:
                files.system.truncate(self._fd, self.position)
            if sync:
                self.sync()
        finally:
            self.close()

    def sync(self) -> None:
        """Return once everything appended is on the disk."""
        sync_file(self._fd)

    def close(self) -> None:
        """Give the file back as it is."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _step_back(self, position: int) -> None:
        """Forget a write that failed: what lay before it is whole, and can be added to.

        What is added is not written past the page cache any more: little is.
        """
        self._stage = None
        self.position = position
        flags = fcntl.fcntl(self._fd, fcntl.F_GETFL)
        fcntl.fcntl(self._fd, fcntl.F_SETFL, flags & ~DIRECT)
        os.lseek(self._fd, position, os.SEEK_SET)
        with suppress(OSError):  # what is added is written over it, and `finish` cuts the rest
            files.system.truncate(self._fd, position)

    def _put(self, pieces: list[NDArray[np.uint8]]) -> None:
        """Write pieces and what was staged behind them; keep what is behind the last block."""
        assert self._stage is not None
        whole = self._filled - self._filled % BLOCK
        rest = self._filled - whole
        end = whole + BLOCK if rest else whole
        self._stage[self._filled : end] = 0
        pieces.append(self._stage[self._begun : end])
        self._write([piece.data for piece in pieces if len(piece)], self._written)
        self._written = self.position - rest
        self._stage[:rest] = self._stage[whole : self._filled].copy()
        self._filled, self._begun = rest, 0

    def _write(self, pieces: list[memoryview], position: int) -> None:
        while pieces:
            try:
                done = files.system.pwritev(self._fd, pieces, position)
            except OSError as error:
                if error.errno not in _REFUSED:
                    raise
                # Some file systems take the flag and refuse the write. Blocks stay whole,
                # so nothing else changes.
                self._give_up_direct(error)
                continue
            position += done
            pieces = left_over(pieces, done)

    def _give_up_direct(self, error: OSError) -> None:
        flags = fcntl.fcntl(self._fd, fcntl.F_GETFL)
        if not flags & DIRECT:
            raise error
        fcntl.fcntl(self._fd, fcntl.F_SETFL, flags & ~DIRECT)


def _is_own(content: NDArray[np.uint8]) -> bool:
    """Whether content may be written from where it lies."""
    return len(content) >= _OWN and content.ctypes.data % BLOCK == 0
