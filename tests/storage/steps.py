"""A file system that says what was done in which order, and fails where a test wants it to."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hybridlog_storage.disk import files


class Steps(files.System):
    """Records each step; refuses those from the n-th on.

    Args:
        fail_from: Number of the first step that is refused, from 0; None for none.
        fail_until: Number of the first one behind it that is not refused any more.
        only: What is counted and refused; all steps by default.
    """

    def __init__(
        self,
        *,
        fail_from: int | None = None,
        fail_until: int | None = None,
        only: frozenset[str] | None = None,
    ) -> None:
        self.log: list[tuple[str, str]] = []
        self._count = 0
        self._from = fail_from
        self._until = fail_until
        self._only = only

    def _step(self, what: str, name: str) -> None:
        self.log.append((what, name))
        if self._only is not None and what not in self._only:
            return
        number, self._count = self._count, self._count + 1
        is_late = self._from is not None and number >= self._from
        if is_late and (self._until is None or number < self._until):
            raise OSError(errno.ENOSPC, "no space left")

    def open(self, name: str, flags: int, mode: int = 0o666, *, dir_fd: int | None = None) -> int:
        if flags & os.O_CREAT:
            self._step("create", name)
        return super().open(name, flags, mode, dir_fd=dir_fd)

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        self._step("write", name_of(fd))
        return super().writev(fd, parts)

    def pwritev(self, fd: int, parts: Sequence[memoryview], position: int) -> int:
        self._step("write", name_of(fd))
        return super().pwritev(fd, parts, position)

    def truncate(self, fd: int, length: int) -> None:
        self._step("truncate", name_of(fd))
        super().truncate(fd, length)

    def sync(self, fd: int) -> None:
        self._step("sync", name_of(fd))
        super().sync(fd)

    def rename(self, old: str, new: str, *, src_dir_fd: int, dst_dir_fd: int) -> None:
        self._step("rename", new)
        super().rename(old, new, src_dir_fd=src_dir_fd, dst_dir_fd=dst_dir_fd)

    def unlink(self, name: str, *, dir_fd: int) -> None:
        self._step("unlink", name)
        super().unlink(name, dir_fd=dir_fd)


def name_of(fd: int) -> str:
    """Last part of the path of an open file or folder."""
    return Path(f"/proc/self/fd/{fd}").readlink().name


@contextmanager
def through(system: files.System) -> Iterator[None]:
    """Let all changes of stores go through another system."""
    before, files.system = files.system, system
    try:
        yield
    finally:
        files.system = before
