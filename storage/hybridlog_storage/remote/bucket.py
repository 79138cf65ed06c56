"""Objects in a bucket, by way of obstore (extra `remote`).

A bucket has no locks and no renames. What it has are conditions: an object is created only if
its name is free, and replaced only if it is still the version that was seen. A server that
ignores conditions would lose data in silence, so it is refused before the first write.

Credentials and the address of a server of one's own come from the environment, as obstore
reads them (`AWS_ACCESS_KEY_ID`, `AWS_ENDPOINT_URL`, `AWS_ALLOW_HTTP`, `GOOGLE_…`, `AZURE_…`).

A cache on the disk for blocks of objects, shared by all processes of a user.

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
import re
import secrets
import struct
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar

from msgspec import Struct

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    BucketError,
    ExistsError,
    MissingDependencyError,
    ObjectChangedError,
    ResourceError,
    UsageError,
)
from hybridlog_storage.remote import address_of

if TYPE_CHECKING:
    from obstore import GetOptions, PutMode
    from obstore.store import ObjectStore

    from hybridlog_storage.messages import Buffer

try:
    import obstore.store
    from obstore import exceptions
except ImportError as error:
    raise MissingDependencyError("Buckets need obstore: pip install 'hybridlog[remote]'") from error


PART_BYTES: Final = 64 << 20
"""Size from which an object is uploaded in parts."""
_PART: Final = 16 << 20
_PAGE: Final = 1000  # names that servers list at once
_TRIES: Final = 4
_READ_S: Final = 60
_WRITE_S: Final = 900
_RETRY_S: Final = 60
_CUT = re.compile(r"(?i)body|reset|closed|incomplete|timed? ?out|eof|sending request")
_NO_BUCKET = re.compile(r"NoSuchBucket|ContainerNotFound|bucket does not exist")
_SECRETS = re.compile(r"(?i)(signature|credential|token|sig|key)=[^&\s\"]+")
_CURE: Final = (
    "Credentials and the address of a server of one's own come from the environment, such as "
    "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL, and AWS_ALLOW_HTTP=true for one "
    "without TLS."
)


_T = TypeVar("_T")
_PROCESS: Final = os.getpid()


class Object(Struct, frozen=True):
    """An object as a list or an answer describes it; its name is below the address of the bucket.

    `version` is the entity tag, another one after every change.
    """

    name: str
    size: int
    version: str

    def has_md5_of(self, pieces: Iterable[bytes]) -> bool:
        """True if its version is the MD5 of some bytes, as most servers that speak S3 have it.

        Of what was sent in parts it is one of their MD5s; no piece may belong to two of them.
        """
        tag, parts, left = self.version.strip('"'), [], 0
        for piece in pieces:
            if left <= 0:
                parts.append(hashlib.md5(usedforsecurity=False))
                left = _PART if "-" in tag else self.size
            parts[-1].update(piece)
            left -= len(piece)
        whole = b"".join(part.digest() for part in parts)
        if "-" not in tag:
            return tag == whole.hex()
        return tag == f"{hashlib.md5(whole, usedforsecurity=False).hexdigest()}-{len(parts)}"


class Bucket:
    """The objects below an address, such as `s3://lab/store`."""

    def __init__(self, address: str) -> None:
        found = address_of(address)
        if found is None:
            raise UsageError(f"{address!r} is not the address of a bucket, as s3://lab/store is.")
        self.address = found
        self._honoured: set[type] = set()  # kinds of conditions
        self._reading, self._writing = (_opened(found, limit) for limit in (_READ_S, _WRITE_S))

    def objects(self, prefix: str = "") -> list[Object]:
        """All objects whose names begin with a folder's name, in order; 1,000 a request.

        `prefix` has whole parts of names: `recordings/` has what is below it.
        """
        return self._again(
            prefix,
            lambda: [
                _object(about, str(about["path"]))
                for page in obstore.list(self._reading, prefix or None, chunk_size=_PAGE)
                for about in page
            ],
        )

    def read(self, name: str, begin: int, end: int, size: int) -> bytes:
        """Bytes `[begin, end)` of an object; `ObjectChangedError` if its size is not `size`."""
        about, data = self._get(name, {"range": (begin, end)}, end - begin)
        if (about.size, len(data)) != (size, end - begin):
            raise ObjectChangedError(f"{self._place(name)} has another size than it had.")
        return data

    def read_whole(self, name: str, most: int) -> tuple[Object, bytes]:
        """A small object, and what it is; of a larger one than expected only one byte more."""
        return self._get(name, {}, most)

    def _get(self, name: str, options: GetOptions, most: int) -> tuple[Object, bytes]:
        def read() -> tuple[Object, bytes]:
            answer = obstore.get(self._reading, name, options=options)
            data = bytes(next(iter(answer.stream(most + 1)), b""))
            return _object(answer.meta, name), data[: most + 1]

        return self._again(name, read)

    def create(self, name: str, content: bytes) -> str:
        """Create an object of a free name, else `ExistsError`; returns its version.

        One that has this very content counts as created.
        """
        self._check("create")
        with suppress(ExistsError):  # by another writer, or by this one whose answer is lost
            return self._put(name, content, "create")
        with suppress(FileNotFoundError):
            about, found = self.read_whole(name, len(content))
            if found == content:
                return about.version
        raise ExistsError(f"{self._place(name)} is there already, with other content.")

    def replace(self, name: str, content: bytes, version: str) -> str:
        """Replace an object that still has a version; returns the new one.

        If it has another version, it raises `ObjectChangedError`.
        """
        self._check({"e_tag": f'"{"0" * 32}"'})
        return self._put(name, content, {"e_tag": version})

    def put(self, name: str, size: int, pieces: Iterable[Buffer]) -> Object:
        """Write an object, which takes the place of one of its name; not if `pieces` raises."""
        self._check("create")
        if size <= PART_BYTES:
            return Object(name, size, self._put(name, b"".join(pieces), "overwrite"))
        with self._explained(name):
            made = obstore.put(self._writing, name, pieces, chunk_size=_PART, max_concurrency=4)
            return Object(name, size, _version(made))

    def delete(self, names: Sequence[str]) -> None:
        """Delete objects; those that do not exist are left out."""
        if not names:
            return
        try:
            self._again(names[0], partial(obstore.delete, self._writing, names))
        except FileNotFoundError:  # some servers stop there
            for name in names if len(names) > 1 else ():
                self.delete([name])

    def _check(self, mode: PutMode) -> None:
        """Try once, before the first write, whether the server honours a condition.

        One that ignores it is refused: writers would overwrite each other in silence.
        """
        if type(mode) in self._honoured:
            return
        made, name = [], f"probe-{secrets.token_hex(8)}"
        try:
            for each in (mode, mode) if mode == "create" else (mode,):
                self._put(name, b"1", each)  # at last it is taken, or there is none
                made.append(name)
        except (FileNotFoundError, ObjectChangedError, ExistsError):
            self._honoured.add(type(mode))
            return
        except exceptions.NotSupportedError:
            pass
        finally:
            self.delete(made[:1])
        raise BucketError(
            f"The server of {self.address} ignores conditions of writers (If-None-Match, "
            "If-Match), so two writers would lose data in silence. Use a server that honours "
            "them, or copy to a directory."
        )

    def _put(self, name: str, content: bytes, mode: PutMode) -> str:
        put = partial(obstore.put, self._writing, name, content, mode=mode, use_multipart=False)
        return self._again(name, lambda: _version(put()))

    def _again(self, name: str, work: Callable[[], _T]) -> _T:
        """Do something again if the connection broke, where the library does not.

        Writers have conditions, and see what a request did whose answer was lost.
        """
        for attempt in range(_TRIES):
            with self._explained(name):
                try:
                    return work()
                except exceptions.GenericError as error:
                    if attempt + 1 == _TRIES or _CUT.search(str(error)) is None:
                        raise
        raise AssertionError

    def _place(self, name: str) -> str:
        return f"{self.address}/{name}"

    @contextmanager
    def _explained(self, name: str) -> Iterator[None]:
        """Raise errors of the library as errors of this program."""
        _check_process(self.address)
        try:
            yield
        except FileNotFoundError as error:
            if _NO_BUCKET.search(str(error)):
                bucket = self.address.split("/")[2]
                raise BucketError(
                    f"There is no bucket {bucket!r}: make it, or correct {self.address}."
                ) from error
            raise FileNotFoundError(
                errno.ENOENT, "there is no such object", self._place(name)
            ) from error
        except exceptions.PreconditionError as error:
            raise ObjectChangedError(f"{self._place(name)} was changed meanwhile.") from error
        except exceptions.AlreadyExistsError as error:
            raise ExistsError(f"{self._place(name)} exists.") from error
        except exceptions.NotSupportedError:
            raise
        except (exceptions.BaseError, ValueError) as error:
            raise BucketError(f"{self._place(name)}: {_reason(error)}. {_CURE}") from error


def _check_process(address: str) -> None:
    """Raise in a process that was forked: the library's threads are in its parent alone."""
    if os.getpid() != _PROCESS:
        raise BucketError(
            f"{address} cannot be read here: this process was forked from one that has read from "
            "a bucket. Start it by `spawn` instead, as multiprocessing_context='spawn' does."
        )


