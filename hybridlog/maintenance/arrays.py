"""Tables with arrays in full: an option of topics, kept in the store's settings."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from hybridlog.columns.layout import topics_of, type_prefix
from hybridlog.follow.follower import make_tables
from hybridlog.maintenance.report import ArraysOfTopic
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from hybridlog.columns.tables import Tables
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory


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
    others = [one for one in read_settings(directory.path).arrays if one not in topics]
    directory.change_settings(arrays=tuple(sorted(others if off else {*others, *topics})))
    found = {topic: ArraysOfTopic(topic) for topic in topics}
    channels = [channel for entry in entries for channel in entry.channels]
    types = {one: {type_prefix(c.type) for c in channels if c.topic == one} for one in topics}
    before = _bytes(directory.path, types)
    for entry in entries:
        own = topics_of(entry) & found.keys()
        wanted = {topic for topic in own if _differs(known, entry, found[topic], off=off)}
        if not wanted:
            continue
        make_tables(directory, catalog, entry, topics=wanted, progress=progress)
        known.look_again()
        for topic in wanted:
            is_left = _differs(known, entry, found[topic], off=off)
            (found[topic].left if is_left else found[topic].recordings).append(entry.name)
    after = _bytes(directory.path, types)
    for topic, one in found.items():
        one.bytes_before, one.bytes_after = before[topic], after[topic]
    return list(found.values())


def _bytes(root: Path, types: Mapping[str, set[str]]) -> dict[str, int]:
    """Bytes of all tables of the types of each topic."""
    from hybridlog.columns.folders import files_of

    sizes: Counter[str] = Counter()
    for file in files_of(root, set[str]().union(*types.values())):
        sizes[file.path.parent.name.rpartition("~")[0] + "~"] += file.size_bytes
    return {topic: sum(sizes[one] for one in own) for topic, own in types.items()}


def _differs(known: Tables, entry: RecordingEntry, found: ArraysOfTopic, *, off: bool) -> bool:
    """True if a table is not as the setting of its topic is; notes whether it can have arrays.

    Arrays of a recording from which some have expired are in no answer, and so in no table.
    """
    topic, differs = found.topic, None
    for file, _, section in known.sections_of(entry):
        if section.topic == topic:
            can_have = bool(file.arrays)
            found.has_arrays = found.has_arrays or can_have
            is_other = can_have and bool(section.counts.arrays) is off
            differs = differs or is_other
    is_expired = any(one.id >= EXPIRED_IDS for one in entry.channels if one.topic == topic)
    return differs is not False and (off or not is_expired)
