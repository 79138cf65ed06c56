"""Tables with arrays in full: an option of topics, kept in the store's settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog.maintenance import tables
from hybridlog.maintenance.report import ArraysOfTopic
from hybridlog.maintenance.sizes import table_bytes
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.columns.tables import Tables
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory


def index_arrays(
    directory: StoreDirectory,
    entries: Sequence[RecordingEntry],
    topics: Sequence[str],
    known: Tables,
    *,
    off: bool = False,
    progress: Progress | None = None,
) -> list[ArraysOfTopic]:
    """Change the setting of topics, and make their tables anew where these differ from it.

    Args:
        directory: The store.
        entries: Its recordings.
        topics: Full names.
        known: The tables.
        off: True for tables without arrays.
        progress: Called after each chunk.

    Raises:
        StoreError: The settings cannot be written.
    """
    others = [one for one in read_settings(directory.path).arrays if one not in topics]
    directory.change_settings(arrays=tuple(sorted(others if off else {*others, *topics})))
    found = {topic: ArraysOfTopic(topic) for topic in topics}
    having = [(entry, entry.messages_by_topic().keys() & found.keys()) for entry in entries]
    having = [(entry, own) for entry, own in having if own]
    chosen = [entry for entry, _ in having]
    for key, size in table_bytes(directory.path, chosen).items():
        if key[1] in found:
            found[key[1]].bytes_before += size
    for entry, own in having:
        wanted = {topic for topic in own if _differs(known, entry, topic, off=off)}
        if not wanted:
            continue
        is_made = tables.make(directory, entry, wanted, progress=progress)
        known.look_again_for(entry, wanted)
        for topic in wanted:
            (found[topic].recordings if is_made else found[topic].left).append(entry.label)
    for key, size in table_bytes(directory.path, chosen).items():
        if key[1] in found:
            found[key[1]].bytes_after += size
    return list(found.values())


def _differs(known: Tables, entry: RecordingEntry, topic: str, *, off: bool) -> bool:
    """True if a table is not as the setting of its topic is.

    Arrays of a recording from which some have expired are in no answer, and so in no table.
    """
    is_expired = any(one.id >= EXPIRED_IDS for one in entry.channels if one.topic == topic)
    if is_expired and not off:
        return False
    counts = [s.topics[topic] for _, _, s in known.sections_of(entry) if topic in s.topics]
    return not counts or any(bool(one.arrays) is off for one in counts)
