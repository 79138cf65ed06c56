"""Brings what is derived of recordings up to date: the index, and tables with arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from msgspec import Struct

from hybridlog.columns.layout import topics_of, type_prefix
from hybridlog.follow.follower import bring, make_tables
from hybridlog.maintenance.report import ArraysOfTopic, Progress, RepairReport
from hybridlog.snapshot import Snapshot
from hybridlog_storage.disk.directory import LOCK_WAIT_S, StoreDirectory
from hybridlog_storage.errors import (
    HeldError,
    HybridlogError,
    SegmentError,
    TopicError,
)
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.mongo.index_documents import IndexState
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from hybridlog.columns.tables import Tables
    from hybridlog_storage.catalog import Catalog, RecordingEntry, RecordingSummary
    from hybridlog_storage.mongo.database import Database


class StoreIndex(Struct, frozen=True):
    """The index of a store. All methods raise `DatabaseError` if MongoDB fails."""

    directory: StoreDirectory
    catalog: Catalog
    database: Database
    progress: Progress | None = None

    def bring_up_to_date(
        self,
        snapshot: Snapshot,
        entry_of: Callable[[RecordingSummary], RecordingEntry],
        *,
        index: str,
        removes: bool,
        report: RepairReport,
    ) -> set[str]:
        """Index missing segments, remove documents of removed recordings; returns changed ids.

        Recordings that the catalog knows to be in this index are not looked at, unless the index
        has another number of recordings than these. `removes` is False in a copy of the store that
        the index belongs to: what it does not have may be there.
        """
        directory, state = self.directory, IndexState(self.database)
        behind = [one for one in snapshot.summaries if one.indexed_by != index]
        known = state.of([one.key for one in behind]) if behind else {}
        is_other = state.count() - len(known) != len(snapshot.summaries) - len(behind)
        if is_other:
            behind, known = snapshot.summaries, state.of()
            if removes:
                # The directories are listed after the index: those that have begun are there, too.
                there = (*directory.ids(), *directory.manifests.without())
                gone = {*known} - {one[-16:] for one in there}
                if gone:
                    state.forget(gone)
                    report.removed += sorted(gone)
        changed, current = set(), []
        for summary in behind:
            entry = entry_of(summary)
            if known.get(entry.key) == entry.digests and entry.is_decoded:
                current.append(entry.id)
            elif directory.is_writable:  # else the segments answer, without an index
                changed.add(entry.id)
                # A process that holds the lock indexes it.
                with suppress(HeldError, TopicError):
                    try:
                        made = bring(
                            directory, self.catalog, entry, self.database, progress=self.progress
                        )
                    except SegmentError as error:
                        report.unreadable[entry.id] = str(error)
                    else:
                        report.indexed |= {} if made is None else {entry.name: made.made}
        if current:
            self.catalog.put_indexed(current, index)
        return changed.union(current)

    def rebuild(self, entries: Iterable[RecordingEntry]) -> dict[str, HybridlogError]:
        """Rebuild the index of recordings from their segments; returns why some are unchanged.

        The next connection finishes an interrupted rebuild. Unchanged ones, by id, are gone, or
        another process holds them.
        """
        left: dict[str, HybridlogError] = {}
        for chosen in entries:
            self.catalog.put_indexed([chosen.id], "")
            try:
                bring(
                    self.directory,
                    self.catalog,
                    chosen,
                    self.database,
                    anew=True,
                    wait_s=LOCK_WAIT_S,
                    progress=self.progress,
                )
            except (HeldError, TopicError) as error:
                left[chosen.id] = error
        return left

    def clear(self) -> None:
        """Remove all documents but those of recordings that are being written."""
        ids = self.directory.ids()
        held = [one[-16:] for one in ids if self.directory.holder(one) is not None]
        IndexState(self.database).clear_all(but=held)


def index_arrays(
    directory: StoreDirectory,
    catalog: Catalog,
    entries: Sequence[RecordingEntry],
    topics: Sequence[str],
    known: Tables,
    *,
    off: bool = False,
    progress: Progress | None = None,
) -> list[ArraysOfTopic]:
    """Change the setting of topics, and make their tables anew where these differ from it."""
    from hybridlog.columns.tables import files_of

    others = [one for one in read_settings(directory.path).arrays if one not in topics]
    directory.change_settings(arrays=tuple(sorted(others if off else {*others, *topics})))
    found = {topic: ArraysOfTopic(topic) for topic in topics}
    for entry in entries:
        own = topics_of(entry) & found.keys()
        wanted = {topic for topic in own if _differs(known, entry, topic, off=off)}
        if wanted:
            make_tables(directory, catalog, entry, topics=wanted, progress=progress)
            known.look_again()
        for topic in wanted:
            is_left = _differs(known, entry, topic, off=off)
            (found[topic].left if is_left else found[topic].recordings).append(entry.name)
    channels = [channel for entry in entries for channel in entry.channels]
    for topic, one in found.items():
        types = {type_prefix(one.type) for one in channels if one.topic == topic}
        one.bytes = sum(file.size_bytes for file in files_of(directory.path, types)) if types else 0
    return list(found.values())


def _differs(known: Tables, entry: RecordingEntry, topic: str, *, off: bool) -> bool:
    """True if a table is not as the setting of its topic is.

    Arrays of a recording from which some have expired are in no answer, and so in no table.
    """
    found = [one.section for one in known.sections_of(entry)]
    arrays = [section.arrays for section in found if section.topic == topic]
    is_expired = any(one.id >= EXPIRED_IDS for one in entry.channels if one.topic == topic)
    return (not arrays or off in arrays) and (off or not is_expired)
