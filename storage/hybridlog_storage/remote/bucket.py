"""Objects in a bucket, by way of obstore (extra `remote`).

A bucket has no locks and no renames. What it has are conditions: an object is created only if
its name is free, and read or replaced only if it is still the version that was seen. A server
that ignores conditions would lose data in silence, so it is refused before the first write.

Credentials and the address of a server of one's own come from the environment, as obstore
reads them (`AWS_ACCESS_KEY_ID`, `AWS_ENDPOINT_URL`, `AWS_ALLOW_HTTP`, `GOOGLE_…`, `AZURE_…`).
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

from hybridlog_storage.errors import (
    BucketError,
    MissingDependencyError,
    ObjectChangedError,
    ObjectExistsError,
    UsageError,
)
from hybridlog_storage.lazy import lazy

if TYPE_CHECKING:
    from obstore import GetOptions, GetResult, PutMode
    from obstore.store import ObjectStore

    from hybridlog_storage.messages import Buffer

SCHEMES: Final = ("s3://", "gs://", "az://")
"""How the address of a store in a bucket begins."""
JOINED_GAP: Final = 1 << 20
"""Bytes between two ranges that cost less than another request."""
PART_BYTES: Final = 64 << 20
"""Size from which an object is uploaded in parts."""
_PART: Final = 16 << 20
_PAGE: Final = 1000  # names that servers list at once
_PARALLEL: Final = 8
_TRIES: Final = 4
_READ_S: Final = 60
_WRITE_S: Final = 900
_RETRY_S: Final = 60
_CUT = re.compile(r"(?i)body|reset|closed|incomplete|timed? ?out|eof|sending request")
_NO_BUCKET = re.compile(r"NoSuchBucket|ContainerNotFound|bucket does not exist")
_ROLES = re.compile(r"169\.254\.|metadata\.google")  # asked if the environment has no key
_MD5: Final = re.compile(r"[0-9a-f]{32}(-[0-9]{1,5})?")  # of the whole, or of parts
_ANY_MD5: Final = "0" * 32
_HOST = re.compile(r"https?://[^/\s]+")
_SECRETS = re.compile(r"(?i)(signature|credential|token|sig|key)=[^&\s\"]+")


_T = TypeVar("_T")
_users: Final[dict[str, int]] = {}
"""The process that has used the library first."""


@dataclass(frozen=True, slots=True)
class Object:
    """An object as a list or an answer describes it.

    Attributes:
        name: Its name below the address of the bucket.
        size: Its bytes.
        version: The entity tag; another one after every change.
    """

    name: str
    size: int
    version: str


def is_bucket(address: object) -> bool:
    """True for the address of a place in a bucket, such as `s3://lab/store`."""
    return isinstance(address, str) and address.startswith(SCHEMES)


class Bucket:
    """The objects below an address.

    Args:
        address: Such as `s3://lab/store`.

    Attributes:
        lost: Names of objects that were looked for, and are missing or have another size.

    Raises:
        UsageError: It is not the address of a bucket.
        MissingDependencyError: obstore is not installed.
    """

    def __init__(self, address: str) -> None:
        if not is_bucket(address) or not address.partition("://")[2].strip("/"):
            raise UsageError(f"{address!r} is not the address of a bucket, as s3://lab/store is.")
        self.address = address.rstrip("/")
        self.lost: set[str] = set()
        self._has_conditions = self._replaces = False
        self._has_digests = True
        self._reading = _opened(self.address, _READ_S)

    @lazy
    def _writing(self) -> ObjectStore:
        return _opened(self.address, _WRITE_S)

    def objects(self, prefix: str = "", *, after: str | None = None) -> Iterator[Object]:
        """All objects whose names begin with a folder's name, in order; 1,000 a request.

        Args:
            prefix: Whole parts of names: `recordings/` has what is below it.
            after: Only names behind this one.

        Raises:
            BucketError: The server does not answer, or refuses.
        """
        while True:
            page, is_last = self._again(prefix, partial(self._page, prefix, after))
            yield from page
            if is_last:
                return
            after = page[-1].name

    def _page(self, prefix: str, after: str | None) -> tuple[list[Object], bool]:
        import obstore

        pages = iter(obstore.list(self._reading, prefix or None, offset=after, chunk_size=_PAGE))
        found = [_object(about, str(about["path"])) for about in next(pages, ())]
        return found, len(found) < _PAGE

    def read(
        self,
        name: str,
        ranges: Sequence[tuple[int, int]],
        version: str | None = None,
        size: int | None = None,
    ) -> list[bytes]:
        """Parts of an object; ranges are joined where the gap costs less than a request.

        Args:
            name: The object.
            ranges: Begin and end of each part, in any order.
            version: The version it must have, if one is known.
            size: The bytes it must have in all, if they are known.

        Raises:
            FileNotFoundError: It does not exist.
            ObjectChangedError: It has another version or size.
            BucketError: The server does not answer, or refuses.
        """
        joined = joined_ranges(ranges)
        if len(joined) > 1:
            with ThreadPoolExecutor(min(len(joined), _PARALLEL)) as pool:
                found = list(pool.map(lambda r: self._range(name, r, version, size), joined))
        else:
            found = [self._range(name, one, version, size) for one in joined]
        parts = []
        for begin, end in ranges:
            place = next(n for n, (low, high) in enumerate(joined) if low <= begin and end <= high)
            low = joined[place][0]
            parts.append(bytes(memoryview(found[place])[begin - low : end - low]))
        return parts

    def _range(
        self, name: str, wanted: tuple[int, int], version: str | None, size: int | None
    ) -> bytes:
        begin, end = wanted
        if begin == end:
            return b""
        about, data = self._get(name, {"range": (begin, end)}, version, end - begin)
        if len(data) != end - begin or size not in {None, about.size}:
            raise ObjectChangedError(f"{self._place(name)} has another size than it had.")
        return data

    def read_whole(self, name: str, most: int) -> tuple[Object, bytes]:
        """A small object, and what it is; of a larger one than expected only one byte more.

        Raises:
            FileNotFoundError: It does not exist.
            BucketError: The server does not answer, or refuses.
        """
        return self._get(name, {}, None, most)

    def _get(
        self, name: str, options: dict[str, Any], version: str | None, most: int
    ) -> tuple[Object, bytes]:
        import obstore

        if version is not None:
            options = {**options, "if_match": version}

        def read() -> tuple[Object, bytes]:
            answer = obstore.get(self._reading, name, options=cast("GetOptions", options))
            about = _object(answer.meta, name)
            if version not in {None, about.version}:  # the server ignores conditions
                raise ObjectChangedError(f"{self._place(name)} was changed meanwhile.")
            return about, _content(answer, most)

        return self._again(name, read)

    def head(self, name: str) -> Object | None:
        """The size and version of an object; None if it does not exist.

        Raises:
            BucketError: The server does not answer, or refuses.
        """
        import obstore

        try:
            return self._again(name, lambda: _object(obstore.head(self._reading, name), name))
        except FileNotFoundError:
            return None

    def create(self, name: str, content: bytes) -> str:
        """Create an object of a free name. One that has this very content counts as created.

        Returns:
            Its version.

        Raises:
            ObjectExistsError: The name is taken, by other content.
            BucketError: The server does not answer, refuses, or ignores conditions.
        """
        from obstore.exceptions import AlreadyExistsError

        self.check_conditions()
        with suppress(AlreadyExistsError):  # by another writer, or by this one whose answer is lost
            return self._put(name, content, "create")
        with suppress(FileNotFoundError):
            about, found = self.read_whole(name, len(content))
            if found == content:
                return about.version
        raise ObjectExistsError(f"{self._place(name)} exists, with other content.")

    def pieces(self, about: Object) -> Iterator[bytes]:
        """The content of an object, some megabytes at a time; errors as of `read`."""
        for at in range(0, about.size, _PART):
            end = min(at + _PART, about.size)
            yield self._range(about.name, (at, end), about.version, about.size)

    def replace(self, name: str, content: bytes, version: str) -> str:
        """Replace an object that has still a version.

        Returns:
            Its new version.

        Raises:
            ObjectChangedError: It has another one.
            BucketError: The server does not answer, refuses, or ignores conditions.
        """
        self._check_replaces()
        return self._put(name, content, {"e_tag": version})

    def _check_replaces(self) -> None:
        """Try once, in one request, whether the server honours the condition of `replace`."""
        from obstore.exceptions import NotSupportedError

        if self._has_conditions or self._replaces:
            return
        name = f"probe-{secrets.token_hex(8)}"
        try:
            self._put(name, b"", {"e_tag": f'"{_ANY_MD5}"'})  # of what does not exist
            self.delete([name])
        except (FileNotFoundError, ObjectChangedError):
            self._replaces = True
            return
        except NotSupportedError:
            pass
        self.check_conditions()

    def digest(self, about: Object) -> str:
        """A digest of the content of an object: the server's, or it is read; see `digest_like`.

        Raises:
            FileNotFoundError: It does not exist.
            ObjectChangedError: It has another version.
            BucketError: The server does not answer, or refuses.
        """
        tag = _tag(about) if self._has_digests else ""
        return tag or digest_like("", self.pieces(about))

    def put(self, name: str, size: int, pieces: Iterable[Buffer]) -> Object:
        """Write an object, which takes the place of one of its name; not if `pieces` raises.

        Args:
            name: Its name.
            size: Its bytes; many go in parts.
            pieces: Its content.

        Raises:
            BucketError: The server does not answer, refuses, or ignores conditions.
        """
        self.check_conditions()
        if size <= PART_BYTES:
            content = b"".join(pieces)
            return Object(name, size, self._put(name, content, "overwrite"))
        import obstore

        writer = obstore.open_writer(self._writing, name, buffer_size=_PART, max_concurrency=4)
        try:
            with self.explained(name):
                for piece in pieces:
                    writer.write(bytes(piece))
                writer.close()
        except BaseException as error:
            with suppress(Exception):  # the first one counts
                writer.__exit__(type(error), error, error.__traceback__)
            if isinstance(error, OSError):  # of the writer, which has others than the library
                raise BucketError(self._problem(name, _reason(error))) from error
            raise
        about = self.head(name)
        if about is None or about.size != size:
            raise BucketError(f"{self._place(name)} did not arrive.")
        return about

    def delete(self, names: Sequence[str]) -> None:
        """Delete objects; those that do not exist are left out.

        Raises:
            BucketError: The server does not answer, or refuses.
        """
        import obstore

        for at in range(0, len(names), _PAGE):
            some = names[at : at + _PAGE]
            try:
                self._again(some[0], partial(obstore.delete, self._writing, some))
            except FileNotFoundError:  # some servers stop there
                for name in some if len(some) > 1 else ():
                    self.delete([name])

    def check_conditions(self) -> None:
        """Try once, before the first write, whether the server honours conditions.

        Raises:
            BucketError: It ignores them: writers would overwrite each other in silence.
        """
        from obstore.exceptions import AlreadyExistsError, NotSupportedError

        if self._has_conditions:
            return
        name = f"probe-{secrets.token_hex(8)}"

        def is_refused(mode: PutMode) -> bool:
            try:
                self._put(name, b"other", mode)
            except (AlreadyExistsError, ObjectChangedError):
                return True
            except NotSupportedError:
                pass
            return False

        try:
            stale = self._put(name, b"hybridlog", "overwrite")
            # Of what a server encrypts, tags are of another kind, and look the same.
            self._has_digests = stale.strip('"') == digest_like(_ANY_MD5, [b"hybridlog"])
            self._put(name, b"hybridlog 2", "overwrite")
            is_safe = is_refused("create") and is_refused({"e_tag": stale})
        finally:
            self.delete([name])
        if not is_safe:
            raise BucketError(
                f"The server of {self.address} ignores conditions of writers (If-None-Match, "
                "If-Match), so two writers would lose data in silence. Use a server that honours "
                "them, or copy to a directory."
            )
        self._has_conditions = True

    def _put(self, name: str, content: bytes, mode: PutMode) -> str:
        import obstore

        def put() -> str:
            done = obstore.put(self._writing, name, content, mode=mode, use_multipart=False)
            return _version(done)

        return self._again(name, put)

    def _again(self, name: str, work: Callable[[], _T]) -> _T:
        """Do something again if the connection broke.

        The library repeats requests that change nothing, but not what was cut while it was
        read. Writers have conditions, and see what a request did whose answer was lost.
        """
        from obstore.exceptions import GenericError

        for attempt in range(_TRIES):
            with self.explained(name):
                try:
                    return work()
                except GenericError as error:
                    if attempt + 1 == _TRIES or _CUT.search(str(error)) is None:
                        raise
        raise AssertionError

    def _place(self, name: str) -> str:
        return f"{self.address}/{name}"

    @contextmanager
    def explained(self, name: str) -> Iterator[None]:
        """Raise errors of the library as errors of this program."""
        from obstore import exceptions

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
        except (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError) as error:
            raise BucketError(
                f"{self.address}: the server refuses access. Credentials come from the "
                "environment, such as AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY."
            ) from error
        except (exceptions.AlreadyExistsError, exceptions.NotSupportedError):
            raise
        except (exceptions.BaseError, ValueError) as error:
            raise BucketError(self._problem(name, _reason(error))) from error

    def _problem(self, name: str, reason: str) -> str:
        """An error of the library in words, with what cures it."""
        host = _HOST.search(reason)
        if _ROLES.search(reason):
            return (
                f"{self.address}: there are no credentials. Set AWS_ACCESS_KEY_ID and "
                "AWS_SECRET_ACCESS_KEY, or what your provider has in their place."
            )
        if "builder error" in reason and not _allows_http():
            return f"{self.address}: its server has no TLS. Set AWS_ALLOW_HTTP=true to allow that."
        if host is not None and "error sending request" in reason:
            return (
                f"{self.address}: the server {host[0]} does not answer. Is it running, and is "
                "AWS_ENDPOINT_URL its address?"
            )
        return f"{self._place(name)}: {reason}"


def digest_like(found: str, pieces: Iterable[Buffer]) -> str:
    """A digest of bytes, of the kind of another digest.

    Args:
        found: A digest of `Bucket.digest`: of objects that were sent in parts it is of theirs.
        pieces: The bytes.
    """
    if not _MD5.fullmatch(found):
        whole = hashlib.sha256()
        for piece in pieces:
            whole.update(piece)
        return whole.hexdigest()
    sums, now, left = [], hashlib.md5(usedforsecurity=False), _PART
    for piece in pieces:
        view = memoryview(piece)
        while "-" in found and len(view) > left:
            now.update(view[:left])
            sums.append(now.digest())
            view, now, left = view[left:], hashlib.md5(usedforsecurity=False), _PART
        now.update(view)
        left -= len(view)
    if "-" not in found:
        return now.hexdigest()
    sums.append(now.digest())
    return f"{hashlib.md5(b''.join(sums), usedforsecurity=False).hexdigest()}-{len(sums)}"


def joined_ranges(
    ranges: Iterable[tuple[int, int]], gap: int = JOINED_GAP
) -> list[tuple[int, int]]:
    """Ranges in order, joined where the gap between two is small."""
    joined: list[tuple[int, int]] = []
    for begin, end in sorted(ranges):
        if joined and begin - joined[-1][1] <= gap:
            joined[-1] = joined[-1][0], max(joined[-1][1], end)
        else:
            joined.append((begin, end))
    return joined


def _check_process(address: str) -> None:
    """Raise in a process that was forked: the library's threads are in its parent alone."""
    if _users.setdefault("first", os.getpid()) != os.getpid():
        raise BucketError(
            f"{address} cannot be read here: this process was forked from one that has read from "
            "a bucket. Start it by `spawn` instead, as multiprocessing_context='spawn' does."
        )


