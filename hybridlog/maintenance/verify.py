"""Compares every byte of a store with its manifests, and catalog and index with both.

Repairs lose no data; what is left is found.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from shlex import quote
from typing import TYPE_CHECKING

from msgspec import Struct, field, structs

from hybridlog.columns import rows_file
from hybridlog.columns.recording_logs import RecordingRows
from hybridlog.entries import (
    free_name_in,
    inventory_of,
    made_again,
    put_entry,
    steady_inventory,
    take_inventory,
    topic_of,
)
from hybridlog.follow.follower import bring, make_tables
from hybridlog.maintenance import tables
from hybridlog.maintenance.opening import recover, recover_segments
from hybridlog.maintenance.report import Repaired, reporter
from hybridlog_storage.catalog import WHOLE, file_of
from hybridlog_storage.disk.directory import LOCK, LOCK_WAIT_S
from hybridlog_storage.errors import (
    HeldError,
    ManifestError,
    SegmentError,
    StoreError,
    TopicError,
    UsageError,
)
from hybridlog_storage.manifest import encode, replace
from hybridlog_storage.mongo.index_documents import IndexState, collection_of
from hybridlog_storage.segments.recovery import damage_of, rebuild_summary
from hybridlog_storage.segments.segment_file import SEALED_SUFFIX, is_rows
from hybridlog_storage.segments.segment_reader import SegmentReader, open_log
from hybridlog_storage.settings import EMBEDDED, is_uri, read_settings, write_settings

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.entries import Inventory
    from hybridlog.maintenance.report import Progress, RepairReport
    from hybridlog.opened import OpenStore
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import Manifest
    from hybridlog_storage.mongo.database import Database

_REPAIR = "run `hybridlog verify --repair`"
AGAIN = f"{_REPAIR} again"
RESTORE = "`hybridlog copy --check` from a store that has it brings it back"
_RESTORE_LOST = f"{RESTORE}; `hybridlog info --losses` lists the lost messages"
_KNOWN = frozenset({LOCK})


class Finding(Struct, frozen=True):
    """A problem found by `verify`.

    Attributes:
        recording: Name of the recording; empty for the store itself.
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
        chunks: Number of chunks that are whole.
        messages: Number of messages in them, and of marks.
        bytes_read: Bytes read from segments and manifests.
        findings: All problems.
        index: True if the index was compared, too; MongoDB may be unavailable.
        without_documents: Messages of topics that were recorded with `--no-index`.
        repaired: What was repaired before.
    """

    recordings: int = 0
    chunks: int = 0
    messages: int = 0
    bytes_read: int = 0
    findings: list[Finding] = field(default_factory=list)
    index: bool = True
    without_documents: int = 0
    repaired: list[Repaired] = field(default_factory=list)


def verify(
    shared: OpenStore,
    names: Mapping[str, str] | None,
    progress: Progress | None = None,
    *,
    repairs: bool = False,
) -> Verification:
    """Check every byte of segments, manifests and tables, and count the documents of the index.

    `names` are those of recordings by id, None for all; `repairs` makes the repairs first, else
    nothing is written. Without MongoDB, only files are checked.
    """
    directory, catalog, left = shared.directory, shared.catalog, list[Finding]()
    result = Verification()
    if repairs:
        left = _repair(shared, names, result.repaired, progress)
        shared.invalidate()
    database = shared.index.reached(brings=repairs)
    result.index = database is not None
    index = None if database is None else _Index(database)
    checker = tables.TableChecker(directory)
    for recording in _all(directory) if names is None else names:
        result.recordings += 1
        try:
            check = _Check(directory, catalog, index, recording, result, checker=checker)
            check.run(progress)
        except ManifestError as error:
            cure = RESTORE if directory.is_remote else _REPAIR
            problem = str(error).removesuffix(f" {directory.manifests.cure}")
            result.findings.append(Finding(recording, "manifest", problem, cure))
        except StoreError as error:
            cure = "restore its files"
            result.findings.append(Finding(recording, "recording", str(error), cure))
    told = {(one.recording, one.place) for one in left}
    left += [one for one in result.findings if (one.recording, one.place) not in told]
    result.findings = left
    return result


def _all(directory: StoreDirectory) -> list[str]:
    return [*directory.ids(), *directory.manifests.without()]


class _Index:
    """Counts the documents of recordings; each collection is read once."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self._counts: dict[str, dict[str, int]] = {}

    def documents_of(self, key: str, names: Collection[str]) -> Counter[str]:
        """Numbers of documents of a recording, by collection; they may have any time."""
        new = sorted(names - self._counts.keys())
        counted = self.database.count_each([(name, {}) for name in new])
        for name, counts in zip(new, counted, strict=True):
            self._counts[name] = {key: count for key, count in counts if isinstance(key, str)}
        return Counter({name: self._counts[name].get(key, 0) for name in names})


