"""A cache on the disk for blocks of objects, shared by all processes of a user.

Each object has a sparse file of its full size, and beside it a file with the checksum of each
block that is there. So a file is opened, measured and read like any other; blocks that are
missing are fetched before. Blocks are believed only with their checksum, so it does not matter
who removes a file meanwhile, or what a crash leaves. Objects never change: a file is named by
the address, the name, the size and the digest or version of its object.
"""

from __future__ import annotations

import errno
import hashlib
import os
import struct
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final
from weakref import WeakValueDictionary

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk.files import user_directory
from hybridlog_storage.errors import ObjectChangedError, ResourceError
from hybridlog_storage.remote.bucket import Bucket, Object, joined_ranges

LOST: Final = "its object in the bucket is missing or was changed"
MAX_CACHED: Final = 16 << 30
"""Bytes that the cached blocks of a user may take."""
BLOCK: Final = 64 << 10
_TAIL: Final = 256 << 10  # what is fetched of an end at least: summaries and footers lie there
_PIECE: Final = 64 << 20  # fetched at once
_CHECK_EVERY: Final = 256 << 20  # fetched bytes between two looks at the size of the cache
_NEAR: Final = (1 << 20) // BLOCK  # blocks between two reads that follow each other
_MAX_WINDOW: Final = (8 << 20) // BLOCK
_MARK: Final = struct.Struct("<II")
_DATA: Final = ".data"
_SUMS: Final = ".sums"


