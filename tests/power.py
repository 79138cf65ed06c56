"""A file system that can lose its power: what was not synced is dropped, torn or reordered.

`PowerCut` stands in for `files.system`. Every call is carried out, and noted as well: what of
each file and folder would be on the disk now, and what is only on its way. `after_cut` makes
the folder that somebody may find after the power has failed.

The model: writes to a file reach the disk in any order, in pieces of a sector, or not at all,
until the file is synced. Names reach it in order, until the folder is synced. To sync a file
keeps its name, too, as journalling file systems do. A file
that is renamed into another folder keeps its old name until that folder has the new one.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import stat
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from hybridlog_storage.disk import files
from hybridlog_storage.disk.files import System
from hybridlog_storage.errors import HybridlogError

SECTOR = 512


@dataclass
class _File:
    """What of a file is on the disk, and what is on its way there."""

    durable: bytes = b""
    pending: list[tuple[int, bytes | None]] = field(default_factory=list)
    """Position and bytes of each write; without bytes the file was cut there."""

    def survive(self, rng: random.Random) -> bytes:
        """What is found after a cut."""
        content = bytearray(self.durable)
        for position, data in self.pending:
            fate = rng.random()
            if data is None:
                if fate < 0.5:
                    _cut(content, position)
            elif fate < 0.4:
                _put(content, position, data)
            elif fate < 0.7:  # torn
                first = rng.randrange(0, len(data) + 1) // SECTOR * SECTOR
                _put(content, position, data[:first])
        return bytes(content)


@dataclass
class _Folder:
    """Names in a folder: those on the disk, and changes on their way, oldest first."""

    durable: dict[str, int] = field(default_factory=dict)
    pending: list[tuple[str | None, str | None, int]] = field(default_factory=list)
    """Old name, new name, and what it is; a new file has no old name, a removed one no new."""
    left: list[tuple[_Folder, str]] = field(default_factory=list)
    """Other folders, and names in them of files that were moved here since the last sync."""

    def apply(self, count: int) -> dict[str, int]:
        """The names when so many changes have reached the disk."""
        names = dict(self.durable)
        for old, new, what in self.pending[:count]:
            if old is not None:
                names.pop(old, None)
            if new is not None:
                names[new] = what
        return names


class PowerCut(System):
    """Notes what is on the disk; after so many calls nothing works any more.

    Args:
        root: The folder that is watched, as it is now.
        calls: How many calls work; None for all.
    """

    def __init__(
        self,
        root: Path,
        calls: int | None = None,
    ) -> None:
        self.calls = 0
        self._left = calls
        self._files: dict[int, _File] = {}
        self._folders: dict[int, _Folder] = {}
        self._numbers: dict[int, int] = {}
        """By inode: the same, or another number where it was that of a removed file before."""
        self._root = self._new_number(root.stat())
        for path in [root, *root.rglob("*")]:
            about = path.lstat()
            number = self._number(about)
            if stat.S_ISDIR(about.st_mode):
                inside = {p.name: self._number(p.lstat()) for p in path.iterdir()}
                self._folders[number] = _Folder(inside)
            elif stat.S_ISREG(about.st_mode):
                self._files[number] = _File(path.read_bytes())

    @property
    def is_off(self) -> bool:
        """Whether the power has failed."""
        return self._left == 0

    def _step(self) -> None:
        if self._left == 0:
            raise OSError(errno.EIO, "the power has failed")
        if self._left is not None:
            self._left -= 1
        self.calls += 1

    def open(self, name: str, flags: int, mode: int = 0o666, *, dir_fd: int | None = None) -> int:
        if not flags & os.O_CREAT:
            return super().open(name, flags, mode, dir_fd=dir_fd)
        self._step()
        is_new = not _exists(name, dir_fd)
        fd = super().open(name, flags, mode, dir_fd=dir_fd)
        if is_new and dir_fd is not None:
            number = self._new_number(os.fstat(fd))
            self._files[number] = _File()
            self._folder(dir_fd).pending.append((None, name, number))
        elif flags & os.O_TRUNC:
            self._file(fd).pending.append((0, None))
        return fd

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        self._step()
        position = os.lseek(fd, 0, os.SEEK_CUR)
        return self._note(fd, parts, position, super().writev(fd, parts))

    def pwritev(self, fd: int, parts: Sequence[memoryview], position: int) -> int:
        self._step()
        return self._note(fd, parts, position, super().pwritev(fd, parts, position))

    def truncate(self, fd: int, length: int) -> None:
        self._step()
        super().truncate(fd, length)
        self._file(fd).pending.append((length, None))

    def sync(self, fd: int) -> None:
        self._step()
        number = self._number(os.fstat(fd))
        if number in self._folders:
            folder = self._folders[number]
            folder.durable = folder.apply(len(folder.pending))
            folder.pending.clear()
            for other, name in folder.left:
                other.pending.append((name, None, 0))
            folder.left.clear()
            return
        file = self._file(fd)
        content = bytearray(file.durable)
        for position, data in file.pending:
            if data is None:
                _cut(content, position)
            else:
                _put(content, position, data)
        file.durable = bytes(content)
        file.pending.clear()
        for folder in self._folders.values():
            places = [n for n, change in enumerate(folder.pending) if change[2] == number]
            if places and folder.pending[places[0]][0] is None:  # it is new
                count = places[0] + 1
                folder.durable = folder.apply(count)
                del folder.pending[:count]

    def rename(self, old: str, new: str, *, src_dir_fd: int, dst_dir_fd: int) -> None:
        self._step()
        number = self._number(os.stat(old, dir_fd=src_dir_fd, follow_symlinks=False))
        super().rename(old, new, src_dir_fd=src_dir_fd, dst_dir_fd=dst_dir_fd)
        before, after = self._folder(src_dir_fd), self._folder(dst_dir_fd)
        if before is after:
            before.pending.append((old, new, number))
        else:
            after.pending.append((None, new, number))
            after.left.append((before, old))

    def link(
        self, old: str, new: str, *, src_dir_fd: int, dst_dir_fd: int, follow_symlinks: bool
    ) -> None:
        self._step()
        number = self._number(os.stat(old, dir_fd=src_dir_fd, follow_symlinks=False))
        places = {"src_dir_fd": src_dir_fd, "dst_dir_fd": dst_dir_fd}
        super().link(old, new, **places, follow_symlinks=follow_symlinks)
        self._folder(dst_dir_fd).pending.append((None, new, number))

    def unlink(self, name: str, *, dir_fd: int) -> None:
        self._step()
        super().unlink(name, dir_fd=dir_fd)
        self._folder(dir_fd).pending.append((name, None, 0))

    def mkdir(self, name: str, mode: int, *, dir_fd: int) -> None:
        self._step()
        super().mkdir(name, mode, dir_fd=dir_fd)
        number = self._new_number(os.stat(name, dir_fd=dir_fd))
        self._folders[number] = _Folder()
        self._folder(dir_fd).pending.append((None, name, number))

    def rmdir(self, name: str, *, dir_fd: int) -> None:
        self._step()
        super().rmdir(name, dir_fd=dir_fd)
        self._folder(dir_fd).pending.append((name, None, 0))

    def after_cut(self, target: Path, rng: random.Random) -> None:
        """Make the folder that may be found after a cut at this moment."""
        self._lay(self._root, target, rng)

    def _lay(self, number: int, target: Path, rng: random.Random) -> None:
        if number in self._folders:
            target.mkdir()
            folder = self._folders[number]
            names = folder.apply(rng.randrange(len(folder.pending) + 1))
            for name, inside in names.items():
                self._lay(inside, target / name, rng)
        elif number in self._files:
            target.write_bytes(self._files[number].survive(rng))

    def _note(self, fd: int, parts: Sequence[memoryview], position: int, done: int) -> int:
        data = b"".join(parts)[:done]
        self._file(fd).pending.append((position, data))
        return done

    def _file(self, fd: int) -> _File:
        return self._files.setdefault(self._number(os.fstat(fd)), _File())

    def _folder(self, fd: int) -> _Folder:
        return self._folders.setdefault(self._number(os.fstat(fd)), _Folder())

    def _number(self, about: os.stat_result) -> int:
        known = self._numbers.get(about.st_ino)
        return self._new_number(about) if known is None else known

    def _new_number(self, about: os.stat_result) -> int:
        number = about.st_ino
        while number in self._files or number in self._folders:
            number += 1 << 64
        self._numbers[about.st_ino] = number
        return number


def each_cut(
    store: Path,
    tmp_path: Path,
    rng: random.Random,
    monkeypatch: pytest.MonkeyPatch,
    work: Callable[[Path], object],
) -> Iterator[tuple[Path, bool]]:
    """Cut the power at each call of some work, and after the last one.

    Yields:
        The store as it is on the disk then, and whether the work came to its end.
    """
    at, is_done = 0, False
    while not is_done:
        place, found = tmp_path / f"{at}", tmp_path / f"{at} after"
        shutil.copytree(store, place)
        power = PowerCut(place, at)
        with monkeypatch.context() as patch:
            patch.setattr(files, "system", power)
            try:
                work(place)
                is_done = True
            except HybridlogError:
                pass
            except OSError:
                assert power.is_off
        power.after_cut(found, rng)
        yield found, is_done
        at += 1


class _Dying(System):
    """Ends the process at its n-th call, before or after it is done."""

    def __init__(self, at: int, *, after: bool, only: frozenset[str] | None) -> None:
        self._left, self._after, self._only = at, after, only

    def __getattribute__(self, name: str) -> Any:
        found = super().__getattribute__(name)
        if name.startswith("_") or (self._only is not None and name not in self._only):
            return found

        def step(*arguments: Any, **options: Any) -> Any:
            if self._left == 0 and not self._after:
                os._exit(7)
            result = found(*arguments, **options)
            if self._left == 0:
                os._exit(7)
            self._left -= 1
            return result

        return step


def dies(
    at: int,
    work: Callable[[], object],
    *,
    after: bool = False,
    only: frozenset[str] | None = None,
) -> bool:
    """Whether a process that does some work died at a call of the file system, from 0.

    Args:
        at: The call.
        work: What is done.
        after: Whether the call is done first.
        only: What is counted; all calls by default.
    """
    child = os.fork()
    if child == 0:
        try:
            files.system = _Dying(at, after=after, only=only)
            work()
            os._exit(0)
        finally:
            os._exit(1)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in {0, 7}
    return code == 7


def _exists(name: str, folder: int | None) -> bool:
    try:
        os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return False
    return True


def _put(content: bytearray, position: int, data: bytes) -> None:
    if data:
        content.extend(bytes(max(position - len(content), 0)))
        content[position : position + len(data)] = data


def _cut(content: bytearray, length: int) -> None:
    del content[length:]
    content.extend(bytes(length - len(content)))
