"""Places that recordings are copied to: what one can do, and a store's directory as one.

A place believes nothing that it is told. It takes bytes, and says itself whether a file is
whole: a segment or a file of columns has a digest in the manifest, of its own list of checksums
of all of its bytes. A recording gets its name when every file that its manifest lists is whole.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, Protocol

from msgspec import Meta, convert, structs, to_builtins

from hybridlog.entries import Inventory, check_folder, free_name_in, put_entry, take_inventory
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import (
    IMPORTING,
    LOCK,
    LOCK_WAIT_S,
    PAYLOADS,
    REMOVED,
    payload_names,
)
from hybridlog_storage.errors import (
    HeldError,
    ManifestError,
    StoreError,
    TopicError,
    unreadable,
)
from hybridlog_storage.manifest import (
    MAX_BYTES,
    Count,
    Fields,
    Manifest,
    Topic,
    decode,
    is_id,
    replace,
)
from hybridlog_storage.manifests import MANIFEST_LOCK
from hybridlog_storage.remote.bucket import digest_like
from hybridlog_storage.segments.segment_check import SegmentCheck
from hybridlog_storage.settings import EXPIRED

if TYPE_CHECKING:
    from collections.abc import Callable

    from hybridlog_storage.catalog import Catalog
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.messages import Buffer

_SEGMENT: Final = re.compile(r"[0-9]{6}\.mcap")
_FILE: Final = r"\A([0-9]{6}\.mcap|(?!\.)[^/\0]{1,255}/(?!\.)[^/\0]{1,255})\Z"
_MARK: Final = re.compile(rf"{re.escape(REMOVED)}[0-9a-f]{{16}}")
_PIECE: Final = 1 << 20
_FETCHED: Final = 8 << 20  # bytes that a bucket is asked for


class RefusedError(StoreError):
    """A recording that is not copied; others are."""


class CopiedFile(Fields, frozen=True):
    """A file of fields; or a segment, whose `file` is its name."""

    file: Annotated[str, Meta(pattern=_FILE)]
    topic: Topic = ""
    messages: Count = 0

    @classmethod
    def of(cls, value: object) -> CopiedFile:
        """A file from elsewhere.

        Raises:
            ValueError: It is malformed.
        """
        return convert(value, cls)

    def to_json(self) -> object:
        """As of `of`."""
        return to_builtins(self)

    @property
    def is_segment(self) -> bool:
        """True for a segment."""
        return "/" not in self.file

    def below(self, recording: Path) -> Path:
        """Its path in the directory of its recording."""
        return recording / self.file if self.is_segment else recording / PAYLOADS / self.file

    def is_whole(self, recording: Path) -> bool:
        """True if the file is there, byte for byte."""
        try:
            if not self.is_segment:
                from hybridlog.columns.field_files import FieldFile

                FieldFile(recording / PAYLOADS, self).check()
                return True
            with SegmentCheck(recording / self.file, self.digest) as check:
                return check.summary is not None and not any(True for _ in check.problems())
        except StoreError:
            return False


@dataclass(frozen=True, slots=True)
class Copied:
    """A recording that a place has.

    Attributes:
        name: Its name there.
        lacks_payloads: Whether only its fields were copied: the next copy completes it.
        is_damaged: Whether objects of it were lost: the next copy brings them back.
        expired: Number of expired topics there, summed over its segments.
        content: As of `content_of`.
    """

    name: str
    lacks_payloads: bool = False
    expired: int = 0
    content: str = ""
    is_damaged: bool = False


class CopiedSegment(NamedTuple):
    """A segment of a recording that a place has.

    Attributes:
        digest: Its digest.
        expired: Topics whose payloads have.
    """

    digest: str
    expired: tuple[str, ...] = ()

    def holds(self, other: CopiedSegment) -> bool:
        """True if it surely has all that another copy of the segment has."""
        return self.digest == other.digest or not self.expired


@dataclass(frozen=True, slots=True)
class Begun:
    """A recording that is about to be copied.

    Attributes:
        known: The recording, if the place has it already: then nothing was begun.
        sizes: Bytes of the files that an interrupted copy has left, by name.
        lost: Files that a damaged copy has lost: only these are sent. None to send all.
    """

    known: Copied | None = None
    sizes: Mapping[str, int] = field(default_factory=dict)
    lost: Sequence[CopiedFile] | None = None


class Place(Protocol):
    """A destination of copies. One recording at a time, by one thread."""

    name: str
    """What people call it."""

    proves: bool
    """Whether `prove` reads what has arrived. Otherwise files are checked before they are sent."""

    def sees(self, mark: str) -> bool:
        """True if a file that another store has made among its recordings is here, too."""

    def have(self, recordings: Sequence[str]) -> dict[str, Copied]:
        """Those of some recordings that it has, by id."""

    def segments(self, recording: str) -> dict[int, CopiedSegment]:
        """Segments of a recording, by number."""

    def begin(self, recording: str, *, wants_payloads: bool) -> Begun:
        """Begin or go on with a recording; nobody else copies it here until `leave`.

        Args:
            recording: Its id.
            wants_payloads: Whether one that lacks payloads is to be completed.
        """

    def digest(self, file: CopiedFile, length: int) -> str:
        """A digest of the first bytes of a file that is there; see `digest_like`."""

    def append(self, file: CopiedFile, at: int, data: Buffer) -> None:
        """Write bytes of a file, and cut off what is there behind them.

        Args:
            file: The file.
            at: Their first byte; not behind what is there.
            data: The bytes.
        """

    def prove(self, file: CopiedFile) -> bool:
        """Read a file and check all of its bytes; True if it is whole and on the disk."""

    def publish(self, data: bytes) -> str:
        """Put the recording in its place, when all files that its manifest lists are proven.

        Args:
            data: Its manifest.

        Returns:
            Its name there: one that another recording has gets a number.
        """

    def hold(self, recordings: Sequence[str]) -> bool:
        """Keep payloads of recordings until `leave`; False if somebody deletes some now."""

    def drop(self) -> None:
        """Delete what has arrived of the recording that was begun, if one was."""

    def leave(self) -> None:
        """End the copy of a recording; what has arrived stays for the next one."""

    def problems(self, recording: str) -> list[str]:
        """Read a recording that it has, and say what is wrong with it."""


class DirectoryPlace:
    """A store's directory.

    Args:
        directory: The store.
        catalog: Its catalog.

    Attributes:
        published: Ids of the recordings that were copied.

    Raises:
        StoreError: It cannot be written.
    """

    proves = True

    def __init__(self, directory: StoreDirectory, catalog: Catalog) -> None:
        directory.check_writable()
        self.name = str(directory.path)
        self.published: list[str] = []
        self._directory = directory
        self._catalog = catalog
        self._recording = ""
        self._held = ExitStack()
        self._proven: dict[str, CopiedFile] = {}
        self._opened: tuple[str, int, int] = "", -1, 0  # file, its handle, bytes of it

    @property
    def _path(self) -> Path:
        """The hidden directory that the recording is copied into."""
        if not self._recording:
            raise StoreError("No copy of a recording was begun.")
        return self._directory.recording(f"{IMPORTING}{self._recording}")

    def sees(self, mark: str) -> bool:
        """As of `Place`."""
        if not _MARK.fullmatch(mark):
            raise StoreError(f"{mark[:40]!r} is no mark of a store.")
        return self._directory.has(mark)

    def have(self, recordings: Sequence[str]) -> dict[str, Copied]:
        """As of `Place`."""
        there = [recording for recording in recordings if self._directory.has(recording)]
        return {recording: copied_of(self._directory, recording) for recording in there}

    def segments(self, recording: str) -> dict[int, CopiedSegment]:
        """As of `Place`."""
        return segments_of(manifest_of(self._directory, recording))

    def begin(self, recording: str, *, wants_payloads: bool, wait_s: float = LOCK_WAIT_S) -> Begun:
        """As of `Place`.

        Args:
            recording: Its id.
            wants_payloads: Whether one that lacks payloads is to be completed.
            wait_s: Seconds to wait for another process that copies it here.
        """
        from hybridlog.maintenance.opening import clear_away

        self.leave()
        if not is_id(recording):
            raise StoreError(f"{recording[:40]!r} is no id of a recording.")
        self._recording = recording
        hidden = self._path.name
        while True:
            try:
                files.make_folder(self._path)
            except FileExistsError:
                pass  # a copy was interrupted, or another process copies it
            except OSError as error:
                raise durability.explain(error, self._path, "copying into") from error
            try:
                self._held.enter_context(self._directory.writing(hidden, wait_s=wait_s))
                break
            except TopicError:
                pass  # another process has put it in its place
            except HeldError as error:
                raise HeldError(
                    f"another process copies it into {self.name} at this moment.",
                    is_recording=False,
                ) from error
        known = self.have([recording]).get(recording)
        if known is not None and not (known.lacks_payloads and wants_payloads):
            _sweep(self._path)
            self.leave()
            return Begun(known)
        clear_away(self._directory, hidden)
        return Begun(sizes=dict(self._sizes()))

    def _sizes(self) -> Iterator[tuple[str, int]]:
        try:
            found = files.names(self._path)
            segments = {name: about for name, about in found.items() if _SEGMENT.fullmatch(name)}
            for name, about in {**segments, **payload_names(self._path)}.items():
                if stat.S_ISREG(about.st_mode):
                    yield name, about.st_size
        except OSError as error:
            raise unreadable(error, self._path) from error

    def digest(self, file: CopiedFile, length: int) -> str:
        """As of `Place`."""
        path = file.below(self._path)
        return digest_like("", pieces_of(path, 0, length, _PIECE))

    def append(self, file: CopiedFile, at: int, data: Buffer) -> None:
        """As of `Place`."""
        path = file.below(self._path)
        self._proven.pop(file.file, None)
        try:
            name, fd, end = self._opened
            if (name, end) != (file.file, at):
                fd = self._open(file, at)
            if at + len(data) > file.bytes:
                raise StoreError(f"{file.file} has {file.bytes} bytes, and more came.")
            durability.write_all(fd, [data])
            self._opened = file.file, fd, at + len(data)
        except OSError as error:
            self._close()
            raise durability.explain(error, path, "copying into") from error

    def _open(self, file: CopiedFile, at: int) -> int:
        """The handle of a file, with `at` bytes."""
        self._close()
        path = file.below(self._path)
        files.make_folders(path.parent)
        flags = os.O_RDWR | os.O_CREAT | os.O_NONBLOCK
        fd = files.open_file(path, flags)
        self._opened = "", fd, 0
        about = os.fstat(fd)
        if not stat.S_ISREG(about.st_mode) or about.st_size < at:
            raise StoreError(f"{file.file} does not have {at} bytes yet.")
        if about.st_size > at:
            files.system.truncate(fd, at)
        os.lseek(fd, at, os.SEEK_SET)
        return fd

    def _close(self) -> None:
        _, fd, _ = self._opened
        self._opened = "", -1, 0
        if fd >= 0:
            os.close(fd)

    def prove(self, file: CopiedFile) -> bool:
        """As of `Place`."""
        self._close()
        path = file.below(self._path)
        if not file.is_whole(self._path):
            return False
        try:
            # An earlier copy may have written it; it is forced to the disk by its content.
            fd = files.open_file(path, os.O_RDWR | os.O_NONBLOCK)
            try:
                durability.sync_file(fd)
            finally:
                os.close(fd)
        except OSError as error:
            raise durability.explain(error, path, "copying into") from error
        self._proven[file.file] = file
        return True

    def publish(self, data: bytes) -> str:
        """As of `Place`."""
        directory, recording = self._directory, self._recording
        new = proven_manifest(data, recording, self._proven)
        self._clear(new)
        if new.fields:
            directory.require(EXPIRED)
        with ExitStack() as held:
            if self.have([recording]):
                held.enter_context(directory.writing(recording, wait_s=LOCK_WAIT_S))
                name = self._put_over(new)
            else:
                create = held.enter_context(directory.manifests.creating())
                name = free_name_in(self._catalog, new.name, recording)
                self._put()
                create(replace(new, name=name))
            put_entry(directory, self._catalog, recording)
        self.published.append(recording)
        self.leave()
        return name

    def _clear(self, new: Manifest) -> None:
        """Remove what an interrupted copy has left, and force the names of files to the disk."""
        path = self._path
        keep = {LOCK, PAYLOADS, *(file.name for file in new.files)}
        fields = {one.file for one in new.fields}
        try:
            for name in files.names(path).keys() - keep:
                files.remove_tree(path / name)
            for name in payload_names(path).keys() - fields:
                files.remove_tree(path / PAYLOADS / name)
            folders = {(path / PAYLOADS / name).parent for name in fields}
            for folder in folders:
                files.sync_folder(folder)
            if folders:
                files.sync_folder(path / PAYLOADS)
            files.sync_folder(path)
        except OSError as error:
            raise durability.explain(error, path, "copying into") from error

    def _put(self) -> None:
        """Put the files in their place."""
        path, final = self._path, self._directory.recording(self._recording)
        removed = final.with_name(f"{REMOVED}{secrets.token_hex(8)}")
        try:
            with suppress(FileNotFoundError):
                files.rename(final, removed)
            files.rename(path, final)
            files.sync_folder(final.parent)
        except OSError as error:
            raise durability.explain(error, path, "renaming") from error
        _sweep(removed)

    def _put_over(self, new: Manifest) -> str:
        """Put the recording in the place of a copy without payloads; returns its name."""
        old = self._directory.recording(self._recording)

        def put(there: Manifest) -> Manifest:
            # The lock that keeps others from changes goes along: they wait, and change the new one.
            made = merged(there, new)
            try:
                for name in (MANIFEST_LOCK, *marked_there(made, new)):
                    with suppress(FileExistsError):
                        files.link(old / name, self._path / name)
                files.sync_folder(self._path)
            except OSError as error:
                raise durability.explain(error, self._path, "copying into") from error
            self._put()
            return made

        return self._directory.manifests.change(self._recording, put).name

    def hold(self, recordings: Sequence[str]) -> bool:
        """As of `Place`."""
        return self._held.enter_context(self._directory.retaining())

    def drop(self) -> None:
        """As of `Place`."""
        if self._recording:
            self._close()
            _sweep(self._path)

    def leave(self) -> None:
        """As of `Place`."""
        self._close()
        self._held.close()
        self._recording = ""
        self._proven.clear()

    def problems(self, recording: str) -> list[str]:
        """As of `Place`."""
        return problems_of(self._directory, recording)


def _sweep(path: Path) -> None:
    try:
        files.remove_tree(path)
    except OSError as error:
        raise durability.explain(error, path, "removing") from error


def problems_of(
    directory: StoreDirectory,
    recording: str,
    is_whole: Callable[[CopiedFile], bool] | None = None,
) -> list[str]:
    """Read a whole recording, and say what is wrong with it.

    Args:
        directory: Its store.
        recording: Its id.
        is_whole: Reads a file of it; None to read it where it is.
    """
    if not directory.has(recording):
        return ["it is gone"]
    try:
        inventory = take_inventory(directory, recording)
    except ManifestError as error:
        return [str(error)]
    found = [misfit.reason for misfit in inventory.misfits]
    if not inventory.is_proven:
        found.append("it is incomplete")
    path = directory.recording(recording)
    is_whole = is_whole or (lambda file: file.is_whole(path))
    return found + [f"{f.file} is damaged" for f in files_of(inventory) if not is_whole(f)]


def manifest_of(directory: StoreDirectory, recording: str) -> Manifest | None:
    """The manifest of a recording; None if it is lost or damaged."""
    with suppress(ManifestError):
        return directory.manifests.find(recording)
    return None


def segments_of(manifest: Manifest | None) -> dict[int, CopiedSegment]:
    """As of `Place`, by the manifest of a recording."""
    logs = {} if manifest is None else manifest.logs
    return {number: CopiedSegment(one.digest, one.expired) for number, one in logs.items()}


def has_lost(one: Mapping[int, CopiedSegment], other: Mapping[int, CopiedSegment]) -> bool:
    """True if payloads expired in one copy that another one still has; both as of `segments`."""
    left = {number: {*segment.expired} for number, segment in other.items()}
    return any({*segment.expired} - left.get(n, set()) for n, segment in one.items())


def copied_of(directory: StoreDirectory, recording: str) -> Copied:
    """A recording of a store, by its manifest.

    Raises:
        StoreError: Its folder has another one.
    """
    manifest = manifest_of(directory, recording)
    if manifest is None:
        return Copied(recording)
    check_folder(directory, recording, manifest.id)
    return Copied(
        manifest.name,
        manifest.lacks_payloads,
        sum(len(log.expired) for log in manifest.logs.values()),
        content_of(digests_of(manifest)),
    )


def merged(there: Manifest, new: Manifest) -> Manifest:
    """A copy in the place of one that users have edited since.

    What they said of it stays; so do marks that they set there, with their logs.

    Raises:
        RefusedError: A mark that was set here has the number of one there.
    """
    known = {mark.id for mark in new.marks}
    marks = [mark for mark in there.marks if mark.id not in known]
    numbers = {mark.segment for mark in marks}
    if numbers & new.logs.keys():
        raise RefusedError(
            f"Recording {new.name!r} was marked here and in its copy, where its payloads or its "
            "manifest have to be completed first: note the mark there, `hybridlog mark --remove` "
            "it, copy again, and set it again."
        )
    logs = [log for number, log in there.logs.items() if number in numbers]
    channels = {number: there.channels[number] for log in logs for number in log.parts}
    return replace(
        new,
        name=there.name,
        tags=there.tags,
        notes=there.notes,
        pins=there.pins,
        marks=(*new.marks, *marks),
        files=(*new.files, *logs),
        channels={**channels, **new.channels},
        unmarked=tuple(number for number in new.unmarked if number not in numbers),
        changes=there.changes + 1,
    )


def marked_there(made: Manifest, new: Manifest) -> list[str]:
    """Names of the logs that `merged` has added."""
    return [log.name for number, log in made.logs.items() if number not in new.logs]


def proven_manifest(data: bytes, recording: str, proven: Mapping[str, CopiedFile]) -> Manifest:
    """The manifest of a copy, by its bytes.

    Raises:
        StoreError: It is damaged, or of another recording; or a file that it lists is not proven.
    """
    try:
        if len(data) > MAX_BYTES:
            raise ValueError("it is too large")
        found = decode(data)
        if found.id != recording:
            raise ValueError(f"it is the one of {found.id}")
        if found.status in {"open", "unproven", "removed"}:
            raise ValueError(f"its recording is {found.status}")
    except ValueError as error:
        raise StoreError(
            f"The manifest of the recording is damaged, or of another one: {error}."
        ) from error
    for log in found.files:
        sent = proven.get(log.name)
        right = log.digest, log.bytes
        if not log.is_here or sent is None or (sent.digest, sent.bytes) != right:
            raise StoreError(f"{log.name} was not copied, and the manifest lists it.")
    for one in found.fields:
        if proven.get(one.file) != copied_file(one):
            raise StoreError(f"{one.file} was not copied, and the manifest lists it.")
    return found


def digests_of(manifest: Manifest) -> dict[int, str]:
    """Digests of the segments of a recording, by number."""
    return {number: log.digest for number, log in manifest.logs.items()}


def content_of(digests: Mapping[int, str]) -> str:
    """A value that is the same for two copies of a recording with the same segments."""
    return hashlib.sha256(str(sorted(digests.items())).encode()).hexdigest()[:32]


def copied_file(fields: Fields) -> CopiedFile:
    """A file of fields, as it is copied."""
    return CopiedFile(**structs.asdict(fields))


def files_of(inventory: Inventory) -> list[CopiedFile]:
    """The files of a recording, as they are copied."""
    listed = [copied_file(one) for one in inventory.fields.values()]
    for number in inventory.summaries:
        name, size = inventory.listing.sealed[number], inventory.summaries[number].size
        listed.append(CopiedFile(name, size, inventory.digest(number)))
    return sorted(listed, key=lambda file: (not file.is_segment, file.file))


def pieces_of(path: Path, at: int, end: int, piece: int) -> Iterator[bytes]:
    """The bytes of a file, a piece at a time.

    Raises:
        StoreError: It cannot be read.
    """
    try:
        fd = files.open_file(path, os.O_RDONLY | os.O_NONBLOCK)
        try:
            fetched = at
            while at < end:
                if at == fetched:  # of a bucket, more at once than is sent at once
                    fetched = min(at + _FETCHED, end)
                    files.fetch(fd, [(at, fetched)])
                data = os.pread(fd, min(piece, fetched - at), at)
                if not data:
                    break
                at += len(data)
                yield data
        finally:
            os.close(fd)
    except OSError as error:
        raise durability.explain(error, path, "reading") from error