def _opened(address: str, timeout_s: int) -> ObjectStore:
    _check_process(address)
    try:
        return obstore.store.from_url(
            address,
            client_options={"timeout": timedelta(seconds=timeout_s), "allow_http": _allows_http()},
            retry_config={"max_retries": 6, "retry_timeout": timedelta(seconds=_RETRY_S)},
        )
    except (exceptions.BaseError, ValueError) as error:
        raise UsageError(f"{address} cannot be opened: {_reason(error)}") from error


def _allows_http() -> bool:
    """True if the environment allows a server without TLS, under the name that obstore reads."""
    names = ("AWS_ALLOW_HTTP", "GOOGLE_ALLOW_HTTP", "AZURE_ALLOW_HTTP", "ALLOW_HTTP")
    return any(os.environ.get(name, "").lower() in {"1", "true"} for name in names)


def _object(about: Any, name: str) -> Object:
    return Object(name, int(about["size"]), _version(about))


def _version(about: Any) -> str:
    version = about["e_tag"]
    if not isinstance(version, str) or not version:
        raise ValueError("the server gives no entity tags")
    return version


def _reason(error: Exception) -> str:
    """The message of an error of the library, in one line and without what may be secret."""
    lines = str(error).partition("Debug source")[0].split("\n")
    text = " ".join(" ".join(lines).split())
    printable = "".join(one for one in text if one.isprintable())
    return _SECRETS.sub(r"\1=…", printable)[:400].rstrip(".: ")


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
                sums = _opened_file(self._cache.paths(self._bucket, self._about)[1])
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
            fd = _opened_file(self.paths(bucket, about)[0])
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


def _opened_file(path: Path) -> int:
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
