"""Places that recordings are copied to and from, and the first one: the directory of a store.

A place makes a file visible under its name only when all of it has arrived and is proved: its
bytes were read back, or the server has told their checksum. In a directory it grows beside, as
`.DIGEST.part`, where the next copy goes on. Others are in `remote.store` and `server`.
"""

from __future__ import annotations

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
        file: Its path below its recording.
        digest: Of all its bytes, as the manifest has it.
        count: Told of bytes that were sent, or were there already; waits if that is too fast, and
            is a safe point.
    """

    source: Source
    recording: str
    file: str
    size: int
    digest: str
    count: Callable[[int, bool], None] = lambda *_: None

    @property
    def name(self) -> str:
        """Its path below a store."""
        return f"{RECORDINGS}/{self.recording}/{self.file}"

    @property
    def part(self) -> str:
        """The same, while it arrives."""
        return f"{RECORDINGS}/{self.recording}/.{self.digest[:32]}.part"

    def again(self, at: int = 0) -> Iterator[bytes]:
        """Its bytes from one on; `RefusedError` if it cannot be read, or has another size."""
        return self.source.pieces(self.name, at, self.size)

    def pieces(self, at: int = 0) -> Iterator[bytes]:
        """The same, as fast as they may go; they are counted."""
        for piece in self.again(at):
            yield piece
            self.count(len(piece), True)

    def checked(self) -> Iterator[bytes]:
        """The same; the last ones only if all have the digest, else `RefusedError`."""
        found, last = hasher(), b""
        for piece in self.pieces():
            found.update(piece)
            if last:
                yield last
            last = piece
        if found.hexdigest() != self.digest:
            raise self.damaged()
        yield last

    def begins(self, there: int) -> list[int]:
        """Bytes to begin at: behind the part that arrived; if that is damaged, at 0."""
        return [there, 0] if 0 < there <= self.size else [0]

    def not_arrived(self, place: Place) -> RefusedError:
        """The error for one that has another digest there, because it has one here, or not."""
        if digest_of(self.again()) != self.digest:
            return self.damaged()
        return RefusedError(f"{place.address}/{self.name} did not arrive as it was sent.")

    def damaged(self) -> RefusedError:
        """The error for one whose bytes have another digest than the manifest states."""
        return RefusedError(
            f"{self.source.address}/{self.name} is damaged: its bytes do not have the digest that "
            "the manifest states. `hybridlog verify` shows where."
        )


class Place(ABC):
    """A store that recordings are copied to; `address` is what people call it."""

    address: str
    manifests: Manifests

    @contextmanager
    def working(self, recording: str) -> Iterator[None]:
        """Copy into a recording; where there are locks, `HeldError` if another process does."""
        yield

    def sees(self, name: str) -> bool:
        """True if a file that another store has made in `manifests` is here, too."""
        return False

    @abstractmethod
    def sizes(self, recording: str) -> dict[str, int]:
        """Bytes of each ordinary file of a recording, by path below it."""

    @abstractmethod
    def send(self, sent: Sending) -> None:
        """Bring a file, and prove it; it takes the place of one of its name.

        A file that is damaged at the source raises `RefusedError`.
        """

    @abstractmethod
    def drop(self, name: str) -> None:
        """Delete what has arrived of a file that is no longer to come."""

    @abstractmethod
    def is_whole(self, sent: Sending, *, reads: bool = False) -> bool:
        """True if a file that is there has the digest; it is on the disk then.

        `reads`: believe no checksum that was worked out when the file arrived.
        """


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

    def sees(self, name: str) -> bool:
        """As of `Place`."""
        with suppress(FileNotFoundError):
            return name in files.names(self._path / MANIFESTS)
        return False

    def sizes(self, recording: str) -> dict[str, int]:
        """As of `Place`."""
        path = self._path / RECORDINGS / recording
        try:
            found = files.names(path)
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise unreadable(error, path) from error
        return {name: one.st_size for name, one in found.items() if stat.S_ISREG(one.st_mode)}

    def send(self, sent: Sending) -> None:
        """As of `Place`; goes on behind the last byte that is there."""
        final, part = self._path / sent.name, self._path / sent.part
        with files.explained(final, "copying into"):
            fd = files.open_file(part, os.O_RDWR | os.O_CREAT)
            try:
                about = os.fstat(fd)
                if not stat.S_ISREG(about.st_mode):
                    raise OSError(0, "it is not an ordinary file")
                if not any(self._grown(fd, at, sent) for at in sent.begins(about.st_size)):
                    files.system.truncate(fd, 0)
                    raise sent.not_arrived(self)
            finally:
                os.close(fd)
            files.publish(part, final)

    def _grown(self, fd: int, at: int, sent: Sending) -> bool:
        """Write a file from a byte on; True if it is on the disk, with its digest."""
        files.system.truncate(fd, at)
        sent.count(at, False)
        os.lseek(fd, at, os.SEEK_SET)
        for piece in sent.pieces(at):
            files.write_all(fd, [piece])
        files.system.sync(fd)
        return digest_of(read(fd, 0, sent.size)) == sent.digest

    def drop(self, name: str) -> None:
        """As of `Place`."""
        with suppress(OSError):
            files.unlink(self._path / name)

    def is_whole(self, sent: Sending, *, reads: bool = False) -> bool:
        """As of `Place`."""
        path = self._path / sent.name
        try:
            with _file(path) as fd:
                if digest_of(read(fd, 0, sent.size)) != sent.digest:
                    return False
                files.system.sync(fd)
            files.sync_folder(path.parent)
        except FileNotFoundError:
            return False
        except OSError as error:
            raise unreadable(error, path) from error
        return True

    def pieces(self, name: str, at: int, size: int) -> Iterator[bytes]:
        """As of `Source`; what cannot be read of it is refused, too."""
        path = self._path / name
        with ExitStack() as stack:
            try:
                for folder in path.relative_to(self._path).parents:
                    stack.enter_context(files.folder(self._path / folder))  # none may be a link
                fd = stack.enter_context(_file(path))
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
        path = self._path / MANIFESTS / f"{MARK}{secrets.token_hex(8)}"
        with files.explained(path, "copying from"):
            os.close(files.open_file(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        try:
            yield path.name
        finally:
            with suppress(OSError):
                files.unlink(path)


@contextmanager
def _file(path: Path) -> Iterator[int]:
    """A handle of an ordinary file."""
    fd = files.open_file(path, os.O_RDONLY)
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
