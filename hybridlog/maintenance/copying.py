"""Copies recordings of a store to another one: which, by what names, and what comes of it.

What a copy is, and what it proves, is in `hybridlog_storage.copy`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.wording import counted
from hybridlog_storage import copy
from hybridlog_storage.copy_places import Directory, RefusedError
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import gone
from hybridlog_storage.errors import (
    DiskFullError,
    HeldError,
    ManifestError,
    RecordingGoneError,
    StoreError,
    UsageError,
)
from hybridlog_storage.manifests import RECORDINGS

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.copy_places import Place, Source
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import File, Manifest
    from hybridlog_storage.summary import RecordingSummary


@dataclass(frozen=True, slots=True)
class CopyOptions:
    """Options of a copy.

    Attributes:
        only_fields: Leave the payloads for later: the copy is like an expired recording.
        then_expire: Delete the payloads here that were proved there; pinned ones stay.
        limit_rate: Bytes a second, at most; None for no limit.
        ssh: The program, with options, that reaches `ssh://` places; None for `ssh`.
        check: Read the copies that are there already, too, and replace what is damaged.
    """

    only_fields: bool = False
    then_expire: bool = False
    limit_rate: float | None = None
    ssh: str | None = None
    check: bool = False


@dataclass(slots=True)
class CopyReport:
    """The result of `copy`.

    Attributes:
        copied: Names, in the place, of the recordings of which something was copied.
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


@dataclass(frozen=True, slots=True)
class Target:
    """The place that recordings are copied to.

    `named` makes a name that no recording there has; `arrived` are the ids of those of which
    something was copied.
    """

    place: Place
    named: Callable[[str], str]
    arrived: list[str] = field(default_factory=list)


@dataclass
class Copying:
    """Copies recordings of a store.

    Args:
        report: Takes the result, as it grows.
        expire: With `then_expire`, called with the id of each recording and the digests of logs
            whose copies were proved just now, by number.
        progress: Called with the bytes copied and checked, of all that are to be copied.
    """

    directory: StoreDirectory
    target: Target
    options: CopyOptions
    report: CopyReport
    expire: Callable[[str, Mapping[int, str]], None]
    progress: Progress | None

    def run(self, chosen: Sequence[RecordingSummary]) -> None:
        """Copy some recordings; after an error what was copied stays, and it can be run again."""
        self._place, self._source = self.target.place, self._source_of(self.directory)
        if self._is_same():
            raise UsageError(f"{self._place.address} is this very store: there is nothing to copy.")
        self._done = 0  # bytes of recordings before, and after this one
        self._left = sum(one.stored_bytes for one in chosen)
        for one in chosen:
            self._left -= one.stored_bytes
            self._copy(one)

    @staticmethod
    def _source_of(directory: StoreDirectory) -> Source:
        if directory.is_remote:
            from hybridlog_storage.remote.store import mount

            return mount(directory.place)
        return Directory(directory.path)

    def _is_same(self) -> bool:
        """True if the place is the source: it sees a file that was made here this moment.

        Paths do not tell, nor does the id of a store, which its backups have, too.
        """
        if not isinstance(self._source, Directory) or not self.directory.is_writable:
            return False  # nothing of it can be deleted
        try:
            with self._source.marked() as mark:
                return self._place.sees(mark)
        except StoreError:
            if self.options.then_expire:
                raise
            return False  # a full disk can be copied from

    def _how(self, one: RecordingSummary) -> copy.How:
        options = self.options

        def progress(done: int, total: int) -> None:
            if self.progress is not None:
                self.progress(one.name, self._done + done, self._done + total + self._left)

        return copy.How(
            self._without_payloads if options.only_fields else None,
            options.check,
            options.limit_rate,
            self.target.named,
            progress,
            partial(self._let_go, one) if options.then_expire else None,
        )

    @contextmanager
    def _without_payloads(self, now: Manifest, logs: list[File]) -> Iterator[copy.Prepared]:
        """What is sent of a recording whose payloads are to come later, in a folder for a while."""
        from hybridlog.maintenance.expiry import without_payloads

        with tempfile.TemporaryDirectory(prefix="hybridlog-") as place:
            into = Path(place) / RECORDINGS / now.id
            files.make_folders(into)
            path, numbers = self.directory.recording(now.id), [log.number for log in logs]
            try:
                made = without_payloads(path, now, numbers, into, self.directory.address)
            except DiskFullError:
                raise
            except StoreError as error:  # it is damaged, or has changed meanwhile
                raise RefusedError(str(error)) from error
            yield made, Directory(Path(place))

    def _copy(self, one: RecordingSummary) -> None:
        report, name = self.report, f"Recording {one.name!r} of {self.directory.place}"
        try:
            if one.status == "open":
                raise RefusedError(f"{name} is being written. Copy it when it has ended.")
            if one.status == "unfinished":
                raise RefusedError(
                    f"{name} was cut short by a crash. Open that store once with write "
                    "permission, which recovers it, then copy it."
                )
            self._note(one, copy.copy(self._source, self._place, one.id, self._how(one)))
        except (RefusedError, ManifestError) as error:
            report.refused[one.name] = str(error)
        except HeldError as error:
            report.refused[one.name] = f"{name} is not copied: {error}"
            report.held.append(one.id)
        except RecordingGoneError:  # it was removed here, or there, meanwhile
            report.refused[one.name] = str(gone(one.name))

    def _note(self, one: RecordingSummary, copied: copy.Copied) -> None:
        report, name = self.report, copied.manifest.name
        self._done += copied.bytes
        report.bytes_copied += copied.sent_bytes
        if copied.lost:
            report.refused[one.name] = (
                f"{name} in {self._place.address} has lost {', '.join(sorted(copied.lost))}, "
                "which this store does not have either. All else of it stays as it is. Another "
                "store may have them."
            )
        if copied.sent or copied.is_new:
            self.target.arrived.append(one.id)
            report.copied.append(name)
        elif not copied.lost:
            report.known.append(name)
            if copied.lacking:
                report.lacking.append(name)

    def _let_go(self, one: RecordingSummary, digests: Mapping[int, str]) -> None:
        """Let payloads expire here whose copies were proved there just now."""
        logs = self._source.manifests.read(one.id).logs
        left = len({n for n, log in logs.items() if log.is_here} - digests.keys())
        if left:
            self.report.problems.append(
                f"Payloads of {counted(left, 'segment')} of {one.name} stay: their copies in "
                f"{self._place.address} have lost some."
            )
        if digests:
            self.expire(one.id, digests)
