"""Repairs that lose no data; what is left is found by `verify`."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from msgspec import structs

from hybridlog.columns.recording_logs import RecordingRows
from hybridlog.entries import (
    free_name_in,
    inventory_of,
    made_again,
    put_entry,
    take_inventory,
    unlisted,
)
from hybridlog.follow.follower import bring, make_tables
from hybridlog.index import consent
from hybridlog.maintenance import tables
from hybridlog.maintenance.opening import recover, recover_segments
from hybridlog.maintenance.report import Repaired
from hybridlog.maintenance.verify import AGAIN, Finding
from hybridlog_storage.catalog import file_of
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import (
    HeldError,
    ManifestError,
    SegmentError,
    StoreError,
    TopicError,
    UsageError,
)
from hybridlog_storage.manifest import replace
from hybridlog_storage.mongo.index_state import IndexState
from hybridlog_storage.segments.gone_log import open_log
from hybridlog_storage.segments.recovery import rebuild_summary
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.settings import EMBEDDED, is_uri, read_settings, write_settings

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.maintenance.report import Progress, RepairReport
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import Manifest
    from hybridlog_storage.mongo.database import Database


def repair(
    directory: StoreDirectory,
    catalog: Catalog,
    repairs: RepairReport,
    names: Mapping[str, str] | None,
) -> tuple[list[Repaired], list[Finding]]:
    """Repair files, manifests and the catalog; returns what was repaired, and what was not.

    `repairs` says which recordings cannot be read; `names` are those of recordings by id, None for
    all.
    """
    directory.check_writable()
    done: list[Repaired] = []
    left: list[Finding] = []
    checker = tables.TableChecker(directory)
    all_ids = (*directory.ids(), *directory.manifests.without())
    for recording, name in ({one: one for one in all_ids} if names is None else names).items():
        try:
            with directory.writing(recording, name, wait_s=LOCK_WAIT_S):
                done += _repair_one(directory, repairs, recording)
                entry = put_entry(directory, catalog, recording)
            if entry.status in {"damaged", "open"}:
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
    return done, left


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
            if reader.digest() != log.digest and rebuild_summary(path / log.name, log.digest):
                done.append(Repaired(inventory.name, log.name, "its summary was rebuilt"))
    return done


def _manifest(directory: StoreDirectory, report: RepairReport, recording: str) -> list[Repaired]:
    manifests, manifest = directory.manifests, None
    with suppress(ManifestError):
        manifest = manifests.find(recording)
    if manifest is None:
        recover_segments(directory, recording, directory.listing(recording), None)

        def make(old: Manifest | None) -> Manifest:
            inventory = inventory_of(directory, recording, directory.listing(recording), None)
            made = made_again(inventory, old)
            others = manifests.each(directory.ids())
            return replace(made, name=free_name_in(others, made.name))

        made = manifests.restore(recording, make)
        return [Repaired(made.name, "manifest", "made again")]
    if left := directory.listing(recording).left_over(manifest):
        recover(directory, recording, report)
    done = [Repaired(manifest.name, file, "left over, and removed") for file in left]
    inventory = take_inventory(directory, recording)
    if (adopt := unlisted(inventory)) is None:
        return done
    manifests.change(recording, adopt)
    names = [misfit.file for misfit in inventory.misfits if misfit.is_unlisted]
    return done + [Repaired(inventory.name, file, "listed in the manifest") for file in names]


def repair_index(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database,
    entries: Sequence[RecordingEntry],
    *,
    progress: Progress | None = None,
) -> list[Repaired]:
    """Index those of some recordings that are not completely indexed."""
    known = IndexState(database).of([entry.key for entry in entries])
    done = []
    for entry in entries:
        indexed = known.get(entry.key)
        if entry.status == "open":
            continue
        is_restored = _is_restored(directory, catalog, entry)
        is_whole = indexed is not None and indexed.is_whole(entry) and entry.is_decoded
        if is_whole and not is_restored:
            continue
        with suppress(HeldError, TopicError):
            chunks = bring(
                directory, catalog, entry, database, anew=is_restored, progress=progress
            ).chunks
            how = "damaged chunks are readable again" if is_restored else f"{chunks} chunks indexed"
            done.append(Repaired(entry.name, "index", how))
    return done


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
    changed = structs.replace(settings, store_id=secrets.token_hex(16), mongo=own)
    write_settings(path, changed)
    if is_uri(own):
        consent.trust(changed.store_id, own)