def _opened(address: str, timeout_s: int) -> ObjectStore:
    _check_process(address)
    try:
        from obstore.exceptions import BaseError
        from obstore.store import from_url
    except ImportError as error:
        raise MissingDependencyError(
            "Buckets need obstore: pip install 'hybridlog[remote]'"
        ) from error
    try:
        return from_url(
            address,
            client_options={"timeout": timedelta(seconds=timeout_s), "allow_http": _allows_http()},
            retry_config={"max_retries": 6, "retry_timeout": timedelta(seconds=_RETRY_S)},
        )
    except (BaseError, ValueError) as error:
        raise UsageError(f"{address} cannot be opened: {_reason(error)}") from error


def _allows_http() -> bool:
    """True if the environment allows a server without TLS, under the name that obstore reads."""
    names = ("AWS_ALLOW_HTTP", "GOOGLE_ALLOW_HTTP", "AZURE_ALLOW_HTTP", "ALLOW_HTTP")
    return any(os.environ.get(name, "").lower() in {"1", "true"} for name in names)


def _content(answer: GetResult, most: int) -> bytes:
    found = bytearray()
    for piece in answer.stream(1 << 20):
        found += piece
        if len(found) > most:
            return bytes(found[: most + 1])
    return bytes(found)


def _object(about: Any, name: str) -> Object:
    return Object(name, int(about["size"]), _version(about))


def _version(about: Any) -> str:
    version = about["e_tag"]
    if not isinstance(version, str) or not version:
        raise ValueError("the server gives no entity tags")
    return version


def _tag(about: Object) -> str:
    """The MD5 in the version of an object, as most servers that speak S3 have it; else empty."""
    tag = about.version.strip('"')
    return tag if _MD5.fullmatch(tag) else ""


def _reason(error: Exception) -> str:
    """The message of an error of the library, in one line and without what may be secret."""
    lines = str(error).partition("Debug source")[0].split("\n")
    text = " ".join(" ".join(lines).split())
    printable = "".join(one for one in text if one.isprintable())
    return _SECRETS.sub(r"\1=…", printable)[:400]
