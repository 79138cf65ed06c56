"""Places that recordings are copied to and from, and the first one: the directory of a store.

A place makes a file visible under its name only when all of it has arrived and is proved: its
bytes were read back, or the server has told their checksum. In a directory and on a server it grows
beside, as `.DIGEST.part`, where the next copy goes on. Others are in `remote.store` and `server`.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
from abc import ABC, abstractmethod
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import LOCK_WAIT_S, StoreDirectory
from hybridlog_storage.errors import StoreError, unreadable
from hybridlog_storage.manifest import digest_of, hasher
from hybridlog_storage.manifests import MANIFESTS, RECORDINGS, DiskManifests

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from hybridlog_storage.manifests import Manifests

MARK: Final = ".copying-"
"""Prefix of small files in `manifests` that live for a moment."""
_PIECE: Final = 1 << 20


class RefusedError(StoreError):
    """A recording that is not copied; others are."""


class Sending(Struct, frozen=True):
    """A file that is sent.

    Attributes:
        folder: Of its recording, below a store.
        digest: Of all its bytes, as the manifest has it.
        sizes: Bytes of the files that are in the folder there, by name.
        count: Told of bytes that were sent, or were there already; waits if that is too fast, and
            is a safe point.
    """

    source: Source
    folder: str
    file: str
    size: int
    digest: str
    sizes: dict[str, int] = {}
    count: Callable[[int, bool], None] = lambda *_: None

    @property
    def name(self) -> str:
        """Its path below a store."""
        return f"{self.folder}/{self.file}"

    @property
    def part(self) -> str:
        """The same, while it arrives."""
        return f"{self.folder}/.{self.digest[:32]}.part"

    def begins(self) -> list[int]:
        """Bytes to begin at: behind the part that arrived; if that is damaged, at 0."""
        there = self.sizes.get(self.part.rpartition("/")[2], 0)
        return [there, 0] if 0 < there <= self.size else [0]

    def again(self, at: int = 0) -> Iterator[bytes]:
        """Its bytes from byte `at` on; may be called again.

        `RefusedError` if it cannot be read, has another size, or, once all were read, another
        digest.
        """
        found = hasher()
        for piece in self.source.pieces(self.name, at, self.size):
            found.update(piece)
            yield piece
        if not at and found.hexdigest() != self.digest:
            raise RefusedError(
                f"{self.source.address}/{self.name} is damaged: its bytes do not have the digest "
                "that the manifest states. `hybridlog verify` shows where."
            )

    def pieces(self, at: int = 0) -> Iterator[bytes]:
        """The same, as fast as they may go; they are counted."""
        for piece in self.again(at):
            yield piece
            self.count(len(piece), True)

    def sha256(self) -> str:
        """SHA-256 of its bytes, in hexadecimal digits; errors as of `again`."""
        found = hashlib.sha256()
        for piece in self.again():
            found.update(piece)
        return found.hexdigest()

    def not_arrived(self, place: Place) -> RefusedError:
        """The error for one that has another digest there, because it has one here, or not."""
        self.sha256()
        return RefusedError(f"{place.address}/{self.name} did not arrive as it was sent.")


class Place(ABC):
    """A store that recordings are copied to; `address` is what people call it."""

    address: str
    manifests: Manifests

    @contextmanager
    def working(self, recording: str) -> Iterator[None]:
        """Copy into a recording; where there are locks, `HeldError` if another process does."""
        yield

    @abstractmethod
    def sizes(self, folder: str) -> dict[str, int]:
        """Bytes of each ordinary file of a folder, by name; none if there is no folder."""

    def send(self, sent: Sending) -> None:
        """Bring a file, and prove it; it takes the place of one of its name.

        A file that is damaged at the source raises `RefusedError`.
        """
        for at in sent.begins():
            sent.count(at, False)
            self._grow(sent, at)
            if self.has(sent.part, sent):
                self._publish(sent)
                return
        self.drop(sent.part)
        raise sent.not_arrived(self)

    def _grow(self, sent: Sending, at: int) -> None:
        """Write the part of a file from a byte on."""
        raise NotImplementedError

    def _publish(self, sent: Sending) -> None:
        """Give a part that is on the disk its name."""
        raise NotImplementedError

    @abstractmethod
    def has(self, name: str, sent: Sending) -> bool:
        """True if a file of this name is there and has the digest; it is on the disk then."""

    @abstractmethod
    def drop(self, name: str) -> None:
        """Delete what has arrived of a file that is no longer to come."""


class Source(Place):
    """A store that recordings are copied from, too."""

    @abstractmethod
    def pieces(self, name: str, at: int, size: int) -> Iterator[bytes]:
        """Bytes of a file below the store; `RefusedError` if none of `size` bytes is there."""


class Directory(Source):
    """The directory of a store."""

    def __init__(self, path: Path) -> None:
        self.address = str(path)
        self.manifests = DiskManifests(path)
        self._path = path

    @contextmanager
    def working(self, recording: str) -> Iterator[None]:
        """As of `Place`; nobody else writes the recording meanwhile."""
        with StoreDirectory(self._path).writing(recording, wait_s=LOCK_WAIT_S, makes=True):
            yield

    def sizes(self, folder: str) -> dict[str, int]:
        """As of `Place`."""
        path = self._path / folder
        try:
            found = files.names(path)
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise unreadable(error, path) from error
        return {name: one.st_size for name, one in found.items() if stat.S_ISREG(one.st_mode)}

    def _grow(self, sent: Sending, at: int) -> None:
        path = self._path / sent.part
        with files.explained(path, "copying into"), _file(path, os.O_RDWR | os.O_CREAT) as fd:
            files.system.truncate(fd, at)
            os.lseek(fd, at, os.SEEK_SET)
            for piece in sent.pieces(at):
                files.write_all(fd, [piece])

    def _publish(self, sent: Sending) -> None:
        with files.explained(self._path / sent.name, "copying into"):
            files.publish(self._path / sent.part, self._path / sent.name)

    def has(self, name: str, sent: Sending) -> bool:
        """As of `Place`."""
        path = self._path / name
        try:
            with _file(path, os.O_RDONLY) as fd:
                files.system.sync(fd)
                found = digest_of(read(fd, 0, sent.size))
            files.sync_folder(path.parent)
        except FileNotFoundError:
            return False
        except OSError as error:
            raise files.explain(error, path, "copying into") from error
        return found == sent.digest

    def drop(self, name: str) -> None:
        """As of `Place`."""
        with suppress(OSError):
            files.unlink(self._path / name)

    def pieces(self, name: str, at: int, size: int) -> Iterator[bytes]:
        """As of `Source`; what cannot be read of it is refused, too."""
        path = self._path / name
        with ExitStack() as stack:
            try:
                for folder in path.relative_to(self._path).parents:
                    stack.enter_context(files.folder(self._path / folder))  # none may be a link
                fd = stack.enter_context(_file(path, os.O_RDONLY))
                found = os.fstat(fd).st_size
                if found != size:
                    raise RefusedError(
                        f"{path} is damaged: it has {found} bytes instead of {size}."
                    )
                yield from read(fd, at, size)
            except OSError as error:
                raise RefusedError(f"{path} cannot be copied: {error.strerror}.") from error

    @contextmanager
    def marked(self) -> Iterator[str]:
        """Make a small file in `manifests`, for a moment; gives its name."""
        name = f"{MARK}{secrets.token_hex(8)}"
        path = self._path / MANIFESTS / name
        with (
            files.explained(path, "copying from"),
            _file(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL),
        ):
            pass
        try:
            yield name
        finally:
            self.drop(f"{MANIFESTS}/{name}")


@contextmanager
def _file(path: Path, flags: int) -> Iterator[int]:
    """A handle of an ordinary file."""
    fd = files.open_file(path, flags)
    try:
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            raise OSError(0, "it is not an ordinary file")
        yield fd
    finally:
        os.close(fd)


def read(fd: int, at: int, end: int) -> Iterator[bytes]:
    """Bytes of an open file, a megabyte at a time."""
    while at < end and (piece := files.pread(fd, min(_PIECE, end - at), at)):
        yield piece
        at += len(piece)


def folder_of(recording: str) -> str:
    """The folder of a recording below a store."""
    return f"{RECORDINGS}/{recording}"
