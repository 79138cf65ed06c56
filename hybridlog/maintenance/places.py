"""Places that recordings are copied to: what one can do, and a store's directory as one.

A place believes nothing that it is told. It takes bytes, and says itself whether a file is
whole: a segment or a file of columns has a digest in the journal, of its own list of checksums
of all of its bytes. A recording gets its name when every file that its journal names is whole.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

from hybridlog.entries import take_inventory
from hybridlog_storage import journal
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import (
    IMPORTING,
    LOCK,
    LOCK_WAIT_S,
    PAYLOADS,
    REMOVED,
    payload_names,
)
from hybridlog_storage.errors import HeldError, StoreError, TopicError, unreadable
from hybridlog_storage.journal import JOURNAL, JournalState
from hybridlog_storage.remote.bucket import digest_like
from hybridlog_storage.segments.segment_check import SegmentCheck
from hybridlog_storage.segments.segment_file import sealed_name
from hybridlog_storage.settings import EXPIRED

if TYPE_CHECKING:
    from collections.abc import Callable

    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.messages import Buffer

_SEGMENT: Final = re.compile(r"[0-9]{6,9}\.mcap")
_ID: Final = re.compile(r"[0-9a-f]{32}")
_MARK: Final = re.compile(rf"{re.escape(REMOVED)}[0-9a-f]{{16}}")
_PIECE: Final = 1 << 20
_FETCHED: Final = 8 << 20  # bytes that a bucket is asked for
_EDITS: Final = frozenset(
    {
        journal.TAGGED,
        journal.UNTAGGED,
        journal.NOTED,
        journal.PINNED,
        journal.UNPINNED,
        journal.SEALED,
        journal.MARKED,
        journal.UNMARKED,
    }
)
"""Events that users add to a recording that has ended; `sealed` is of the segment of a mark."""


class RefusedError(StoreError):
    """A recording that is not copied; others are."""


@dataclass(frozen=True, slots=True)
class CopiedFile(journal.PayloadFile):
    """A file of fields; or a segment, whose `file` is its name."""

    topic: str = ""
    messages: int = 0

    @classmethod
    def of(cls, value: Mapping[str, Any]) -> CopiedFile:
        """A file from elsewhere.

        Raises:
            KeyError, TypeError, ValueError: It is malformed.
        """
        name = value["file"]
        is_segment = isinstance(name, str) and _SEGMENT.fullmatch(name)
        # Another valid name in its place: the journal has the rules for all other values.
        file = f"segment/{name}" if is_segment else name
        (found,) = journal.payload_files([{**value, "file": file}])
        return cls(**{**asdict(found), "file": name})

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
            with SegmentCheck(recording / self.file) as check:
                found = check.summary
                if found is None or (found.digest, found.size) != (self.digest, self.bytes):
                    return False
                return not any(True for _ in check.problems())
        except StoreError:
            return False


@dataclass(frozen=True, slots=True)
class Copied:
    """A recording that a place has.

    Attributes:
        label: Its label there.
        lacks_payloads: Whether only its fields were copied: the next copy completes it.
        is_damaged: Whether objects of it were lost: the next copy brings them back.
        expired: Number of expired topics there, summed over its segments.
        content: As of `content_of`.
    """

    label: str
    lacks_payloads: bool = False
    expired: int = 0
    content: str = ""
    is_damaged: bool = False


class CopiedSegment(NamedTuple):
    """A segment of a recording that a place has.

    Attributes:
        digest: Its digest as it was sealed.
        now: That of its file, if payloads of it have expired; else empty.
        expired: Topics whose payloads have.
    """

    digest: str
    now: str = ""
    expired: tuple[str, ...] = ()

    def holds(self, other: CopiedSegment) -> bool:
        """True if it surely has all that another copy of the segment has."""
        return self.digest == other.digest and self.now in {"", other.now}


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

    def publish(self, label: str, lines: bytes, *, lacks_payloads: bool) -> str:
        """Give the recording its name, when all files that its journal names are proven.

        Args:
            label: The label it should have.
            lines: Its journal.
            lacks_payloads: Whether payloads are to be copied later.

        Returns:
            The label it has.
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
        known: Returns labels of its recordings by id, as far as they are known.

    Attributes:
        published: Ids of the recordings that were copied.

    Raises:
        StoreError: It cannot be written.
    """

    proves = True

    def __init__(self, directory: StoreDirectory, known: Callable[[], Mapping[str, str]]) -> None:
        directory.check_writable()
        self.name = str(directory.path)
        self.published: list[str] = []
        self._directory = directory
        self._known = known
        self._ids: dict[str, str] = {}  # by label, as read
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
        found = self._labels(recordings).items()
        return {recording: copied_of(self._directory, label) for recording, label in found}

    def _labels(self, recordings: Sequence[str]) -> dict[str, str]:
        """Labels of those of some recordings that are here, by id."""
        for _ in range(2):
            known = {label: recording for recording, label in self._known().items()} | self._ids
            self._ids = {}
            for label in self._directory.labels():
                with suppress(StoreError):
                    self._ids[label] = known.get(label) or self._directory.id_of(label)
            labels = {recording: label for label, recording in self._ids.items()}
            found = {one: labels[one] for one in recordings if one in labels}
            if all(self._directory.has_label(label, one) for one, label in found.items()):
                break
            self._ids, self._known = {}, dict  # other recordings have got their labels
        return found

    def segments(self, recording: str) -> dict[int, CopiedSegment]:
        """As of `Place`."""
        label = self._labels([recording]).get(recording)
        return {} if label is None else segments_of(journal.read(self._directory.recording(label)))

    def begin(self, recording: str, *, wants_payloads: bool, wait_s: float = LOCK_WAIT_S) -> Begun:
        """As of `Place`.

        Args:
            recording: Its id.
            wants_payloads: Whether one that lacks payloads is to be completed.
            wait_s: Seconds to wait for another process that copies it here.
        """
        from hybridlog.maintenance.opening import clear_away

        self.leave()
        if not _ID.fullmatch(recording):
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
                pass  # another process has given it its label
            except HeldError as error:
                raise HeldError(
                    f"another process copies it into {self.name} at this moment.",
                    is_recording=False,
                ) from error
        known = self.have([recording]).get(recording)
        if known is not None and not (known.lacks_payloads and wants_payloads):
            self._directory.sweep(hidden)
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

    def publish(self, label: str, lines: bytes, *, lacks_payloads: bool) -> str:
        """As of `Place`."""
        path, state = self._path, journal.parse(lines)
        check_proven(state, self._recording, self._proven)
        self._clear(state)
        if state.payloads:
            self._directory.require(EXPIRED)
        added = [adopted_line(self._directory, state, lacks_payloads=lacks_payloads)]
        with ExitStack() as held:
            before = self.have([self._recording]).get(self._recording)
            if before is not None:
                writing = self._directory.writing(before.label, self._recording, wait_s=LOCK_WAIT_S)
                label = held.enter_context(writing)
                added += self._edits(label, state)
            content = lines + b"".join(map(journal.encode, added))
            durability.write_new(path / JOURNAL, content)
            inventory = take_inventory(self._directory, path.name)
            if inventory.misfits or not inventory.is_proven:
                files.unlink(path / JOURNAL)
                raise StoreError(f"What was copied of recording {label!r} does not fit together.")
            with self._directory.alone():
                label = self._name(label, is_there=before is not None)
        self.published.append(self._recording)
        self.leave()
        return label

    def _clear(self, state: JournalState) -> None:
        """Remove what an interrupted copy has left, and force the names of files to the disk."""
        path = self._path
        keep = {LOCK, PAYLOADS, *map(sealed_name, state.sealed)}
        try:
            for name in files.names(path).keys() - keep:
                files.remove_tree(path / name)
            for name in payload_names(path).keys() - state.payloads.keys():
                files.remove_tree(path / PAYLOADS / name)
            folders = {(path / PAYLOADS / name).parent for name in state.payloads}
            for folder in folders:
                files.sync_folder(folder)
            if folders:
                files.sync_folder(path / PAYLOADS)
            files.sync_folder(path)
        except OSError as error:
            raise durability.explain(error, path, "copying into") from error

    def _edits(self, label: str, state: JournalState) -> list[journal.Event]:
        """Lines that users added to a copy without payloads; segments of marks get a name here."""
        old = self._directory.recording(label)
        data = files.read_file(old / JOURNAL, journal.MAX_JOURNAL)
        found, marks = edits_of(data, state, self.name)
        for name in marks:
            with suppress(FileExistsError):
                files.link(old / name, self._path / name)
        files.sync_folder(self._path)
        return found

    def _name(self, label: str, *, is_there: bool) -> str:
        """Give the recording its label; the copy that lacked payloads goes.

        After a crash in between there are two copies: the whole one answers, and the store names
        the other one.
        """
        free = self._directory.free_label(label)
        self._directory.move(self._path.name, free)
        if not is_there:
            return free
        hidden = self._directory.hide(label)
        self._directory.move(free, label)
        self._directory.sweep(hidden)
        return label

    def hold(self, recordings: Sequence[str]) -> bool:
        """As of `Place`."""
        return self._held.enter_context(self._directory.retaining())

    def drop(self) -> None:
        """As of `Place`."""
        if self._recording:
            self._close()
            self._directory.sweep(self._path.name)

    def leave(self) -> None:
        """As of `Place`."""
        self._close()
        self._held.close()
        self._recording = ""
        self._proven.clear()

    def problems(self, recording: str) -> list[str]:
        """As of `Place`."""
        return problems_of(self._directory, self._labels([recording]).get(recording))


def problems_of(
    directory: StoreDirectory,
    label: str | None,
    is_whole: Callable[[CopiedFile], bool] | None = None,
) -> list[str]:
    """Read a whole recording, and say what is wrong with it.

    Args:
        directory: Its store.
        label: Its label; None if it is gone.
        is_whole: Reads a file of it; None to read it where it is.
    """
    if label is None:
        return ["it is gone"]
    inventory = take_inventory(directory, label)
    found = [misfit.reason for misfit in inventory.misfits]
    if not inventory.is_proven:
        found.append("it is incomplete")
    path = directory.recording(label)
    is_whole = is_whole or (lambda file: file.is_whole(path))
    return found + [f"{f.file} is damaged" for f in files_of(inventory) if not is_whole(f)]


def segments_of(state: JournalState | None) -> dict[int, CopiedSegment]:
    """As of `Place`, by the journal of a recording."""
    state = state or JournalState()
    now = {number: state.thinned[number][-1][0] for number in state.expired}
    return {
        n: CopiedSegment(one.digest, now.get(n, ""), tuple(state.expired.get(n, ())))
        for n, one in state.sealed.items()
    }


def has_lost(one: Mapping[int, CopiedSegment], other: Mapping[int, CopiedSegment]) -> bool:
    """True if payloads expired in one copy that another one still has; both as of `segments`."""
    left = {number: {*segment.expired} for number, segment in other.items()}
    return any({*segment.expired} - left.get(n, set()) for n, segment in one.items())


def copied_of(directory: StoreDirectory, label: str) -> Copied:
    """A recording of a store, by its journal."""
    state = journal.read(directory.recording(label)) or JournalState()
    digests = {number: sealed.digest for number, sealed in state.sealed.items()}
    return Copied(label, state.lacks_payloads, expired_in(state), content_of(digests))


def edits_of(data: bytes, state: JournalState, place: str) -> tuple[list[journal.Event], list[str]]:
    """Lines that users added to a copy, and the files of the marks that they set there.

    Raises:
        RefusedError: A mark that was set here has the number of one there.
    """
    lines = [line for _, line in journal.read_lines(data) if line is not None]
    adopted = [n for n, line in enumerate(lines, 1) if line["event"] == journal.ADOPTED]
    found: list[journal.Event] = []
    for line in lines[max(adopted, default=0) :]:
        if line["event"] == journal.RENAMED:
            found.append(journal.event(journal.RENAMED, name=line["name"]))
        elif line["event"] in _EDITS:
            found.append(line)
    now = journal.parse(data)
    marked = {line["segment"] for line in found if line["event"] == journal.SEALED}
    gone = marked & now.unmarked  # set and removed there: the number may be another mark's here
    marks = marked - gone
    if marks & state.sealed.keys() or marks - now.sealed.keys():
        raise RefusedError(
            f"Recording {state.name!r} was marked here and in {place}, where its payloads or "
            "its journal have to be completed first: note the mark there, `hybridlog mark "
            "--remove` it, copy again, and set it again."
        )
    left = [line for line in found if line.get("segment") not in gone]
    return left, [sealed_name(number) for number in sorted(marks)]


def adopted_line(
    directory: StoreDirectory, state: JournalState, *, lacks_payloads: bool
) -> journal.Event:
    """The last line of the journal of a copy."""
    lacks = {"lacks": "payloads"} if lacks_payloads or state.lacks_payloads else {}
    return journal.event(journal.ADOPTED, store=directory.settings.store_id, **lacks)


def check_proven(state: JournalState, recording: str, proven: Mapping[str, CopiedFile]) -> None:
    """Raise unless every file that a journal names is proven.

    Raises:
        StoreError: One is not, or it is another recording's journal.
    """
    if state.id != recording or not state.is_proof or state.torn:
        raise StoreError("The journal of the recording is damaged, or of another one.")
    for number, sealed in state.sealed.items():
        found = proven.get(sealed_name(number))
        right = {(sealed.digest, sealed.bytes), *state.thinned.get(number, ())}
        if found is None or (found.digest, found.bytes) not in right:
            raise StoreError(f"{sealed_name(number)} was not copied, and the journal lists it.")
    for name, file in state.payloads.items():
        if proven.get(name) != CopiedFile(**asdict(file)):
            raise StoreError(f"{name} was not copied, and the journal lists it.")


def content_of(digests: Mapping[int, str]) -> str:
    """A value that is the same for two copies of a recording with the same segments."""
    return hashlib.sha256(str(sorted(digests.items())).encode()).hexdigest()[:32]


def expired_in(state: JournalState) -> int:
    """Number of topics with expired messages, summed over the segments of a recording."""
    return sum(map(len, state.expired.values()))


def files_of(inventory: Any) -> list[CopiedFile]:
    """The files of a recording, as they are copied."""
    listed = [CopiedFile(**asdict(file)) for file in inventory.payloads.values()]
    for number in inventory.summaries:
        digest, size = inventory.stored_file(number)
        listed.append(CopiedFile(inventory.listing.sealed[number], size, digest))
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
