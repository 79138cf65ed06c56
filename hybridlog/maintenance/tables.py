"""Creates, checks and removes the tables of recordings."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.payloads.contents import MovedContents, open_segment
from hybridlog.tables.layout import (
    IN_TABLES,
    IN_TOPIC,
    NO_TABLE,
    OWN_FILE_ROWS,
    PARTS,
    TABLES,
    parts_folder,
    recording_folder,
    table_schema,
    topic_folder,
)
from hybridlog.tables.writer import TableWriter
from hybridlog_storage import files
from hybridlog_storage.errors import SegmentError, StoreError, TopicError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hybridlog.maintenance.report import RepairReport
    from hybridlog.snapshot import Snapshot
    from hybridlog.tables.reader import Tables, TopicTable
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.chunk_table import ChunkTable
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.messages import Channel


def topics_of(entry: RecordingEntry) -> set[str]:
    """Topics of a recording that have messages."""
    return {c.topic for c in entry.channels if c.stats.messages}


def missing(directory: StoreDirectory, entry: RecordingEntry) -> set[str]:
    """Topics whose tables are missing, or differ from the catalog.

    Topics with few rows share files; those of one file are missing together.
    """
    from hybridlog.tables.reader import Tables

    tables = Tables(directory.path)
    return together(entry, {t for t in topics_of(entry) if tables.of(entry, t) is None})


def together(entry: RecordingEntry, topics: Collection[str]) -> set[str]:
    """Some topics, and those that share a file with one of them."""
    messages = entry.messages_by_topic()
    schemas: dict[str, set[str]] = {topic: set() for topic in topics_of(entry)}
    for c in entry.channels:
        if c.topic in schemas and messages[c.topic] < OWN_FILE_ROWS:
            schemas[c.topic].add(table_schema(c.message_encoding, c.schema, c.metadata))
    shared = {schema for topic in topics for schema in schemas.get(topic, ())}
    return {t for t in schemas if t in topics or not shared.isdisjoint(schemas[t])}


def make(
    directory: StoreDirectory, entry: RecordingEntry, topics: Collection[str] | None = None
) -> bool:
    """Create tables of a recording again from its segments.

    Args:
        directory: The store.
        entry: The recording's entry in the catalog.
        topics: Topics of the tables; None for those that are missing.

    Returns:
        True if tables were created; False if the recording is being written, or the store is
            read-only.
    """
    if entry.status == "open" or not directory.is_writable:
        return False
    wanted = missing(directory, entry) if topics is None else together(entry, topics)
    if not wanted:
        return True
    try:
        with directory.writing(entry.label, entry.id) as label:
            entry = replace(entry, label=label)
            writer = TableWriter(directory.path, entry.id, topics=wanted, is_new=False)
            try:
                for chunk, channels in _chunks(directory, entry, wanted, writer):
                    writer.add(chunk, channels)
                writer.close(entry)
            finally:
                writer.discard()
    except (StoreError, TopicError):
        return False
    return not writer.has_failed


def made_for(
    directory: StoreDirectory,
    entry: RecordingEntry,
    topic: str,
    tables: Tables,
    report: RepairReport,
) -> TopicTable | None:
    """The table of a topic for a question, created again if it is missing or damaged.

    A topic for which no table can be made is noted, which prevents another attempt.

    Args:
        directory: The store.
        entry: The recording's entry in the catalog.
        topic: Full name.
        tables: Finds the tables.
        report: Collects the tables that were created.
    """
    found = tables.of(entry, topic)
    if found is not None or entry.status == "open" or not directory.is_writable:
        return found
    note = recording_folder(directory.path, entry.id) / topic_folder(topic) / NO_TABLE
    state = ",".join(f"{number}:{entry.digests[number]}" for number in sorted(entry.digests))
    with suppress(OSError, StoreError):
        if files.read_file(note, len(state) + 1, depth=IN_TOPIC) == state.encode():
            return None
    if not make(directory, entry, {topic}):
        return None
    tables.forget(entry, topic)
    found = tables.of(entry, topic)
    if found is None:
        with suppress(OSError, StoreError):
            files.make_folders(note.parent, depth=IN_TOPIC - 1)
            files.write_file(note, state.encode(), depth=IN_TOPIC)
    else:
        report.tables.append((entry.label, topic))
    return found


def _chunks(
    directory: StoreDirectory,
    entry: RecordingEntry,
    topics: Collection[str],
    writer: TableWriter,
) -> Iterator[tuple[StoredChunk, Mapping[int, Channel]]]:
    """Chunks with messages of some topics, in order; damaged ones are left out."""
    path = directory.recording(entry.label)
    contents = MovedContents(path)
    for number, _, _ in entry.spans:
        with open_segment(path / f"{number:06d}.mcap", number, contents) as reader:
            summary = reader.summary()
            is_wanted = chunks_with(entry, summary.table, topics)
            for place in summary.chunks:
                if is_wanted[place.number]:
                    with suppress(SegmentError):
                        yield reader.read_chunk(place), summary.channels
        writer.cut(number, entry.digests[str(number)])


def chunks_with(entry: RecordingEntry, table: ChunkTable, topics: Collection[str]) -> list[bool]:
    """For each chunk of a segment, True if it has messages of some topics."""
    ids = [c.id for c in entry.channels if c.topic in topics]
    chunk_of = np.repeat(np.arange(len(table.chunks)), table.chunks["parts"])
    found = np.zeros(len(table.chunks), np.bool_)
    found[chunk_of[np.isin(table.parts["channel"], ids)]] = True
    return found.tolist()


def damage(directory: StoreDirectory, entry: RecordingEntry) -> dict[str, str]:
    """Problems of the existing tables, by topic. Reads every byte of them."""
    from hybridlog.tables.reader import Tables

    tables = Tables(directory.path)
    found: dict[str, str] = {}
    checked: dict[object, str] = {}
    for topic in sorted(topics_of(entry)):
        try:
            for file in tables.check(entry, topic).files:
                if file.path not in checked:
                    checked[file.path] = ""
                    try:
                        file.check()
                    except StoreError as error:
                        checked[file.path] = str(error)
                if checked[file.path]:
                    found[topic] = checked[file.path]
        except FileNotFoundError:
            pass  # a missing table is no problem
        except StoreError as error:
            found[topic] = str(error)
    return found


def remove(directory: StoreDirectory, recording: str) -> None:
    """Remove all tables of a recording.

    Raises:
        OSError: a table cannot be removed.
    """
    parts = parts_folder(directory.path, recording)
    with suppress(FileNotFoundError):
        files.remove_tree(parts, depth=files.IN_FOLDER)
    folder = recording_folder(directory.path, recording)
    try:
        files.make_folders(parts, depth=files.IN_FOLDER)
        files.rename(folder, parts / "removed", depth=IN_TABLES, new_depth=files.IN_RECORDING)
    except FileNotFoundError:
        pass
    finally:
        with suppress(FileNotFoundError):
            files.remove_tree(parts, depth=files.IN_FOLDER)


def remove_unfinished(directory: StoreDirectory, snapshot: Snapshot) -> None:
    """Remove unfinished files that a crash has left."""
    for name in _names(directory, PARTS):
        place = snapshot.by_id.get(name.removeprefix("r"))
        if place is None:
            continue
        one = snapshot.summaries[place]
        with suppress(OSError, StoreError, TopicError), directory.writing(one.label, one.id):
            files.remove_tree(directory.path / PARTS / name, depth=files.IN_FOLDER)


def are_more_than(directory: StoreDirectory, recordings: int) -> bool:
    """True if there are tables of more recordings than these."""
    return any(len(_names(directory, top)) > recordings for top in (TABLES, PARTS))


def remove_strangers(directory: StoreDirectory, present: Collection[str]) -> None:
    """Remove tables of removed recordings.

    Args:
        directory: The store.
        present: Keys of all recordings with a directory.
    """
    for top, beginning in ((TABLES, "recording=r"), (PARTS, "r")):
        for name in _names(directory, top):
            recording = name.removeprefix(beginning)
            if recording != name and recording[:16] not in present:
                with suppress(OSError):
                    remove(directory, recording)


def _names(directory: StoreDirectory, top: str) -> list[str]:
    try:
        with files.folder(directory.path / top, files.IN_STORE) as fd:
            return os.listdir(fd)  # noqa: PTH208 - of a handle
    except OSError:
        return []
