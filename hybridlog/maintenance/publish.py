"""Publishes recordings into a store in a bucket.

Files of a recording become objects: segments and payloads first, then fields, the journal last.
Then the catalog's row is made from what is there, as it is read back, and the next list names
it all: only from then on is the recording in the store. What a crash leaves before that is
found there by the next attempt, and not sent again.
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.columns.folders import Addition, TableFolders, files_of
from hybridlog.columns.layout import IN_PAYLOADS, IN_TYPE, SHARED, SUFFIX
from hybridlog.columns.payload_files import open_file
from hybridlog.columns.tables import Tables
from hybridlog.entries import take_inventory
from hybridlog.maintenance.opening import describe_now, open_catalog
from hybridlog_storage import journal
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import PAYLOADS
from hybridlog_storage.errors import ObjectExistsError, StoreError, unreadable
from hybridlog_storage.journal import JOURNAL
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.remote import TRIES
from hybridlog_storage.remote.lists import RECORDINGS, TABLES, ListedRecording
from hybridlog_storage.segments.segment_check import SegmentCheck

if TYPE_CHECKING:
    from hybridlog.entries import Inventory
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.remote.bucket import Object
    from hybridlog_storage.remote.store import RemoteDirectory


def publish(
    source: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    target: RemoteDirectory,
    progress: Progress | None = None,
    *,
    tables: Tables | None = None,
    own: Catalog | None = None,
) -> tuple[str, bool]:
    """Put an ended recording into a store in a bucket, or what it lacks there.

    Args:
        source: The store that has it.
        catalog: Its catalog.
        entry: The recording.
        target: The store in a bucket.
        progress: Called with the bytes that have arrived.
        tables: The fields in the source, if they are known.
        own: The catalog of `target`, if it is open.

    Returns:
        Its label there, and whether anything of it was put there now.

    Raises:
        StoreError: It has not ended, is damaged, or has other content there.
        BucketError: The server does not answer, or refuses.
    """
    if entry.status in {"open", "unfinished"}:
        raise StoreError(f"Recording {entry.label!r} has not ended. Copy it when it has.")
    if own is None:
        target.refresh()
        own = open_catalog(target)
    known = _there(entry, target, own)
    if known is not None and known.is_whole:
        return known.label, False
    listed = _bring(source, entry, target, progress, known or _There())
    fields = _bring_fields(tables or Tables(source.path), entry, target)
    for _ in range(TRIES):
        with suppress(ObjectExistsError), target.changing():
            label, found = target.label_of_id(entry.id), listed.files
            if label and (known is None or target.files_of(label) != known.files):
                # Another process was faster.
                there = target.files_of(label)
                # Of large files the last one to come replaced what the other one had sent.
                newer = {
                    path: one for path, one in found.items() if _replaces(one, there.get(path))
                }
                if not newer:
                    return label, False
                found = {**there, **newer}
            label = label or target.free_label(entry.label)
            target.add_recording(label, ListedRecording(entry.id, found), fields)
            _bring_results(catalog, entry, own)
            described = describe_now(target, own, label)
            if described.entry.status != entry.status or described.entry.id != entry.id:
                raise StoreError(
                    f"What has arrived of recording {entry.label!r} is not what was sent: it is "
                    f"{described.entry.status}. Copy it again."
                )
            own.put(described)
            return label, True
    raise StoreError(f"{target.source.bucket.address} changes all the time. Copy again.")


@dataclass(frozen=True)
class _There:
    """A recording that the other store has.

    Attributes:
        label: Its label there.
        files: The objects of its files, without those that are lost.
        digests: Digest of each of its files, by path, as it was listed.
        is_whole: Whether this store has nothing that it lacks.
    """

    label: str = ""
    files: Mapping[str, Object] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)
    is_whole: bool = False

    def notes(self) -> dict[str, Object]:
        """The lines that were added to its journal there."""
        return {path: o for path, o in self.files.items() if path.startswith(f"{JOURNAL}.")}

    def has(self, path: str, digest: str, size: int) -> bool:
        """True if a file is there already."""
        found = self.files.get(path)
        return found is not None and (self.digests.get(path), found.size) == (digest, size)


def _there(entry: RecordingEntry, target: RemoteDirectory, own: Catalog) -> _There | None:
    """The recording in the other store, by its catalog; None for nothing.

    Raises:
        StoreError: It has other content there.
    """
    label = target.label_of_id(entry.id)
    row = own.recording(entry.id) if label else None
    if row is None:
        return None
    there = row[1]
    listed = target.listing(label)  # compares it with its objects
    gone = _expired(there) - _expired(entry)
    missing = there.digests.items() - entry.digests.items()
    lacking = entry.digests.items() - there.digests.items()
    is_damaged = target.is_damaged(label)
    digests = {**there.digests, **there.stored}
    known = _There(
        label,
        target.files_of(label),
        {listed.sealed.get(int(number), ""): digest for number, digest in digests.items()}
        | {f"{PAYLOADS}/{file['file']}": file["digest"] for file in there.payloads},
        is_whole=not (lacking or gone or is_damaged),
    )
    if not known.is_whole and (missing or _expired(entry) - _expired(there)):
        raise StoreError(
            f"Recording {entry.label!r} has other content in {target.place}: each of the two "
            "lacks what the other one has. Remove one of them, or keep both stores."
        )
    return known


def _expired(entry: RecordingEntry) -> Counter[str]:
    """Number of messages without payload, by topic."""
    found: Counter[str] = Counter()
    for channel in entry.channels:
        if channel.id >= EXPIRED_IDS:
            found[channel.topic] += channel.stats.messages
    return found


def _replaces(one: Object, other: Object | None) -> bool:
    return other is not None and other.name == one.name and other.version != one.version


def _bring(
    source: StoreDirectory,
    entry: RecordingEntry,
    target: RemoteDirectory,
    progress: Progress | None,
    known: _There,
) -> ListedRecording:
    """Create the objects of a recording, each after every byte of its file was checked.

    Those that are there already stay, and what was noted there.
    """
    label = source.label_now(entry.label, entry.id)
    inventory = take_inventory(source, label)
    if inventory.id != entry.id or inventory.misfits or not inventory.is_proven:
        raise StoreError(
            f"Recording {label!r} of {source.place} is incomplete: `hybridlog verify --store "
            f"{source.place} {label}` shows what is missing. It was not copied."
        )
    path, found = source.recording(label), known.notes()
    sizes = [size for _, size in map(inventory.stored_file, inventory.summaries)]
    total = sum(sizes) + sum(file.bytes for file in inventory.payloads.values())
    done = 0

    def is_there(name: str, digest: str, size: int) -> bool:
        nonlocal total
        if not known.has(name, digest, size):
            return False
        found[name] = known.files[name]
        total -= size
        return True

    def bring(name: str, size: int, depth: int) -> None:
        nonlocal done
        found[name] = _sent(path / name, f"{RECORDINGS}/{entry.id}", name, target, depth=depth)
        done += size
        if progress is not None:
            progress(label, done, total)

    for number in inventory.summaries:
        name = inventory.listing.sealed[number]
        digest, size = inventory.stored_file(number)
        if is_there(name, digest, size):
            continue
        with SegmentCheck(path / name) as check:
            about = check.summary
            is_it = about is not None and (about.digest, about.size) == (digest, size)
            if not is_it or any(True for _ in check.problems()):
                raise StoreError(f"{path / name} is damaged: `hybridlog verify` shows where.")
        bring(name, size, files.IN_RECORDING)
    for file in inventory.payloads.values():
        if not is_there(f"{PAYLOADS}/{file.file}", file.digest, file.bytes):
            open_file(path / PAYLOADS, file).check()
            bring(f"{PAYLOADS}/{file.file}", file.bytes, IN_PAYLOADS)
    lines = _journal(path, inventory) + journal.encode(
        journal.event(journal.ADOPTED, store=target.settings.store_id)
    )
    found[JOURNAL] = target.add_file(f"{RECORDINGS}/{entry.id}", JOURNAL, lines)
    return ListedRecording(entry.id, found)


def _journal(path: Path, inventory: Inventory) -> bytes:
    """The lines of the journal by which files were checked."""
    assert inventory.state is not None  # it is proven
    try:
        data = files.read_file(path / JOURNAL, journal.MAX_JOURNAL)
    except OSError as error:
        raise unreadable(error, path / JOURNAL) from error
    return data[: inventory.state.length]


def _sent(path: Path, place: str, name: str, target: RemoteDirectory, *, depth: int) -> Object:
    try:
        fd = files.open_file(path, os.O_RDONLY | os.O_NONBLOCK, depth=depth)
    except OSError as error:
        raise durability.explain(error, path, "reading") from error
    files.fetch(fd, [(0, 1 << 50)])
    with open(fd, "rb") as file:  # noqa: PTH123 - of a handle
        return target.add_file(place, name, file)


def _bring_fields(
    tables: Tables, entry: RecordingEntry, target: RemoteDirectory
) -> Mapping[str, Object]:
    """Create the objects of a recording's fields; each file has no other recording."""
    found: dict[str, Object] = {}
    with tempfile.TemporaryDirectory(prefix="hybridlog-") as place:
        root = Path(place)
        for folder, paths in _fields(tables, entry, root).items():
            for number, path in enumerate(paths):
                name = f"{folder}/{entry.id}-{number}{SUFFIX}"
                found[name] = _sent(path, TABLES, name, target, depth=IN_TYPE)
    return found


def _fields(tables: Tables, entry: RecordingEntry, root: Path) -> Mapping[str, Sequence[Path]]:
    """Files with a recording's fields by folder; of shared ones its rows alone, below `root`."""
    found: dict[str, list[Path]] = {}
    for file, begin, section in tables.sections_of(entry):
        folder = file.path.parent.name
        if not section.segments.items() <= entry.digests.items():
            continue  # they are of what it was before
        if not file.path.name.startswith(SHARED):
            found.setdefault(folder, []).append(file.path)
            continue
        with suppress(StoreError):  # what is damaged is left out: messages answer, too
            rows = file.table().slice(begin, section.rows)
            TableFolders(root, entry.id).add({folder: Addition(rows, section)})
    for reader in files_of(root):
        found.setdefault(reader.path.parent.name, []).append(reader.path)
    return found


def _bring_results(catalog: Catalog, entry: RecordingEntry, own: Catalog) -> None:
    """Tell the other catalog what decoding found out."""
    found = []
    for number, digest in entry.digests.items():
        rows = catalog.decoded_table(entry, int(number))[1]
        if rows is not None:
            found.append((int(number), digest, rows))
    own.put_stamps(entry.id, found)
    own.put_damage(entry.id, catalog.damage(entry.id))
