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
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, Self

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.errors import ObjectChangedError, ResourceError
from hybridlog_storage.remote.bucket import Bucket, Object

LOST: Final = "its object in the bucket is missing or was changed"
MAX_CACHED: Final = 16 << 30
"""Bytes that the cached blocks of a user may take."""
BLOCK: Final = 64 << 10
_TAIL: Final = 256 << 10  # what is fetched of an end at least: summaries and footers lie there
_GAP: Final = (1 << 20) // BLOCK  # blocks that cost less than another request
_PIECE: Final = (8 << 20) // BLOCK  # blocks of a request
_PARALLEL: Final = 8
_CHECK_EVERY: Final = 256 << 20  # fetched bytes between two looks at the size of the cache
_MARK: Final = struct.Struct("<II")


class CachedFile(int):
    """A handle of the cached file of an object, which fetches what is read."""

    def __new__(cls, fd: int, *_: object) -> Self:
        """A handle that takes over an open file."""
        return super().__new__(cls, fd)

    def __init__(self, _: int, cache: BlockCache, bucket: Bucket, about: Object) -> None:
        self._cache, self._bucket, self._about = cache, bucket, about
        self._lock, self._proved = threading.Lock(), set[int]()

    def identity(self) -> tuple[int, ...]:
        """A value that no other object has, nor this one after a change."""
        return inode_of(self._about), self._about.size

    def again(self) -> CachedFile:
        """Another handle of the same file."""
        return CachedFile(os.dup(self), self._cache, self._bucket, self._about)

    def fetch(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Fetch the missing blocks of some ranges of bytes."""
        size, wanted = self._about.size, set[int]()
        for begin, end in ranges:
            if begin < min(end, size):
                first = begin if end <= size - BLOCK else min(begin, max(size - _TAIL, 0))
                wanted.update(range(first // BLOCK, -(-min(end, size) // BLOCK)))
        with self._lock:
            wanted -= self._proved
            if not wanted:
                return
            with self._cache.writing():
                sums = _opened(self._cache.paths(self._bucket, self._about)[1])
                try:
                    missing = [n for n in sorted(wanted) if not self._is_there(sums, n)]
                    with ThreadPoolExecutor(_PARALLEL) as pool:
                        for _ in pool.map(
                            lambda piece: self._bring(sums, *piece), _pieces(missing)
                        ):
                            pass
                finally:
                    os.close(sums)
            self._proved.update(wanted)

    def _bring(self, sums: int, first: int, last: int) -> None:
        """Fetch blocks, the last one with them."""
        about, bucket = self._about, self._bucket
        begin, end = first * BLOCK, min((last + 1) * BLOCK, about.size)
        try:
            data = memoryview(bucket.read(about.name, begin, end, about.size))
        except (FileNotFoundError, ObjectChangedError) as error:
            self._cache.forget(bucket, about)  # so that others notice it when they begin to read
            raise OSError(errno.EIO, LOST, f"{bucket.address}/{about.name}") from error
        done = 0
        while done < len(data):
            done += os.pwrite(self, data[done:], begin + done)
        sizes = range(0, len(data), BLOCK)
        marks = b"".join(_MARK.pack(1, crc32(data[at : at + BLOCK])) for at in sizes)
        os.pwrite(sums, marks, first * _MARK.size)
        self._cache.added(len(data))

    def _is_there(self, sums: int, number: int) -> bool:
        mark = os.pread(sums, _MARK.size, number * _MARK.size)
        is_known = mark[:1] == b"\1"
        return is_known and mark == _MARK.pack(1, crc32(os.pread(self, BLOCK, number * BLOCK)))


class BlockCache:
    """The cached blocks of a user's objects; by default in the user's cache.

    It takes about `most` bytes; what was opened longest ago goes first.
    """

    def __init__(self, path: Path | None = None, most: int = MAX_CACHED) -> None:
        self.path = path or files.user_cache()
        self._most = most
        self._since_check = _CHECK_EVERY
        self._lock = threading.Lock()

    def open(self, bucket: Bucket, about: Object) -> CachedFile:
        """A handle of the cached file of an object."""
        with self.writing():
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            fd = _opened(self.paths(bucket, about)[0])
            os.ftruncate(fd, about.size)
            os.utime(fd)
            return CachedFile(fd, self, bucket, about)

    def paths(self, bucket: Bucket, about: Object) -> tuple[Path, Path]:
        """The files with the blocks of an object, and with their checksums."""
        named = "\n".join([bucket.address, about.name, about.version, str(about.size)])
        path = self.path / hashlib.sha256(named.encode()).hexdigest()[:40]
        return path.with_suffix(".data"), path.with_suffix(".sums")

    def forget(self, bucket: Bucket, about: Object) -> None:
        """Remove what was kept of an object, but for those who have opened it."""
        for path in self.paths(bucket, about):
            with suppress(OSError):
                path.unlink()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Name the cure if the cache cannot be written; an object that is lost is no such error."""
        try:
            yield
        except OSError as error:
            if error.strerror == LOST:
                raise
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
        with suppress(OSError):
            there = files.names(self.path).items()
            found = sorted((one.st_mtime_ns, one.st_blocks * 512, name) for name, one in there)
            left = sum(taken for _, taken, _ in found)
            for _, taken, name in found:
                if left > self._most:
                    (self.path / name).unlink(missing_ok=True)
                    left -= taken


def inode_of(about: Object) -> int:
    """A number that another object, or version of it, does not have."""
    named = f"{about.name}\n{about.version}".encode()
    return int.from_bytes(hashlib.sha256(named).digest()[:7], "big")


def _opened(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)


def _pieces(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """First and last block of each request for some blocks, in order."""
    pieces: list[tuple[int, int]] = []
    for number in numbers:
        if pieces and number - pieces[-1][1] <= _GAP + 1 and number - pieces[-1][0] < _PIECE:
            pieces[-1] = pieces[-1][0], number
        else:
            pieces.append((number, number))
    return pieces
