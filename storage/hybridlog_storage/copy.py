"""Copies a recording from a store to another one: its files, then its manifest.

What is there already is not sent. Into a manifest that is there go files, channels, losses and the
status; who copies from an older one takes nothing back. All that people said of the recording there
stays, and so do its logs, which are compared by number: one that has expired there is not brought
again, one that was left elsewhere is.

Here are places that recordings are copied to and from, and the first one: the directory of a store.

A place makes a file visible under its name only when all of it has arrived and is proved: its
bytes were read back, or the server has told their checksum. In a directory and on a server it grows
beside, as `.DIGEST.part`, where the next copy goes on. Others are in `remote.store` and `server`.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
import time
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec import Struct, field

from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import LOCK_WAIT_S, StoreDirectory
from hybridlog_storage.errors import ExistsError, StoreError, unreadable
from hybridlog_storage.manifest import File, Manifest, digest_of, hasher, replace
from hybridlog_storage.manifests import (
    MANIFEST_LOCK,
    MANIFEST_OLD,
    MANIFESTS,
    RECORDINGS,
    WRITER_LOCK,
    DiskManifests,
    Manifests,
)
from hybridlog_storage.stopping import pause, safe_point

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator


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


_TRIES: Final = 3  # of a recording whose files expire meanwhile
Prepared = tuple[Manifest, "Source"]
"""A manifest to send, and the store that has the files which are in no other one."""


class How(Struct, frozen=True):
    """The way in which recordings are copied.

    Attributes:
        prepare: Makes of a manifest, and of those of its logs that are to be sent, what is sent in
            its place; None to send the files as they are.
        check: Prove what is there already, too, and send it again if it is wrong.
        limit_rate: Bytes a second, at most; None for no limit.
        named: Makes a free name there of the name here. Meanwhile nobody else begins a recording,
            where there are locks.
        progress: Called with the bytes done, and those in all.
        proved: Called with the numbers of logs that were proved there just now; where there are
            locks, nobody changes the copy meanwhile.
    """

    prepare: Callable[[Manifest, list[File]], AbstractContextManager[Prepared]] | None = None
    check: bool = False
    limit_rate: float | None = None
    named: Callable[[str], str] = lambda name: name
    progress: Callable[[int, int], None] = lambda *_: None
    proved: Callable[[Collection[int]], None] | None = None


class Copied(Struct):
    """A recording after it was copied.

    Attributes:
        manifest: As it is there now.
        bytes: Of the files that were sent, or proved.
        sent: Paths of the files that were sent, below the recording.
        sent_bytes: Bytes of them, without those that an interrupted copy had sent.
        lacking: Numbers of logs of which payloads have expired there, and are here.
        lost: Paths of files that the copy has lost, and that are not here.
    """

    manifest: Manifest
    is_new: bool = False
    bytes: int = 0
    sent: list[str] = field(default_factory=list)
    sent_bytes: int = 0
    lacking: list[int] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


def copy(source: Source, target: Place, recording: str, how: How | None = None) -> Copied:
    """Copy a recording. What an interrupted copy has left is used by the next one.

    After a `RefusedError` (it is damaged, or another recording there has its id) others can be
    copied; after any error, what was copied stays.
    """
    for attempt in range(_TRIES):
        here = source.manifests.read(recording)
        try:
            return _Copy(source, target, here, how or How()).run()
        except RefusedError:  # a file that has expired meanwhile is no damage
            if attempt + 1 == _TRIES or source.manifests.read(recording) == here:
                raise
    raise AssertionError


class _Copy:
    """The steps of a copy."""

    def __init__(self, source: Source, target: Place, here: Manifest, how: How) -> None:
        self._source, self._target, self._here, self._how = source, target, here, how
        self._others = source  # has the files that are not here
        self._must_prove = how.check or how.proved is not None
        self._done = self._total = 0
        self._due = 0.0  # time from which more may be sent
        self._proved: dict[str, str] = {}  # digests by path
        self._sizes: dict[str, int] = {}  # of the files that are there

    def run(self) -> Copied:
        here, target = self._here, self._target
        there = self._look()
        if there is not None and self._is_known(there):
            return Copied(there, lacking=_lacking(here, there))  # found without a lock
        if here.status == "unproven":
            raise RefusedError(
                f"{here.name} is not copied: its manifest was lost and made again, so nothing "
                f"says that it is whole. Copy it from a store that has lost nothing of it."
            )
        with target.working(here.id), ExitStack() as stack:
            there = self._look()
            if there is None:
                self._check_lost()
            logs = self._wanted(there)
            if logs and self._how.prepare is not None:
                here, self._others = stack.enter_context(self._how.prepare(here, logs))
                logs = [here.logs[log.number] for log in logs]
            numbers = {log.number for log in logs}
            self._copied = Copied(here, there is None, lacking=_lacking(here, there))
            self._bring(here, there, numbers)
            self._copied.manifest = now = self._publish(here, there, numbers)
            self._clear(there, now)
            if self._how.proved is not None:
                self._how.proved(self._proved_logs(here))
        return self._copied

    def _look(self) -> Manifest | None:
        there = self._target.manifests.find(self._here.id)
        check_origin(self._here, there)
        self._sizes = self._target.sizes(folder_of(self._here.id))
        return there

    def _wanted(self, there: Manifest | None) -> list[File]:
        return wanted(self._here, there, awaited=self._how.prepare is None)

    def _is_known(self, there: Manifest) -> bool:
        """True if there is nothing to copy, and nothing to prove."""
        if self._must_prove or there.status == "unproven" or self._wanted(there):
            return False
        return all(self._sizes.get(name) == one.bytes for name, one in there.present.items())

    def _check_lost(self) -> None:
        """Raise if a recording has lost its manifest, and may have more than is known here."""
        here, sizes = self._here, self._sizes
        logs = {f"{number:06d}": log.bytes for number, log in here.logs.items() if log.is_here}
        is_begun = WRITER_LOCK in sizes and MANIFEST_LOCK not in sizes  # by a stopped copy
        more = [
            path
            for path in sorted(sizes)
            if path == MANIFEST_OLD
            or (not is_begun and path.endswith(".mcap") and sizes[path] > logs.get(path[:6], -1))
        ]
        if more:
            raise RefusedError(
                f"{here.name} in {self._target.address} has lost its manifest, and may have what "
                f"is not here, in {', '.join(more)}. It stays as it is: run `hybridlog verify "
                "--repair` there, then copy again."
            )

    def _bring(self, here: Manifest, there: Manifest | None, numbers: Collection[int]) -> None:
        """Send what is lacking, or lost, and prove what has to be."""
        ours, copied, sizes = here.present, self._copied, self._sizes
        listed = {} if there is None else there.present
        kept = merged(here, there, numbers).present
        old = [listed[name] for name in kept if name in listed]
        wanted = [one for one in ours.values() if one.number in numbers]
        wanted += [one for one in old if self._must_prove or sizes.get(one.name) != one.bytes]
        copied.bytes = self._total = sum(one.bytes for one in wanted)
        for one in wanted:
            is_there = sizes.get(one.name) == one.bytes
            sent, target = self._sending(one), self._target
            if one.name not in ours or ours[one.name].digest != one.digest:
                if is_there:  # nothing here tells more of it than its size
                    self._count(one.bytes, False)
                else:
                    copied.lost.append(one.name)
                continue
            if is_there and target.has(sent.name, sent):
                self._count(one.bytes, False)
            else:
                target.send(sent)
                copied.sent.append(one.name)
            self._proved[one.name] = one.digest

    def _sending(self, file: File) -> Sending:
        source = self._source if file.name in self._here.present else self._others
        folder = folder_of(self._here.id)
        return Sending(source, folder, file.name, file.bytes, file.digest, self._sizes, self._count)

    def _count(self, size: int, is_sent: bool) -> None:  # noqa: FBT001 - as of Sending
        """Note bytes that were sent, or were there; wait as long as the limit of the rate asks."""
        safe_point()
        self._done += size
        self._how.progress(min(self._done, self._total), self._total)
        if is_sent:
            self._copied.sent_bytes += size
        if is_sent and self._how.limit_rate is not None:
            now = time.monotonic()
            self._due = max(self._due, now) + size / self._how.limit_rate
            pause(max(self._due - now, 0.0))

    def _publish(
        self, here: Manifest, there: Manifest | None, brought: Collection[int]
    ) -> Manifest:
        manifests, target = self._target.manifests, self._target
        new = {one.name for one in here.present.values() if one.number in brought}
        if new and not new <= target.sizes(folder_of(here.id)).keys():
            raise StoreError(  # a removal that ends takes them along
                f"Files of {here.name} have gone from {target.address} meanwhile. Copy again."
            )
        if there is None:
            # Another process may be faster.
            with suppress(ExistsError), manifests.creating() as create:
                made = replace(here, name=self._how.named(here.name))
                create(made)
                return made
        return manifests.change(here.id, lambda now: merged(here, now, brought))

    def _clear(self, there: Manifest | None, now: Manifest) -> None:
        """Delete files that others have replaced, and what was left of stopped copies."""
        known = self._sizes.keys() - {MANIFEST_LOCK, WRITER_LOCK}
        left = {path for path in known if path.endswith(".part")}
        left |= known if there is None else there.present.keys()
        for path in left - now.present.keys():
            self._target.drop(f"{folder_of(now.id)}/{path}")

    def _proved_logs(self, here: Manifest) -> set[int]:
        """Numbers of logs whose copies were proved, and that are still listed there."""
        there = self._target.manifests.read(here.id).logs
        return {
            number
            for number, log in here.logs.items()
            if log.is_here
            and number in there
            and there[number].is_here
            and self._proved.get(there[number].name) == log.digest
        }


def _lacking(here: Manifest, there: Manifest | None) -> list[int]:
    known = {} if there is None else there.logs
    return [
        number
        for number, log in here.logs.items()
        if log.is_here and number in known and known[number].gone == "expired"
    ]


def wanted(here: Manifest, there: Manifest | None, *, awaited: bool = True) -> list[File]:
    """The logs that a copy lacks; of those that are gone here, the rows are sent.

    `there` is the manifest of the copy so far, None if it is new; `awaited` adds those that were
    left for later.
    """
    known = {} if there is None else there.logs
    return [
        log
        for number, log in here.logs.items()
        if number not in known
        or (awaited and known[number].gone == "elsewhere" and log.gone != "elsewhere")
    ]


def merged(here: Manifest, there: Manifest | None, brought: Collection[int]) -> Manifest:
    """The manifest of a copy; `there` is the one so far, None if it is new.

    `brought` has the numbers of the logs that are there now, whole, or with their rows.
    """
    if there is None:
        return here
    check_origin(here, there)
    new = {log.number: log for log in wanted(here, there) if log.number in brought}
    rows = [f for f in there.files if f.kind == "rows" and f.number not in new]
    rows += [f for f in here.files if f.kind == "rows" and f.number in new]
    channels = {
        number: channel
        for number, channel in here.channels.items()
        if number not in there.channels or channel.messages >= there.channels[number].messages
    }
    is_newer = _messages(here) >= _messages(there)
    has_status = is_newer and (here.status != "open" or there.status == "open")
    return replace(
        there,
        files=(*{**there.logs, **new}.values(), *rows),
        channels={**there.channels, **channels},
        losses=here.losses if is_newer else there.losses,
        status=here.status if has_status else there.status,
    )


def _messages(manifest: Manifest) -> int:
    """Messages that a recording has had; with a ring, those that went, too."""
    gone = 0 if manifest.let_go is None else manifest.let_go.messages
    return gone + sum(channel.messages for channel in manifest.channels.values())


def check_origin(here: Manifest, there: Manifest | None) -> None:
    """Raise `RefusedError` if two manifests of one id are not of one recording."""
    if there is None:
        return
    logs, channels = there.logs, there.channels
    is_one = (
        here.created == there.created
        and all(
            channels[number].topic == one.topic
            for number, one in here.channels.items()
            if number in channels
        )
        and all(
            logs[number].parts == log.parts for number, log in here.logs.items() if number in logs
        )
    )
    if not is_one:
        raise RefusedError(
            f"{here.name} is not copied: another recording, {there.name}, has its id {here.id} "
            "there."
        )
