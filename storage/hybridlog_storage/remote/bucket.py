"""Objects in a bucket, by way of obstore (extra `remote`).

A bucket has no locks and no renames. What it has are conditions: an object is created only if
its name is free, and replaced only if it is still the version that was seen. A server that
ignores conditions would lose data in silence, so it is refused before the first write.

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
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from msgspec import Struct

from hybridlog_storage.errors import (
    BucketError,
    MissingDependencyError,
    ObjectChangedError,
    ObjectExistsError,
    UsageError,
)
from hybridlog_storage.remote import address_of

try:
    import obstore.store
    from obstore import exceptions
except ImportError as error:
    raise MissingDependencyError("Buckets need obstore: pip install 'hybridlog[remote]'") from error

if TYPE_CHECKING:
    from obstore import GetOptions, PutMode
    from obstore.store import ObjectStore

    from hybridlog_storage.messages import Buffer

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
        """Create an object of a free name, else `ObjectExistsError`; returns its version.

        One that has this very content counts as created.
        """
        self._check("create")
        with suppress(ObjectExistsError):  # by another writer, or by this one whose answer is lost
            return self._put(name, content, "create")
        with suppress(FileNotFoundError):
            about, found = self.read_whole(name, len(content))
            if found == content:
                return about.version
        raise ObjectExistsError(f"{self._place(name)} exists, with other content.")

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
        except (FileNotFoundError, ObjectChangedError, ObjectExistsError):
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
            raise ObjectExistsError(f"{self._place(name)} exists.") from error
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
