"""Copies recordings of a store to another one: which, by what names, and what comes of it.

What a copy is, and what it proves, is in `hybridlog_storage.copy`.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.entries import free_name_in
from hybridlog.opened import OpenStore
from hybridlog.snapshot import UNFINISHED
from hybridlog.wording import counted
from hybridlog_storage import copy
from hybridlog_storage.copy import Directory, Place, RefusedError, Source
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import StoreDirectory, gone
from hybridlog_storage.errors import (
    DiskFullError,
    HeldError,
    ManifestError,
    RecordingGoneError,
    StoreError,
    UsageError,
)
from hybridlog_storage.manifest import File, Manifest, free_name
from hybridlog_storage.manifests import MANIFESTS, RECORDINGS
from hybridlog_storage.remote import address_of

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import RecordingSummary

_ELSEWHERE: Final = re.compile(r"[^/:]+:(.*)")
"""A URL, or a place on a server as scp has it."""


@dataclass(frozen=True, slots=True)
class CopyOptions:
    """Options of a copy.

    Attributes:
        only_fields: Leave the payloads for later: the copy is like an expired recording.
        then_expire: Delete the payloads here that were proved there; pinned ones stay.
        limit_rate: Bytes a second, at most; None for no limit.
        ssh: The program, with options, that reaches `ssh://` places; None for `ssh`.
        check: Prove the copies that are there already, too, and replace what is damaged.
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


