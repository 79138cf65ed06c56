"""Compares every byte of a store with its manifests; repairs what loses no data."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from msgspec import Struct, field, structs

from hybridlog.columns.layout import topics_of
from hybridlog.columns.rows import RowsFile
from hybridlog.entries import free_name_in, made_again, put_entry
from hybridlog.follow.follower import bring, make_tables
from hybridlog.maintenance.opening import missing, recover, recover_segments
from hybridlog.maintenance.report import Progress, Repaired, RepairReport, reporter
from hybridlog_storage.catalog import WHOLE, Catalog, RecordingEntry
from hybridlog_storage.disk.directory import LOCK, LOCK_WAIT_S, Listing, StoreDirectory
from hybridlog_storage.errors import (
    HeldError,
    ManifestError,
    RecordingGoneError,
    SegmentError,
    StoreError,
    TopicError,
    UsageError,
)
from hybridlog_storage.manifest import File, Manifest, encode, replace
from hybridlog_storage.manifests import DiskManifests
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.walk import damage_of, rebuild_summary
from hybridlog_storage.settings import EMBEDDED, is_uri, read_settings, write_settings

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.columns.column_file import ColumnFile
    from hybridlog.opened import OpenStore

_REPAIR = "run `hybridlog verify --repair`"
AGAIN = f"{_REPAIR} again"
RESTORE = "`hybridlog copy --check` from a store that has it brings it back"


class Finding(Struct, frozen=True):
    """A problem found by `verify`.

    Attributes:
        recording: Name of the recording; its id where its manifest is lost.
        place: File and byte, or other subject.
        problem: The problem.
        cure: The cure.
    """

    recording: str
    place: str
    problem: str
    cure: str


class Verification(Struct):
    """The result of `verify`.

    Attributes:
        recordings: Number of recordings read.
        chunks: Number of chunks of whole segments.
        messages: Number of messages and marks, without those of files that cannot be read.
        bytes_read: Bytes of manifests and of the files that they list.
        findings: All problems.
        repaired: What was repaired before.
    """

    recordings: int = 0
    chunks: int = 0
    messages: int = 0
    bytes_read: int = 0
    findings: list[Finding] = field(default_factory=list)
    repaired: list[Repaired] = field(default_factory=list)


def verify(
    shared: OpenStore,
    names: Mapping[str, str] | None,
    progress: Progress | None = None,
    *,
    repairs: bool = False,
) -> Verification:
    """Check every byte of segments, manifests and tables.

    `names` are those of recordings by id, None for all; `repairs` makes the repairs first, else
    nothing is written.
    """
    directory, left, result = shared.directory, list[Finding](), Verification()
    if names is None:
        names = {one: one for one in (*directory.ids(), *directory.manifests.without())}
    if repairs:
        left = _repair(shared, names, result.repaired, progress)
        shared.invalidate()
    tables = TableChecker(directory)
    for recording in names:
        result.recordings += 1
        check = _Check(directory, shared.catalog, tables, result, recording, recording)
        try:
            check.run(progress)
        except ManifestError as error:
            check.found("manifest", str(error).removesuffix(f" {directory.manifests.cure}"))
        except StoreError as error:
            check.found("recording", str(error), "restore its files")
    told = {(one.recording, one.place) for one in left}
    left += [one for one in result.findings if (one.recording, one.place) not in told]
    result.findings = left
    return result


class TableChecker:
    """Checks the tables of recordings; each file once."""

    def __init__(self, directory: StoreDirectory) -> None:
        from hybridlog.columns.tables import Tables

        self.tables = Tables(directory.path)
        self._checked: dict[int, str] = {}

    def damage(self, entry: RecordingEntry) -> dict[str, str]:
        """Problems of the existing tables, by topic. Reads every byte of them."""
        found: dict[str, str] = {}
        self.tables.look_again()
        for topic in sorted(topics_of(entry)):
            table = self.tables.of(entry, topic)
            if table is not None:
                problems = [*filter(None, map(self._problem, table.files))]
            else:  # a missing one is no problem
                damaged = self.tables.damaged(entry, topic)
                problems = [f"The table {path} is damaged." for path in damaged]
            if problems:
                found[topic] = problems[0]
        return found

    def _problem(self, file: ColumnFile) -> str:
        """The damage of a file; empty without any."""
        if file.number not in self._checked:
            self._checked[file.number] = ""
            try:
                file.check()
            except StoreError as error:
                self._checked[file.number] = str(error)
        return self._checked[file.number]


class _Check(Struct):
    """Checks one recording."""

    directory: StoreDirectory
    catalog: Catalog
    tables: TableChecker
    result: Verification
    recording: str
    name: str
    lost: dict[tuple[int, int], str] = field(default_factory=dict)
    """Logs that cannot be read, as in the catalog."""

    def found(self, place: str, problem: str, cure: str = _REPAIR) -> None:
        """Add a problem."""
        cure = RESTORE if self.directory.is_remote else cure
        self.result.findings.append(Finding(self.name, place, problem, cure))

    def run(self, progress: Progress | None) -> None:
        """Check the whole recording; StoreError if it cannot be read at all."""
        directory, recording = self.directory, self.recording
        is_held = directory.holder(recording) is not None
        directory.look_closely(recording)
        manifest, listing = directory.manifests.find(recording), directory.listing(recording)
        if manifest is None:
            self.found("manifest", "it is missing, so losses are unknown")
            return
        self.name = manifest.name
        self.result.bytes_read += len(encode(manifest))
        if manifest.status == "unproven":
            self.found(
                "manifest",
                "it was lost and made again, so a missing segment could not be noticed",
                "compare with a copy, if there is one; nothing else can prove it",
            )
        files, done = manifest.present.values(), 0
        total = sum(file.bytes for file in files)
        for file in files:
            self._file(file, listing, reporter(progress, self.name, total, done))
            done += file.bytes
        if not is_held and directory.holder(recording) is None:
            self._others(listing, manifest)
        known = self.catalog.damage(recording)
        if not self.lost.keys() <= known.keys():
            self.catalog.put_damage(recording, {**self.lost, **known})
        entry = put_entry(directory, self.catalog, recording)
        self.result.messages += entry.messages + len(entry.manifest.marks)
        if entry.status != "open":
            for topic, problem in self.tables.damage(entry).items():
                self.found(f"table of {topic}", problem)

    def _file(self, file: File, listing: Listing, tell: Callable[[int], None]) -> None:
        """Compare a file with its digest; of a log that differs, find what is lost."""
        self.result.bytes_read += max(listing.sizes.get(file.name, 0), 0)
        damage = [*self._damage(file, listing, tell)]
        if not damage:
            self.result.chunks += file.chunks
            return
        now = self.directory.manifests.find(self.recording)
        # It may have been let go, or replaced, meanwhile, or is about to get its name.
        is_listed = now is not None and file in now.present.values()
        if is_listed and file.number not in self.directory.listing(self.recording).open:
            for found in damage:
                self.found(*found)

    def _damage(
        self, file: File, listing: Listing, tell: Callable[[int], None]
    ) -> Iterator[tuple[str, str, str]]:
        """Place, problem and cure of what is damaged in a file."""
        path = self.directory.recording(self.recording)
        if file.name not in listing.sizes:
            lost = "; `hybridlog info --losses` lists the lost messages"
            yield file.name, "it is missing", RESTORE + (lost if file.kind == "log" else "")
            return
        try:
            if file.kind == "rows":
                RowsFile(path, file).check()
                return
            found, has_summary = damage_of(path / file.name, file.digest, tell)
        except StoreError as error:
            found, has_summary = [], file.kind == "rows" or not isinstance(error, SegmentError)
            yield file.name, str(error), RESTORE
        if not has_summary or (found and not found[0][0]):  # or it is another one
            self.lost[file.number, WHOLE] = ""
        cure = RESTORE if has_summary or found[1:] else _REPAIR
        for at, problem in found:
            yield f"{file.name} byte {at}", problem, cure

    def _others(self, listing: Listing, manifest: Manifest) -> None:
        """Find files that the manifest does not list: of a crash, or from elsewhere."""
        for name in listing.open.values():
            self.found(name, "a crash has left it open, and its messages are not recovered yet")
        found = {*listing.sealed.values(), *listing.rows, *listing.others}
        for name in sorted(found - manifest.present.keys() - {LOCK}):
            self.found(
                name, "the manifest does not list it", f"{_REPAIR}, or move it out of the store"
            )


def _repair(
    shared: OpenStore, names: Mapping[str, str], done: list[Repaired], progress: Progress | None
) -> list[Finding]:
    """Repair files, manifests, the catalog, tables and index; returns what was not repaired."""
    directory, catalog, report = shared.directory, shared.catalog, shared.repairs
    directory.check_writable()
    database, left, tables = shared.index.reached(), [], TableChecker(directory)
    for recording, name in names.items():
        try:
            with directory.writing(recording, name, wait_s=LOCK_WAIT_S):
                made, is_restored = _repair_one(directory, catalog, report, recording)
                done += made
                entry = put_entry(directory, catalog, recording)
            if entry.status == "open":
                continue
            if database is not None and is_restored:
                bring(directory, catalog, entry, database, anew=True, progress=progress)
                done.append(Repaired(entry.name, "index", "damaged chunks are readable again"))
                entry = put_entry(directory, catalog, recording)
            if entry.status != "damaged":  # tables of lost data are valid once it is restored
                left += _make_tables(directory, catalog, tables, entry, done)
        except RecordingGoneError:
            continue  # its removal was finished
        except (StoreError, TopicError) as error:
            # What another process holds is no problem unless it was named, or cannot be read.
            if not isinstance(error, HeldError) or name != recording or name in report.unreadable:
                left.append(Finding(name, "recording", str(error), AGAIN))
    return left


def _make_tables(
    directory: StoreDirectory,
    catalog: Catalog,
    tables: TableChecker,
    entry: RecordingEntry,
    done: list[Repaired],
) -> list[Finding]:
    """Make missing and damaged tables again, which are then `done`; returns why not, if not."""
    damaged = tables.damage(entry)
    wanted = sorted(missing(directory, entry).union(damaged))
    problem = make_tables(directory, catalog, entry, topics=damaged) if wanted else ""
    if problem:
        why = f"it cannot be made again: {problem}"
        return [Finding(entry.name, f"table of {topic}", why, AGAIN) for topic in wanted]
    left = missing(directory, entry) if wanted else ()
    made = [topic for topic in wanted if topic not in left]
    done += (Repaired(entry.name, f"table of {topic}", "made again") for topic in made)
    return []


def _repair_one(
    directory: StoreDirectory, catalog: Catalog, report: RepairReport, recording: str
) -> tuple[list[Repaired], bool]:
    """Repair manifest and summaries; tells also whether damaged segments are whole again."""
    done, path = _manifest(directory, report, recording), directory.recording(recording)
    manifest, is_restored = directory.manifests.read(recording), False
    damaged = {number for number, _ in catalog.damage(recording)}
    for number, log in manifest.logs.items():
        if log.is_here:
            with suppress(StoreError), SegmentReader(path / log.name, number) as reader:
                # Damage that stays is found by `verify`, which comes next.
                if reader.digest() == log.digest:
                    is_restored = is_restored or number in damaged
                elif rebuild_summary(path / log.name):
                    done.append(Repaired(manifest.name, log.name, "its summary was rebuilt"))
    return done, is_restored


def _manifest(directory: StoreDirectory, report: RepairReport, recording: str) -> list[Repaired]:
    manifests = DiskManifests(directory.path)
    with suppress(ManifestError):
        if manifests.find(recording) is not None:
            recover(directory, recording, report)
            return []
    recover_segments(directory, recording, directory.listing(recording), None)

    def make(old: Manifest | None) -> Manifest:
        made = made_again(directory, recording, directory.listing(recording), old)
        others = manifests.each(directory.ids())
        return replace(made, name=free_name_in(others, made.name))

    made = manifests.restore(recording, make)
    return [Repaired(made.name, "manifest", "made again")]


def become_another(path: Path, mongo: str | None) -> None:
    """Give a copied store a new id; without `mongo`, it keeps the embedded MongoDB, or none.

    A store that names a MongoDB needs another one, else UsageError.
    """
    settings = read_settings(path)
    if is_uri(settings.mongo) and mongo is None:
        raise UsageError(
            "The copy names the same MongoDB as the store that it was copied from. Give it one "
            "of its own: --mongo mongodb://host/NAME, or --mongo embedded."
        )
    own = None if mongo == EMBEDDED else mongo or settings.mongo
    write_settings(path, structs.replace(settings, store_id=secrets.token_hex(16), mongo=own))