class CachedFile(int):
    """A handle of the cached file of an object, which fetches what is read."""

    blocks: Blocks

    def fetch(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Make ranges of bytes readable; see `Blocks.fetch`."""
        self.blocks.fetch(self, ranges)

    def identity(self) -> tuple[int, ...]:
        """A value that no other object has, nor this one after a change."""
        return inode_of(self.blocks.about), self.blocks.about.size

    def again(self) -> CachedFile:
        """Another handle of the same file."""
        return _handle(os.dup(self), self.blocks)


class Blocks:
    """The blocks of an object."""

    def __init__(self, cache: BlockCache, bucket: Bucket, about: Object) -> None:
        self._cache = cache
        self._bucket = bucket
        self.about = about
        named = "\n".join([bucket.address, about.name, about.version, str(about.size)])
        self._path = cache.path / hashlib.sha256(named.encode()).hexdigest()[:40]
        self._lock = threading.Lock()
        self._proved: set[int] = set()
        self._inode = -1
        self._next = -1  # the block behind the last one that was fetched
        self._window = 0  # blocks to fetch ahead

    def open(self) -> CachedFile:
        """A new handle of its file.

        Raises:
            OSError: The file cannot be made.
        """
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        fd = os.open(self._path.with_suffix(_DATA), flags, 0o600)
        try:
            if os.fstat(fd).st_size != self.about.size:
                os.ftruncate(fd, self.about.size)
            os.utime(fd)
            return _handle(fd, self)
        except BaseException:
            os.close(fd)
            raise

    def forget(self) -> None:
        """Remove what was kept of it, but for those who have opened it."""
        for suffix in (_DATA, _SUMS):
            with suppress(OSError):
                self._path.with_suffix(suffix).unlink()

    def fetch(self, fd: int, ranges: Iterable[tuple[int, int]]) -> None:
        """Fetch the missing blocks of some ranges of bytes.

        Raises:
            OSError: The object is missing, or has another size, as a disk says of a bad sector.
            BucketError: The server does not answer.
            ResourceError: The cache cannot be written.
        """
        size = self.about.size
        wanted: set[int] = set()
        for begin, end in ranges:
            first, last = begin, min(end, size)
            if first < last:
                if last > size - BLOCK:
                    first = min(first, max(size - _TAIL, 0))
                wanted.update(range(first // BLOCK, -(-last // BLOCK)))
        with self._lock:
            inode = os.fstat(fd).st_ino
            if inode != self._inode:  # it was removed from the cache and made again
                self._inode, self._proved = inode, set()
            wanted -= self._proved
            if wanted:
                self._fetch(fd, sorted(wanted))

    def _fetch(self, fd: int, wanted: list[int]) -> None:
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        with self._cache.writing():
            sums = os.open(self._path.with_suffix(_SUMS), flags, 0o600)
        try:
            with self._cache.writing():
                missing = [number for number in wanted if not self._is_there(fd, sums, number)]
            missing += self._ahead_of(missing)
            for piece in _pieces(joined_ranges([self._range(number) for number in missing])):
                try:
                    found = self._bucket.read(self.about.name, piece, size=self.about.size)
                except (FileNotFoundError, ObjectChangedError) as error:
                    self._bucket.lost.add(self.about.name)
                    self.forget()  # so that others notice it when they begin to read
                    place = f"{self._bucket.address}/{self.about.name}"
                    raise OSError(errno.EIO, LOST, place) from error
                with self._cache.writing():
                    for (begin, _), data in zip(piece, found, strict=True):
                        self._keep(fd, sums, begin, data)
                self._cache.added(sum(map(len, found)))
            self._proved.update(wanted)
        finally:
            os.close(sums)

    def _ahead_of(self, missing: list[int]) -> list[int]:
        """Blocks behind the missing ones, more each time that a file is read on and on."""
        if not missing:
            return []
        goes_on = 0 <= missing[0] - self._next <= _NEAR
        self._window = min(max(2 * self._window, _NEAR // 4), _MAX_WINDOW) if goes_on else 0
        end = missing[-1] + 1
        self._next = min(end + self._window, -(-self.about.size // BLOCK))
        return list(range(end, self._next))

    def _range(self, number: int) -> tuple[int, int]:
        return number * BLOCK, min((number + 1) * BLOCK, self.about.size)

    def _is_there(self, fd: int, sums: int, number: int) -> bool:
        mark = os.pread(sums, _MARK.size, number * _MARK.size)
        if len(mark) < _MARK.size or mark == bytes(_MARK.size):
            return False
        begin, end = self._range(number)
        return mark == _MARK.pack(1, crc32(os.pread(fd, end - begin, begin)))

    def _keep(self, fd: int, sums: int, begin: int, data: bytes) -> None:
        view = memoryview(data)
        done = 0
        while done < len(view):
            done += os.pwrite(fd, view[done:], begin + done)
        marks = [_MARK.pack(1, crc32(view[at : at + BLOCK])) for at in range(0, len(view), BLOCK)]
        os.pwrite(sums, b"".join(marks), begin // BLOCK * _MARK.size)
        first = begin // BLOCK
        self._proved.update(range(first, first + len(marks)))


class BlockCache:
    """The cached blocks of a user's objects.

    Args:
        path: Its directory; by default in the user's cache.
        most: Bytes that it may take, about; what was opened longest ago goes first.
    """

    def __init__(self, path: Path | None = None, most: int = MAX_CACHED) -> None:
        if path is None:
            path = user_directory("XDG_CACHE_HOME", ".cache", "blocks of buckets") / "buckets"
        self.path = path
        self._most = most
        self._since_check = _CHECK_EVERY
        self._known: WeakValueDictionary[tuple[str, Object], Blocks] = WeakValueDictionary()
        self._lock = threading.Lock()

    def open(self, bucket: Bucket, about: Object) -> CachedFile:
        """A handle of the cached file of an object.

        Raises:
            ResourceError: The file cannot be made.
        """
        blocks = self._blocks(bucket, about)
        with self.writing():
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            return blocks.open()

    def forget(self, bucket: Bucket, about: Object) -> None:
        """Remove what was kept of an object, so that it is read from the server again."""
        self._blocks(bucket, about).forget()

    def _blocks(self, bucket: Bucket, about: Object) -> Blocks:
        with self._lock:
            key = bucket.address, about
            blocks = self._known.get(key)
            if blocks is None:
                blocks = self._known[key] = Blocks(self, bucket, about)
            return blocks

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Name the cure if the cache cannot be written: no object is damaged by that."""
        try:
            yield
        except OSError as error:
            raise ResourceError(
                f"The cache {self.path} cannot be written: {error.strerror}. Make room there, or "
                "set XDG_CACHE_HOME to another directory."
            ) from error

    def added(self, size: int) -> None:
        """Count fetched bytes, and make room now and then."""
        with self._lock:
            self._since_check += size
            if self._since_check < min(_CHECK_EVERY, self._most):
                return
            self._since_check = 0
        self._make_room()

    def _make_room(self) -> None:
        found = []
        with suppress(OSError), os.scandir(self.path) as entries:
            for entry in entries:
                with suppress(OSError):
                    about = entry.stat(follow_symlinks=False)
                    found.append((about.st_mtime_ns, about.st_blocks * 512, entry.path))
        left = sum(size for _, size, _ in found)
        for _, size, path in sorted(found):
            if left <= self._most:
                return
            with suppress(OSError):
                os.unlink(path)  # noqa: PTH108 - as the listing has it
            left -= size


def inode_of(about: Object) -> int:
    """A number that another object, or version of it, does not have."""
    named = f"{about.name}\n{about.version}".encode()
    return int.from_bytes(hashlib.sha256(named).digest()[:7], "big")


def _handle(fd: int, blocks: Blocks) -> CachedFile:
    handle = CachedFile(fd)
    handle.blocks = blocks
    return handle


def _pieces(ranges: Iterable[tuple[int, int]]) -> Iterator[list[tuple[int, int]]]:
    """Ranges in groups that fit into memory; long ones are cut."""
    group: list[tuple[int, int]] = []
    room = _PIECE
    for begin, end in ranges:
        at = begin
        while at < end:
            cut = min(end, at + room)
            group.append((at, cut))
            room -= cut - at
            at = cut
            if not room:
                yield group
                group, room = [], _PIECE
    if group:
        yield group