@dataclass
class Copying:
    """Copies recordings of a store `to` another one.

    Args:
        report: Takes the result, as it grows.
        progress: Called with the bytes copied and checked, of all that are to be copied.
    """

    shared: OpenStore
    to: str | Path
    options: CopyOptions
    report: CopyReport
    progress: Progress | None

    def run(self, chosen: Sequence[RecordingSummary]) -> None:
        """Copy some recordings; after an error what was copied stays, and it can be run again."""
        self._directory = directory = self.shared.directory
        if self.options.only_fields and self.options.then_expire:
            raise UsageError("Payloads that are not copied cannot expire: drop one of the two.")
        if self.options.then_expire:
            directory.check_writable()
        self._source: Source = Directory(directory.path)
        if directory.is_remote:
            from hybridlog_storage.remote.store import mount

            self._source = mount(directory.place)
        self._arrived: list[str] = []  # ids of recordings of which something was copied
        self._done = 0  # bytes of recordings before, and after this one
        self._left = sum(one.stored_bytes for one in chosen)
        with self._opened() as (self._place, self._named):
            if self._is_same():
                raise UsageError(
                    f"{self._place.address} is this very store: there is nothing to copy."
                )
            for one in chosen:
                self._left -= one.stored_bytes
                self._copy(one)

    @contextmanager
    def _opened(self) -> Iterator[tuple[Place, Callable[[str], str]]]:
        """The place to copy to, and what makes a name that no recording there has."""
        if str(self.to).startswith("ssh://"):
            from hybridlog_storage.server import Server

            with Server(str(self.to), self.options.ssh) as server:
                server.begin()
                yield server, lambda name: free_name(name, server.names())
        elif (address := address_of(self.to)) is not None:
            from hybridlog_storage.remote.store import RemoteDirectory

            target = RemoteDirectory.create_in(address)
            yield target.source, _naming(lambda: target.manifests.each(target.ids()))
        else:
            from hybridlog.follow.follower import make_tables

            path = self._local()
            with closing(OpenStore(StoreDirectory.create(path), None, None)) as other:
                other.directory.check_writable()
                other.recover()
                yield Directory(path.absolute()), _naming(lambda: other.newest().summaries)
                other.catch_up()
                for entry in other.now().select(self._arrived):  # so that other readers find them
                    make_tables(other.directory, other.catalog, entry)

    def _local(self) -> Path:
        """The directory to copy to; one that is written like a place elsewhere is refused."""
        to, source = self.to, self._directory
        found = _ELSEWHERE.fullmatch(str(to))
        if found is not None and (found[1].startswith("/") or not os.path.lexists(to)):
            raise UsageError(
                f"{to} is no place to copy to. Write ssh://user@host/path for a server, s3://, "
                "gs:// or az:// for a bucket, and ./ in front of a directory with a colon in its "
                "name."
            )
        try:
            path = Path(to).expanduser()
        except RuntimeError as error:
            raise UsageError(f"{to}: there is no such home directory.") from error
        if not source.is_remote and source.path.resolve() in path.resolve().parents:
            raise UsageError(
                f"{to} lies inside the store {source.path}: copy to another directory."
            )
        return path

    def _is_same(self) -> bool:
        """True if the place is the source: it sees a file that was made here this moment.

        Paths do not tell, nor does the id of a store, which its backups have, too.
        """
        if self._directory.is_remote or not self._directory.is_writable:
            return self._source.address == self._place.address
        try:
            with Directory(self._directory.path).marked() as mark:
                return mark in self._place.sizes(MANIFESTS)
        except StoreError:
            if self.options.then_expire:
                raise
            return False  # a full disk can be copied from

    @contextmanager
    def _without_payloads(self, now: Manifest, logs: list[File]) -> Iterator[copy.Prepared]:
        """What is sent of a recording whose payloads are to come later, in a folder for a while."""
        from hybridlog.maintenance.keep import without_payloads

        with tempfile.TemporaryDirectory(prefix="hybridlog-") as place:
            into = Path(place) / RECORDINGS / now.id
            files.make_folders(into)
            path, numbers = self._directory.recording(now.id), [log.number for log in logs]
            try:
                made = without_payloads(path, now, numbers, into, self._directory.address)
            except DiskFullError:
                raise
            except StoreError as error:  # it is damaged, or has changed meanwhile
                raise RefusedError(str(error)) from error
            yield made, Directory(Path(place))

    def _copy(self, one: RecordingSummary) -> None:
        report, name = self.report, f"Recording {one.name!r} of {self._directory.place}"

        def progress(done: int, total: int) -> None:
            if self.progress is not None:
                self.progress(one.name, self._done + done, self._done + total + self._left)

        options = self.options
        how = copy.How(
            self._without_payloads if options.only_fields else None,
            options.check,
            options.limit_rate,
            self._named,
            progress,
            partial(self._let_go, one) if options.then_expire else None,
        )
        if one.status in UNFINISHED:
            report.refused[one.name] = (
                f"{name} has not ended: copy it when it has. After a crash, `hybridlog verify "
                "--repair` there ends it."
            )
            return
        try:
            self._note(one, copy.copy(self._source, self._place, one.id, how))
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
            self._arrived.append(one.id)
            report.copied.append(name)
        elif not copied.lost:
            report.known.append(name)
            report.lacking += [name] if copied.lacking else []

    def _let_go(self, one: RecordingSummary, proved: Collection[int]) -> None:
        """Let payloads expire here whose copies were proved there just now."""
        from hybridlog.maintenance.edit import remove_if
        from hybridlog.maintenance.keep import Keeper
        from hybridlog.maintenance.retention import Rules

        report, place = self.report, self._place.address
        logs = self._source.manifests.read(one.id).logs
        left = len({n for n, log in logs.items() if log.is_here}.difference(proved))
        if left:
            report.problems.append(
                f"Payloads of {counted(left, 'segment')} of {one.name} stay: their copies in "
                f"{place} have lost some."
            )
        rules = Rules.of(self._directory.settings.retention)
        keeper = Keeper(self._directory, partial(remove_if, self.shared))
        try:
            expired = keeper.expire_all(one.id, proved, rules, place)
        except HeldError as error:
            report.problems.append(f"Payloads stay: {error}")
            report.held.append(one.id)
            return
        finally:
            self.shared.catch_up(one.id)
        report.freed_bytes += expired.freed_bytes
        report.problems += expired.problems


def _naming(others: Callable[[], Iterable[RecordingSummary | Manifest]]) -> Callable[[str], str]:
    return lambda name: free_name_in(others(), name)