class _Check:
    """Checks one recording."""

    def __init__(
        self,
        directory: StoreDirectory,
        catalog: Catalog,
        index: _Index | None,
        recording: str,
        result: Verification,
        *,
        checker: tables.TableChecker,
    ) -> None:
        self._checker = checker
        self._directory = directory
        self._catalog = catalog
        self._indexed = index
        self._recording = self._name = recording
        self._result = result
        self._path = directory.recording(recording)
        self._lost: Counter[str] = Counter()  # messages of chunks that cannot be read
        self._told: set[str] = set()  # logs whose damage is found

    def found(self, place: str, problem: str, cure: str) -> None:
        """Add a problem."""
        if self._directory.is_remote:
            cure = RESTORE
        self._result.findings.append(Finding(self._name, place, problem, cure))

    def run(self, progress: Progress | None) -> None:
        """Check the whole recording; StoreError if it cannot be read at all."""
        holder = self._directory.holder(self._recording)
        self._directory.look_closely(self._recording)
        inventory = steady_inventory(self._directory, self._recording)
        listing, manifest = self._directory.listing(self._recording), inventory.manifest
        is_same = manifest is not None and listing.sizes == inventory.listing.sizes
        left = listing.left_over(manifest) if manifest is not None and is_same else []
        self._name = inventory.name
        self._manifest(manifest)
        self._check_rows(inventory)
        sealed, summaries = inventory.listing.sealed, inventory.summaries
        sizes = {n: s.size for n, s in summaries.items() if not is_rows(sealed[n])}
        total = sum(sizes.values())
        before = 0
        for number, name in sealed.items():
            tell = reporter(progress if total else None, self._name, total, before)
            self._segment(inventory, number, name, tell)
            before += sizes.get(number, 0)
        self._files(inventory, left, is_held=holder is not None)
        if manifest is None:
            return
        known = self._catalog.damage(self._recording)
        lost = {(n, WHOLE): "" for n in inventory.logs.keys() - inventory.summaries.keys()}
        if not lost.keys() <= known.keys():
            self._catalog.put_damage(self._recording, {**lost, **known})
        entry = put_entry(self._directory, self._catalog, self._recording)
        self._result.without_documents += entry.messages - entry.documents
        if entry.status == "open":
            return
        self._index(entry)
        self._tables(entry)

    def _manifest(self, manifest: Manifest | None) -> None:
        if manifest is None:
            self.found("manifest", "it is missing, so other losses are unknown", _REPAIR)
            return
        self._result.bytes_read += len(encode(manifest))
        self._result.messages += len(manifest.marks)
        if manifest.status == "unproven":
            self.found(
                "manifest",
                "it was lost and made again, so a missing segment could not be noticed",
                "compare with a copy, if there is one; nothing else can prove it",
            )

    def _files(self, inventory: Inventory, left: list[str], *, is_held: bool) -> None:
        for place, problem in inventory.problems.items():
            if place not in self._told:
                cure = _REPAIR if place.endswith(SEALED_SUFFIX) else _RESTORE_LOST
                self.found(place, problem, RESTORE if is_rows(place) else cure)
        for number in inventory.unlisted:
            name = inventory.listing.sealed[number]
            self.found(name, "the manifest does not list it", _REPAIR)
        for name in inventory.listing.open.values():
            if not is_held:
                self.found(name, "a crash has left it open", _REPAIR)
        for name in sorted({*inventory.listing.others} - {*left, *_KNOWN}):
            self.found(name, "it is not a file of a recording", "move it out of the store")
        for name in () if is_held else left:
            self.found(name, "it was left over by a command that was stopped", _REPAIR)

    def _check_rows(self, inventory: Inventory) -> None:
        """Check every byte of the files of rows."""
        for file in (file for file in inventory.rows if file.name not in inventory.problems):
            try:
                rows_file.RowsFile(self._path, file).check()
                continue
            except StoreError as error:
                self.found(file.name, str(error).removesuffix(rows_file.RESTORE), RESTORE)
            is_counted = file.number in inventory.summaries
            if is_counted and inventory.manifest and not inventory.logs[file.number].is_here:
                lost = sum(part.messages for part in file.parts.values())
                self._lost[collection_of(topic_of(file, inventory.manifest))] += lost
                self._result.messages -= lost
        here = (file for file in inventory.rows if inventory.listing.has_all([file]))
        self._result.bytes_read += sum(file.bytes for file in here)

    def _segment(
        self, inventory: Inventory, number: int, name: str, tell: Callable[[int], None]
    ) -> None:
        """Compare a segment with its digest; if that differs, find what is lost."""
        summary = inventory.summaries.get(number)
        lost: list[int] = []
        try:
            if not is_rows(name):
                log = inventory.logs.get(number)
                digest = "" if log is None else log.digest
                found, has_summary = damage_of(self._path / name, digest, tell)
                cure = RESTORE if has_summary or found[1:] else _REPAIR
                for at, problem, chunk in found:
                    self._told.add(name)
                    self.found(f"{name} byte {at}", problem, cure)
                    lost += [] if chunk is None else [chunk]
        except SegmentError as error:
            now = self._directory.manifests.find(self._recording)
            if now is None or not now.has_let_go(number):
                self._told.add(name)
                self.found(name, str(error), RESTORE)
            return
        if summary is None:
            return
        for chunk in lost:  # messages that the index may lack
            for part in summary.table.chunk_parts(chunk):
                topic = summary.channels[int(part["channel"])].topic
                self._lost[collection_of(topic)] += int(part["messages"])
                self._result.messages -= int(part["messages"])
        if not is_rows(name):
            self._result.chunks += len(summary.table.chunks) - len(lost)
            self._result.bytes_read += summary.size
        self._result.messages += sum(summary.counts.values())

    def _index(self, entry: RecordingEntry) -> None:
        """Find documents that lack, or are of no message; those still to be made do not count."""
        if self._indexed is None:
            return
        database, key = self._indexed.database, entry.key
        if IndexState(database).of([key]).get(key) != entry.digests:
            return
        expected: Counter[str] = Counter()
        for channel in entry.channels:
            if channel.is_indexed:
                expected[collection_of(channel.topic)] += channel.stats.messages
        have = self._indexed.documents_of(key, expected.keys())
        if +have != +expected:
            # The recording may have ended since all documents were counted.
            have = Counter({name: database.count(name, {"_meta.rec": key}) for name in expected})
        for collection, want in sorted(expected.items()):
            found = have[collection]
            if not want - self._lost[collection] <= found <= want:
                problem = f"{found} index documents, {want} messages in the segments"
                cure = f" -r {quote(self._name)}" if found < want else ""  # others have any time
                self.found(
                    f"collection {collection}", problem, f"run `hybridlog index rebuild{cure}`"
                )

    def _tables(self, entry: RecordingEntry) -> None:
        for topic, problem in self._checker.damage(entry).items():
            self.found(f"table of {topic}", problem, _REPAIR)


