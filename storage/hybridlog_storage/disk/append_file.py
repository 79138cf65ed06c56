"""A file that only grows, written past the page cache where the file system allows it.

A recorder does not read its own output again. Copying it into the page cache costs
processor time, and stalls later writers when the kernel flushes the cache. Direct writes
avoid both, but must start and end at whole blocks. So the bytes behind the last whole
block also stay in memory; the next write repeats them, padded with zeros to a whole block.
A file that was never closed may therefore end in up to a block of zeros.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import stat
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np
from blake3 import blake3

from hybridlog_storage.disk import files
from hybridlog_storage.messages import Buffer

BLOCK = 4096
"""Bytes of a block; a multiple of every device's block size."""
_STAGE = 1 << 20  # a recorder has up to 32 files open
DIRECT: int = getattr(os, "O_DIRECT", 0)
"""Flag of direct writes, 0 if not supported."""
_REFUSED = {errno.EINVAL, errno.EOPNOTSUPP}


class AppendFile:
    """A file open for appending, of `position` bytes: 0 for direct writes. It closes `fd`."""

    def __init__(self, fd: int, position: int = 0, *, direct: bool = False) -> None:
        self.position = position
        """Bytes in the file."""
        self._fd = fd
        self._hasher = None if position else blake3()  # of all that was appended
        # Whole pages, as direct writes need them.
        self._stage = np.frombuffer(mmap.mmap(-1, _STAGE), np.uint8) if direct else None
        self._filled = 0  # bytes in the stage
        self._written = 0  # byte of the file up to which whole blocks are written

    @classmethod
    def create(cls, path: Path) -> Self:
        """Create a file of a recording."""
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
        if DIRECT:
            try:
                return cls(files.open_file(path, flags | DIRECT), direct=True)
            except OSError as error:
                if error.errno not in _REFUSED:
                    raise
                with suppress(FileNotFoundError):
                    files.unlink(path)  # some systems create the file before they refuse
        return cls(files.open_file(path, flags))

    @classmethod
    def reopen(cls, path: Path) -> Self:
        """Open an existing ordinary file."""
        fd = files.open_file(path, os.O_RDWR)
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            os.close(fd)
            raise OSError(errno.EINVAL, "it is not an ordinary file", str(path))
        return cls(fd, os.lseek(fd, 0, os.SEEK_END))

    def append(self, parts: Sequence[Buffer]) -> None:
        """Append all parts; they are in the file when this returns, and none after an `OSError`."""
        before = self.position
        try:
            self._append(parts)
        except OSError:
            hasher = self._hasher
            with suppress(OSError):  # later writes overwrite it, and `finish` cuts the rest
                self.cut(before)
            self._hasher = hasher
            raise
        if self._hasher is not None:
            for part in parts:
                self._hasher.update(part)

    def digest(self) -> str:
        """BLAKE3 of all bytes of the file, in hexadecimal digits."""
        if self._hasher is None:
            self._hasher = blake3()
            for at in range(0, self.position, _STAGE):
                self._hasher.update(files.pread(self._fd, min(_STAGE, self.position - at), at))
        return self._hasher.hexdigest()

    def _append(self, parts: Sequence[Buffer]) -> None:
        if self._stage is None:
            self.position += files.write_all(self._fd, parts)
            return
        for part in filter(len, parts):
            content = np.frombuffer(part, np.uint8)
            while len(content):
                piece = content[: _STAGE - self._filled]
                self._stage[self._filled : self._filled + len(piece)] = piece
                self._filled += len(piece)
                self.position += len(piece)
                content = content[len(piece) :]
                if self._filled == _STAGE:
                    self._put()
        self._put()

    def cut(self, position: int) -> None:
        """Truncate the file at a position. Later writes go through the page cache; they are few.

        If the system refuses, they overwrite what is behind it.
        """
        self._stage = self._hasher = None
        self.position = position
        self._leave_direct()
        os.lseek(self._fd, position, os.SEEK_SET)
        files.system.truncate(self._fd, position)

    def rewrite(self, position: int, data: Buffer) -> None:
        """Overwrite bytes of the file, some also if it fails; not for direct writes."""
        assert self._stage is None
        assert position + len(data) <= self.position
        self._hasher = None
        self._write([memoryview(data)], position)

    def finish(self, *, sync: bool) -> None:
        """Set the file's exact length and close it."""
        try:
            if os.fstat(self._fd).st_size != self.position:
                files.system.truncate(self._fd, self.position)
            if sync:
                self.sync()
        finally:
            self.close()

    def sync(self) -> None:
        """Return once everything appended is on the disk."""
        files.system.sync(self._fd)

    def close(self) -> None:
        """Close the file as it is."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _put(self) -> None:
        """Write the staged bytes; stage those behind the last block again."""
        assert self._stage is not None
        whole = self._filled - self._filled % BLOCK
        rest = self._filled - whole
        end = whole + BLOCK if rest else whole
        self._stage[self._filled : end] = 0
        self._write([self._stage[:end].data] if end else [], self._written)
        self._written = self.position - rest
        self._stage[:rest] = self._stage[whole : self._filled].copy()
        self._filled = rest

    def _write(self, pieces: list[memoryview], position: int) -> None:
        while pieces:
            try:
                done = files.system.pwritev(self._fd, pieces, position)
            except OSError as error:
                # Some file systems take the flag and refuse the write. Blocks stay whole,
                # so nothing else changes.
                if error.errno not in _REFUSED or not self._leave_direct():
                    raise
                continue
            position += done
            pieces = files.left_over(pieces, done)

    def _leave_direct(self) -> bool:
        """Write by way of the page cache from now on; False if that is so already."""
        flags = fcntl.fcntl(self._fd, fcntl.F_GETFL)
        fcntl.fcntl(self._fd, fcntl.F_SETFL, flags & ~DIRECT)
        return bool(flags & DIRECT)
