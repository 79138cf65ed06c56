"""Copies recordings from a store to a place, with checks; resumes after an interruption.

A file is sent from the byte on that the place has of it; the place then proves the whole file
(`places.py`). The manifest goes last.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from shlex import quote
from typing import TYPE_CHECKING, Final

from hybridlog.entries import take_inventory
from hybridlog.maintenance.opening import clear_stopped
from hybridlog.maintenance.places import (
    Copied,
    CopiedFile,
    RefusedError,
    content_of,
    digests_of,
    files_of,
    has_lost,
    pieces_of,
    segments_of,
)
from hybridlog.wording import counted
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import REMOVED, SENDING, StoreDirectory, gone
from hybridlog_storage.errors import HeldError, StoreError, TopicError, UsageError
from hybridlog_storage.manifest import Manifest, encode, replace
from hybridlog_storage.remote.bucket import digest_like
from hybridlog_storage.segments.segment_format import not_copied_record
from hybridlog_storage.stopping import pause

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from hybridlog.maintenance.places import Place
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.summary import RecordingSummary

_READ: Final = 1 << 20  # bytes read at once
_ASKED_AT_ONCE: Final = 1000  # recordings in a question
_TRIES: Final = 3  # of a recording that expires meanwhile


@dataclass(frozen=True, slots=True)
class CopyOptions:
    """Options of a copy.

    Attributes:
        only_fields: Leave the payloads for later: the copy is like an expired recording.
        then_expire: Delete the payloads here that were proved there; pinned ones stay.
        limit_rate: Bytes a second, at most; None for no limit.
        ssh: The program, with options, that reaches `ssh://` places; None for `ssh`.
        program: hybridlog on the other side.
        piece: Bytes sent at once; what a cut costs.
        check: Read the copies that are there already, too.
    """

    only_fields: bool = False
    then_expire: bool = False
    limit_rate: float | None = None
    ssh: str | None = None
    program: str = "hybridlog"
    piece: int = 256 << 10
    check: bool = False


@dataclass(slots=True)
class CopyReport:
    """The result of `copy`.

    Attributes:
        copied: Names, in the place, of the copied recordings.
        known: Names there of recordings that were there already.
        lacking: Those of them whose payloads were deleted there, and are here.
        refused: Why recordings were not copied, by their names here.
        held: Ids of recordings that another process held, here or there: what is left of them can
            be done later.
        bytes_copied: Bytes copied now, without those that were there after an interruption.
        freed_bytes: Bytes that became free here, because payloads were proved there.
        problems: Why payloads did not expire here, in sentences.
    """

    copied: list[str] = field(default_factory=list)
    known: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    held: list[str] = field(default_factory=list)
    bytes_copied: int = 0
    freed_bytes: int = 0
    problems: list[str] = field(default_factory=list)


def run(
    source: StoreDirectory,
    place: Place,
    chosen: Iterable[RecordingEntry | RecordingSummary],
    options: CopyOptions | None = None,
    *,
    progress: Progress | None = None,
    proved: Callable[[str, Mapping[int, str]], None] = lambda *_: None,
    report: CopyReport | None = None,
) -> CopyReport:
    """Copy recordings of a store to a place.

    Args:
        source: The store to read.
        place: Where they go.
        chosen: Recordings of `source`.
        options: How they are copied.
        progress: Called with the bytes copied and checked, of all that are to be copied.
        proved: Called with the id of each recording that is there with its payloads, and the
            digests of these segments by number; nothing is deleted there meanwhile.
        report: Takes the result, as it grows.

    Raises:
        UsageError: The place is this very store.
        StoreError: The place cannot be written or reached; what was copied stays there.
        DiskFullError: No room; the copy can be run again.
    """
    work = _Copying(source, place, options or CopyOptions(), progress, report or CopyReport())
    return work.run([*chosen], proved)


class _Copying:
    """The steps of a copy."""

    def __init__(
        self,
        source: StoreDirectory,
        place: Place,
        options: CopyOptions,
        progress: Progress | None,
        report: CopyReport,
    ) -> None:
        self._source = source
        self._place = place
        self._options = options
        self._progress = progress
        self._report = report
        self._proven: dict[str, Manifest] = {}  # as it was sent, by the recording's id
        self._done = self._total = 0
        self._due = 0.0  # time from which more may be sent

    def run(
        self,
        chosen: Sequence[RecordingEntry | RecordingSummary],
        proved: Callable[[str, Mapping[int, str]], None],
    ) -> CopyReport:
        if self._is_same():
            raise UsageError(f"{self._place.name} is this very store: there is nothing to copy.")
        there: dict[str, Copied] = {}
        for begin in range(0, len(chosen), _ASKED_AT_ONCE):
            asked = chosen[begin : begin + _ASKED_AT_ONCE]
            there |= self._place.have([one.id for one in asked])
        if self._options.check:
            there = self._checked(there)
        wanted = [one for one in chosen if not self._is_known(one.id, there.get(one.id))]
        self._total = sum(one.stored_bytes for one in wanted)
        missing = {one.id for one in wanted}
        for one in chosen:
            if one.id not in missing:
                self._note_known(one, there[one.id])
        for one in wanted:
            try:
                self._copy(one)
            except RefusedError as error:
                self._report.refused[one.name] = str(error)
                self._total -= one.stored_bytes
            except HeldError as error:
                self._report.refused[one.name] = f"Recording {one.name!r} is not copied: {error}"
                self._report.held.append(one.id)
            except TopicError as error:  # it was removed here meanwhile
                self._place.drop()
                self._report.refused[one.name] = str(error)
                self._total -= one.stored_bytes
            finally:
                self._place.leave()
        try:
            if self._proven:
                self._let_go(proved)
        finally:
            self._place.leave()
        return self._report

    def _let_go(self, proved: Callable[[str, Mapping[int, str]], None]) -> None:
        """Tell which segments have a proven copy, while nothing can be deleted there."""
        name, problems = self._place.name, self._report.problems
        if not self._place.hold([*self._proven]):
            problems.append(f"Payloads stay: another process makes room in {name}. Run it again.")
            self._report.held += self._proven
            return
        there: dict[str, Copied] = {}
        ids = [*self._proven]
        for begin in range(0, len(ids), _ASKED_AT_ONCE):
            there |= self._place.have(ids[begin : begin + _ASKED_AT_ONCE])
        for recording, sent in self._proven.items():
            now, found = there.get(recording), self._place.segments(recording)
            is_whole = now is not None and not (now.lacks_payloads or now.is_damaged)
            here = segments_of(sent)
            if not is_whole or has_lost(found, here):
                problems.append(f"Payloads of {sent.name} stay: its copy in {name} has lost some.")
                continue
            # Where payloads of a topic have expired on both sides, others may be gone there.
            same = [n for n in found.keys() & here.keys() if found[n].holds(here[n])]
            proved(recording, {n: here[n].digest for n in same})

    def _is_same(self) -> bool:
        """True if the place is the source: it sees a file that was made here this moment.

        Paths do not tell, nor does the id of a store, which its backups have, too.
        """
        if self._source.is_remote or not self._source.is_writable:
            return False  # nothing of it can be deleted
        while True:
            # After a crash, the next opening of the store removes it.
            mark = f"{REMOVED}{secrets.token_hex(8)}"
            path = self._source.recording(mark)
            try:
                flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
                os.close(files.open_file(path, flags))
                try:
                    is_seen = self._place.sees(mark)
                finally:
                    is_removed = not self._source.has(mark)
                    files.remove_tree(path)
            except OSError as error:
                if not self._options.then_expire:  # a full disk can be copied from
                    return False
                raise durability.explain(error, path, "copying from") from error
            if is_seen or not is_removed:
                return is_seen

    def _is_known(self, recording: str, there: Copied | None) -> bool:
        """True if the place has all that would be copied."""
        if there is None or self._options.only_fields:
            return there is not None
        if there.is_damaged or not there.lacks_payloads:
            return not there.is_damaged
        here = self._manifest(recording)
        return here is not None and here.lacks_payloads

    def _checked(self, there: Mapping[str, Copied]) -> dict[str, Copied]:
        """Read what is there; where damaged files can be replaced, the place notes them."""
        for recording, known in there.items():
            problems = self._place.problems(recording)
            found = self._place.have([recording]).get(recording)
            if problems and not (found is not None and found.is_damaged):
                self._report.problems.append(
                    f"{known.name} in {self._place.name} is damaged: {'; '.join(problems[:3])}. "
                    f"{self._cure(recording, known.name)}"
                )
        return self._place.have([*there])

    def _cure(self, recording: str, there: str) -> str:
        """Advice about a damaged copy: it is only to be removed if all of it is here."""
        segments = self._place.segments(recording)
        with suppress(StoreError):
            inventory = take_inventory(self._source, recording)
            here = inventory.manifest
            if (
                here is not None
                and inventory.is_proven
                and not inventory.misfits
                and not here.lacks_payloads
                and not has_lost(segments_of(here), segments)
                and segments.keys() <= here.logs.keys()
            ):
                command = f"`hybridlog rm {quote(there)}`"
                return f"Restore it, or remove it there ({command}), and copy again."
        return "Restore it from another copy: not all of it is here."

    def _manifest(self, recording: str) -> Manifest | None:
        """The manifest of a recording here; None if it cannot be read."""
        with suppress(StoreError):
            return self._source.manifests.find(recording)
        return None

    def _note_known(self, one: RecordingEntry | RecordingSummary, known: Copied) -> None:
        here = None if self._source.is_remote else self._manifest(one.id)
        missing = 0 if here is None else self._missing(here, known)
        if missing:
            self._report.refused[one.name] = (
                f"{known.name} in {self._place.name} lacks {counted(missing, 'segment')} of "
                f"recording {one.name!r}: it may have been copied by hand before its end. "
                f"{self._cure(one.id, known.name)}"
            )
            return
        self._report.known.append(known.name)
        if known.is_damaged:
            self._report.problems.append(
                f"{known.name} in {self._place.name} is damaged: `hybridlog copy` without "
                "--only-fields mends it."
            )
        may_lack = known.expired and not known.lacks_payloads
        if may_lack and has_lost(self._place.segments(one.id), segments_of(here)):
            self._report.lacking.append(known.name)
        if here is not None:
            self._check_there(known, here)

    def _check_there(self, known: Copied, here: Manifest) -> None:
        """Read a copy that is there before payloads expire here."""
        if self._options.then_expire:
            problems = self._place.problems(here.id)
            if known.lacks_payloads or has_lost(self._place.segments(here.id), segments_of(here)):
                problems.append("payloads of it have expired there")
            if problems:
                self._report.problems.append(
                    f"Payloads of {known.name} stay: its copy in {self._place.name} is not "
                    f"whole: {'; '.join(problems[:3])}."
                )
            else:
                self._proven[here.id] = here

    def _missing(self, here: Manifest, known: Copied) -> int:
        """Number of segments that its copy does not have, but for marks: they do not follow."""
        listed = digests_of(here)
        if content_of(listed) == known.content:
            return 0
        there, marks = self._place.segments(here.id), {mark.segment for mark in here.marks}
        return len(listed.keys() - marks - there.keys())

    def _copy(self, one: RecordingEntry | RecordingSummary) -> None:
        """Copy a recording.

        Raises:
            RefusedError: It has not ended, or is damaged.
        """
        name = f"Recording {one.name!r} of {self._source.place}"
        if one.status == "open":
            raise RefusedError(f"{name} is being written. Copy it when it has ended.")
        if one.status == "unfinished":
            raise RefusedError(
                f"{name} was cut short by a crash. Open that store once with write permission, "
                "which recovers it, then copy it."
            )
        only_fields, left = self._options.only_fields, _TRIES
        while True:
            sent = None
            if not self._source.has(one.id):
                raise gone(one.name)
            try:
                with self._sent(one.id) as sent:
                    # Fields may take a while to prepare, and a server waits only so long.
                    begun = self._place.begin(one.id, wants_payloads=not only_fields)
                    if begun.known is not None:  # another process has copied it meanwhile
                        self._note_known(one, begun.known)
                        return
                    wanted = [f for f in sent.files if begun.lost is None or f in begun.lost]
                    self._total += sum(file.bytes for file in wanted) - one.stored_bytes
                    for file in wanted:
                        self._bring(sent, file, begun.sizes.get(file.file, 0))
                break
            except StoreError:
                left -= 1
                has_changed = left > 0 and sent is not None and sent.has_changed()
                if self._source.has(one.id) and not has_changed:
                    raise
        there = self._place.publish(encode(sent.manifest))
        self._report.copied.append(there)
        if begun.lost is not None:  # the rest of it was not sent
            self._check_there(self._place.have([one.id])[one.id], sent.manifest)
        elif self._options.then_expire and not only_fields:
            self._proven[one.id] = sent.manifest

    def _bring(self, sent: _Sent, file: CopiedFile, there: int) -> None:
        """Send what a place lacks of a file.

        Raises:
            RefusedError: It is damaged here.
        """
        place, path = self._place, file.below(sent.path)
        damaged = RefusedError(
            f"{path} is damaged: what was copied does not match its checksums. "
            "`hybridlog verify` shows where."
        )
        if place.proves and there == file.bytes and place.prove(file):
            self._total -= file.bytes
            return
        if not (place.proves or file.is_whole(sent.path)):
            raise damaged
        at = 0
        if 0 < there <= file.bytes:
            at = there if self._is_same_there(sent, file, there) else 0
        self._total -= at
        is_there = at == file.bytes
        piece, limit = self._options.piece, self._options.limit_rate
        if limit is not None:  # a server must not take a slow one for a dead one
            piece = max(min(piece, int(limit / 4)), 1)
        for data in sent.pieces(file, at, file.bytes, piece):
            place.append(file, at, data)
            at += len(data)
            self._count(sent.manifest.name, len(data))
        if not place.prove(file):
            raise damaged
        if not (place.proves or is_there or self._is_same_there(sent, file, file.bytes)):
            raise RefusedError(
                f"{file.file} did not arrive in {place.name} as it was sent. Copy again."
            )

    def _is_same_there(self, sent: _Sent, file: CopiedFile, length: int) -> bool:
        """True if the first bytes of a file have the same digest there."""
        digest = self._place.digest(file, length)
        return digest == digest_like(digest, sent.pieces(file, 0, length, _READ))

    def _count(self, name: str, size: int) -> None:
        """Count bytes that were sent, and wait as long as the limit of the rate asks for."""
        self._report.bytes_copied += size
        self._done += size
        if self._progress is not None:
            self._progress(name, self._done, max(self._total, self._done))
        if self._options.limit_rate is not None:
            now = time.monotonic()
            self._due = max(self._due, now) + size / self._options.limit_rate
            pause(max(self._due - now, 0.0))

    @contextmanager
    def _sent(self, recording: str) -> Iterator[_Sent]:
        """The recording as it is sent."""
        if not self._options.only_fields:
            yield _Sent(self._source, recording)
            return
        whole = _Sent(self._source, recording)
        with _with_fields(self._source, whole) as scratch:
            sent = _Sent(scratch, recording)
            if sent.files != whole.files:  # small messages stay whole
                sent.manifest = replace(sent.manifest, lacks_payloads=True)
            yield sent


class _Sent:
    """A recording as it is sent: its files, and its manifest by which they are checked.

    Args:
        directory: Its store.
        recording: Its id.

    Attributes:
        manifest: Its manifest.

    Raises:
        RefusedError: It is incomplete.
    """

    def __init__(self, directory: StoreDirectory, recording: str) -> None:
        self.path = directory.recording(recording)
        self._manifests = directory.manifests
        inventory = take_inventory(directory, recording)
        if inventory.id != recording or inventory.misfits or not inventory.is_proven:
            raise RefusedError(
                f"Recording {inventory.name!r} of {directory.place} is incomplete: `hybridlog "
                f"verify --store {directory.place} {quote(inventory.name)}` shows what is missing. "
                "It was not copied."
            )
        assert inventory.manifest is not None  # it is proven
        self.manifest: Manifest = inventory.manifest
        self.files = files_of(inventory)
        self.segments = [*inventory.summaries]
        self.bytes = sum(file.bytes for file in self.files)

    def pieces(self, file: CopiedFile, at: int, end: int, piece: int) -> Iterator[bytes]:
        """The bytes of a file, a piece at a time.

        Raises:
            RefusedError: It cannot be read.
        """
        try:
            yield from pieces_of(file.below(self.path), at, end, piece)
        except StoreError as error:
            raise RefusedError(str(error)) from error

    def has_changed(self) -> bool:
        """True if files of it were replaced since: the manifest says so."""
        now = self._manifests.find(self.manifest.id)
        return now is not None and (now.files, now.fields) != (
            self.manifest.files,
            self.manifest.fields,
        )


@contextmanager
def _with_fields(source: StoreDirectory, sent: _Sent) -> Iterator[StoreDirectory]:
    """A store, in a hidden folder, with a recording whose payloads are to be copied later.

    Its files are second names of the files of the recording: expiry replaces them by new
    ones, and the recording keeps its own.
    """
    from hybridlog.maintenance.expiry import expire

    with at_work(source) as folder:
        scratch = StoreDirectory.create(folder / "store")
        path = scratch.recording(sent.manifest.id)
        scratch.manifests.create(sent.manifest)
        for file in sent.files:
            target = file.below(path)
            files.make_folders(target.parent)
            files.link(file.below(sent.path), target)
        expire(scratch, sent.manifest.id, sent.segments, record=not_copied_record)
        yield scratch


@contextmanager
def at_work(source: StoreDirectory) -> Iterator[Path]:
    """A hidden folder in the store that is copied, locked until the end of the block.

    Those of copies that were stopped are removed.
    """
    source.check_writable()
    folder, held = source.path / f"{SENDING}{secrets.token_hex(4)}", ExitStack()
    try:
        clear_stopped(source)
        while folder.name not in files.names(source.path):
            held.close()
            files.make_folder(folder)
            with suppress(FileNotFoundError):  # another process has just opened the store
                held.enter_context(files.locked_folder(folder))
        yield folder
    except OSError as error:
        raise durability.explain(error, folder, "copying from") from error
    finally:
        with held, suppress(OSError):
            files.remove_tree(folder)