def _repair(
    shared: OpenStore,
    names: Mapping[str, str] | None,
    done: list[Repaired],
    progress: Progress | None,
) -> list[Finding]:
    """Repair files, manifests, the catalog, tables and index; returns what was not repaired."""
    directory, catalog, repairs = shared.directory, shared.catalog, shared.repairs
    directory.check_writable()
    database = shared.index.reached(writes=True)
    left: list[Finding] = []
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
            if entry.status == "damaged":
                continue  # tables of lost data are valid again after its restoration
            for topic, why in _tables(directory, catalog, checker, entry).items():
                place = f"table of {topic}"
                if why:
                    left.append(
                        Finding(entry.name, place, f"it cannot be made again: {why}", AGAIN)
                    )
                else:
                    done.append(Repaired(entry.name, place, "made again"))
        except HeldError as error:
            if names is not None or recording in repairs.unreadable:
                left.append(Finding(name, "recording", str(error), AGAIN))
        except (StoreError, TopicError) as error:
            left.append(Finding(name, "recording", str(error), AGAIN))
    return left


def _tables(
    directory: StoreDirectory, catalog: Catalog, checker: tables.TableChecker, entry: RecordingEntry
) -> dict[str, str]:
    """Make missing and damaged tables again; by topic, why that failed, or nothing."""
    damaged = checker.damage(entry)
    wanted = tables.missing(directory, entry, checker.tables).union(damaged)
    if not wanted:
        return {}
    problem = make_tables(directory, catalog, entry, topics=damaged)
    checker.tables.look_again()
    lacking, damaged = tables.missing(directory, entry, checker.tables), checker.damage(entry)
    found = {topic: problem or damaged.get(topic, "") for topic in sorted(wanted)}
    return {one: why for one, why in found.items() if why or one not in lacking}


def _repair_one(directory: StoreDirectory, report: RepairReport, recording: str) -> list[Repaired]:
    done, path = _manifest(directory, report, recording), directory.recording(recording)
    inventory = take_inventory(directory, recording)
    for number, log in inventory.logs.items():
        if inventory.listing.sealed.get(number) != log.name:
            continue
        with suppress(StoreError), SegmentReader(path / log.name, number) as reader:
            # Damage that stays is found by `verify`, which comes next.
            if reader.digest() != log.digest and rebuild_summary(path / log.name):
                done.append(Repaired(inventory.name, log.name, "its summary was rebuilt"))
    return done


def _manifest(directory: StoreDirectory, report: RepairReport, recording: str) -> list[Repaired]:
    manifests, is_lost = directory.manifests, True
    with suppress(ManifestError):
        is_lost = manifests.find(recording) is None
    if not is_lost:
        recover(directory, recording, report)
        return []
    recover_segments(directory, recording, directory.listing(recording), None)

    def make(old: Manifest | None) -> Manifest:
        inventory = inventory_of(directory, recording, directory.listing(recording), None)
        made = made_again(inventory, old)
        others = manifests.each(directory.ids())
        return replace(made, name=free_name_in(others, made.name))

    made = manifests.restore(recording, make)
    return [Repaired(made.name, "manifest", "made again")]


def _is_restored(directory: StoreDirectory, catalog: Catalog, entry: RecordingEntry) -> bool:
    """True if an unreadable chunk is readable again, after its file was restored."""
    for number, chunk in catalog.damage(entry.id):
        path = directory.recording(entry.id) / file_of(entry, number)
        rows = RecordingRows(path.parent)
        with suppress(SegmentError), open_log(path, number, rows) as reader:
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
