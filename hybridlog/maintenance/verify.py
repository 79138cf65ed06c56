"""Compares every byte of a store with its manifests; repairs what loses no data."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from msgspec import Struct, field, structs

from hybridlog.columns.recording_logs import RecordingRows
from hybridlog.columns.rows_file import RowsFile
from hybridlog.entries import free_name_in, made_again, put_entry
from hybridlog.follow.follower import bring, make_tables
from hybridlog.maintenance import tables
from hybridlog.maintenance.opening import recover, recover_segments
from hybridlog.maintenance.report import Repaired, reporter
from hybridlog_storage.catalog import WHOLE, file_of
from hybridlog_storage.disk.directory import LOCK, LOCK_WAIT_S
from hybridlog_storage.errors import (
    HeldError,
    ManifestError,
    RecordingGoneError,
    SegmentError,
    StoreError,
    TopicError,
    UsageError,
)
from hybridlog_storage.manifest import encode, replace
from hybridlog_storage.manifests import DiskManifests
from hybridlog_storage.segments.recovery import damage_of, rebuild_summary
from hybridlog_storage.segments.segment_reader import SegmentReader, open_log
from hybridlog_storage.settings import EMBEDDED, is_uri, read_settings, write_settings

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.maintenance.report import Progress, RepairReport
    from hybridlog.opened import OpenStore
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import Listing, StoreDirectory
    from hybridlog_storage.manifest import File, Manifest

_REPAIR = "run `hybridlog verify --repair`"
AGAIN = f"{_REPAIR} again"
RESTORE = "`hybridlog copy --check` from a store that has it brings it back"
_RESTORE_LOST = f"{RESTORE}; `hybridlog info --losses` lists the lost messages"
_MOVE = "move it out of the store"


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
    if repairs:
        left = _repair(shared, names, result.repaired, progress)
        shared.invalidate()
    checker = tables.TableChecker(directory)
    for recording in _all(directory) if names is None else names:
        result.recordings += 1
        check = _Check(directory, shared.catalog, recording, result, checker)
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


def _all(directory: StoreDirectory) -> list[str]:
    return [*directory.ids(), *directory.manifests.without()]


class _Check:
    """Checks one recording."""

    def __init__(
        self,
        directory: StoreDirectory,
        catalog: Catalog,
        recording: str,
        result: Verification,
        checker: tables.TableChecker,
    ) -> None:
        self._directory, self._catalog, self._checker = directory, catalog, checker
        self._recording = self._name = recording
        self._result = result
        self._path = directory.recording(recording)
        self._lost: dict[tuple[int, int], str] = {}  # logs that cannot be read, as in the catalog

    def found(self, place: str, problem: str, cure: str = _REPAIR) -> None:
        """Add a problem."""
        cure = RESTORE if self._directory.is_remote else cure
        self._result.findings.append(Finding(self._name, place, problem, cure))

    def run(self, progress: Progress | None) -> None:
        """Check the whole recording; StoreError if it cannot be read at all."""
        directory, recording = self._directory, self._recording
        is_held = directory.holder(recording) is not None
        directory.look_closely(recording)
        manifest, listing = directory.manifests.find(recording), directory.listing(recording)
        if manifest is None:
            self.found("manifest", "it is missing, so losses are unknown")
            return
        self._name = manifest.name
        self._result.bytes_read += len(encode(manifest))
        if manifest.status == "unproven":
            self.found(
                "manifest",
                "it was lost and made again, so a missing segment could not be noticed",
                "compare with a copy, if there is one; nothing else can prove it",
            )
        files, done = manifest.present.values(), 0
        total = sum(file.bytes for file in files)
        for file in files:
            tell = reporter(progress, self._name, total, done)
            self._file(file, listing, tell)
            done += file.bytes
        if not is_held and directory.holder(recording) is None:
            self._others(listing, manifest)
        known = self._catalog.damage(recording)
        if not self._lost.keys() <= known.keys():
            self._catalog.put_damage(recording, {**self._lost, **known})
        entry = put_entry(directory, self._catalog, recording)
        self._result.messages += entry.messages + len(entry.manifest.marks)
        if entry.status != "open":
            for topic, problem in self._checker.damage(entry).items():
                self.found(f"table of {topic}", problem)

    def _file(self, file: File, listing: Listing, tell: Callable[[int], None]) -> None:
        """Compare a file with its digest; of a log that differs, find what is lost."""
        damage = [*self._damage(file, listing, tell)]
        if damage:
            directory, now = self._directory, self._directory.manifests.find(self._recording)
            if now is None or file not in now.present.values():
                return  # it was let go, or replaced, meanwhile
            if file.kind == "log" and file.number in directory.listing(self._recording).open:
                return  # it is about to get its name
            for found in damage:
                self.found(*found)
        else:
            self._result.chunks += file.chunks
        self._result.bytes_read += max(listing.sizes.get(file.name, 0), 0)

    def _damage(
        self, file: File, listing: Listing, tell: Callable[[int], None]
    ) -> Iterator[tuple[str, str, str]]:
        """Place, problem and cure of what is damaged in a file."""
        path = self._path / file.name
        if file.name not in listing.sizes:
            yield file.name, "it is missing", RESTORE if file.kind == "rows" else _RESTORE_LOST
        elif file.kind == "rows":
            try:
                RowsFile(self._path, file).check()
            except StoreError as error:
                yield file.name, str(error), RESTORE
        else:
            try:
                found, has_summary = damage_of(path, file.digest, tell)
            except SegmentError as error:
                found, has_summary = [], True
                yield file.name, str(error), RESTORE
            if not has_summary or (found and not found[0].offset):  # or it is another one
                self._lost[file.number, WHOLE] = ""
            cure = RESTORE if has_summary or found[1:] else _REPAIR
            for at, problem, _ in found:
                yield f"{file.name} byte {at}", problem, cure

    def _others(self, listing: Listing, manifest: Manifest) -> None:
        """Find files that the manifest does not list."""
        left, listing = listing.left_over(manifest), listing.choosing(manifest)
        for name in left:
            self.found(name, "it was left over by a command that was stopped")
        for name in listing.open.values():
            self.found(name, "a crash has left it open")
        for number, name in listing.sealed.items():
            if number not in manifest.logs and name not in left:
                self.found(name, "the manifest does not list it", f"{_REPAIR}, or {_MOVE}")
        for name in sorted({*listing.others} - {*left, LOCK}):
            self.found(name, "it is not a file of a recording", _MOVE)


def _repair(
    shared: OpenStore,
    names: Mapping[str, str] | None,
    done: list[Repaired],
    progress: Progress | None,
) -> list[Finding]:
    """Repair files, manifests, the catalog, tables and index; returns what was not repaired."""
    directory, catalog, repairs = shared.directory, shared.catalog, shared.repairs
    directory.check_writable()
    database, left = shared.index.reached(writes=True), list[Finding]()
    checker = tables.TableChecker(directory)
    chosen = {one: one for one in _all(directory)} if names is None else names
    for recording, name in chosen.items():
        try:
            with directory.writing(recording, name, wait_s=LOCK_WAIT_S):
                done += _repair_one(directory, repairs, recording)
                entry = put_entry(directory, catalog, recording)
            if entry.status == "open":
                continue
            if database is not None and _is_restored(directory, catalog, entry):
                bring(directory, catalog, entry, database, anew=True, progress=progress)
                done.append(Repaired(entry.name, "index", "damaged chunks are readable again"))
                entry = put_entry(directory, catalog, recording)
            if entry.status != "damaged":  # tables of lost data are valid once it is restored
                made, failed = _make_tables(directory, catalog, checker, entry)
                done += made
                left += failed
        except RecordingGoneError:
            continue  # its removal was finished
        except HeldError as error:
            if names is not None or recording in repairs.unreadable:
                left.append(Finding(name, "recording", str(error), AGAIN))
        except (StoreError, TopicError) as error:
            left.append(Finding(name, "recording", str(error), AGAIN))
    return left


def _make_tables(
    directory: StoreDirectory, catalog: Catalog, checker: tables.TableChecker, entry: RecordingEntry
) -> tuple[list[Repaired], list[Finding]]:
    """Make missing and damaged tables again; returns which, and which cannot be made."""
    damaged = checker.damage(entry)
    wanted = tables.missing(directory, entry, checker.tables).union(damaged)
    if not wanted:
        return [], []
    problem = make_tables(directory, catalog, entry, topics=damaged)
    checker.tables.look_again()
    damaged = checker.damage(entry)
    left = tables.missing(directory, entry, checker.tables).union(damaged)
    places = {one: f"table of {one}" for one in sorted(wanted)}
    done = [Repaired(entry.name, places[one], "made again") for one in places if one not in left]
    return done, [
        Finding(entry.name, places[one], f"it cannot be made again: {why}", AGAIN)
        for one in places
        if (why := problem or damaged.get(one))
    ]


def _repair_one(directory: StoreDirectory, report: RepairReport, recording: str) -> list[Repaired]:
    done, path = _manifest(directory, report, recording), directory.recording(recording)
    manifest = directory.manifests.read(recording)
    for number, log in manifest.logs.items():
        if log.is_here:
            with suppress(StoreError), SegmentReader(path / log.name, number) as reader:
                # Damage that stays is found by `verify`, which comes next.
                if reader.digest() != log.digest and rebuild_summary(path / log.name):
                    done.append(Repaired(manifest.name, log.name, "its summary was rebuilt"))
    return done


def _manifest(directory: StoreDirectory, report: RepairReport, recording: str) -> list[Repaired]:
    manifests, is_lost = DiskManifests(directory.path), True
    with suppress(ManifestError):
        is_lost = manifests.find(recording) is None
    if not is_lost:
        recover(directory, recording, report)
        return []
    recover_segments(directory, recording, directory.listing(recording), None)

    def make(old: Manifest | None) -> Manifest:
        made = made_again(directory, recording, directory.listing(recording), old)
        others = manifests.each(directory.ids())
        return replace(made, name=free_name_in(others, made.name))

    made = manifests.restore(recording, make)
    return [Repaired(made.name, "manifest", "made again")]


def _is_restored(directory: StoreDirectory, catalog: Catalog, entry: RecordingEntry) -> bool:
    """True if an unreadable chunk is readable again, after its file was restored."""
    for number, chunk in catalog.damage(entry.id):
        path = directory.recording(entry.id) / file_of(entry, number)
        with suppress(SegmentError), open_log(path, number, RecordingRows(path.parent)) as reader:
            reader.read_chunk(reader.summary().chunks[chunk])
            return True
    return False


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
