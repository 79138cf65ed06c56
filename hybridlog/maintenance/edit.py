"""Edits recordings that have ended: name, tags, notes and marks; and removes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, cast

import numpy as np

from hybridlog.entries import (
    announce_removal,
    put_entry,
    recording_metadata,
    sealed_event,
    take_inventory,
)
from hybridlog.maintenance import tables
from hybridlog.maintenance.index import decode_again, remove_documents
from hybridlog.maintenance.opening import finish_renaming, remove_marks
from hybridlog.query.times import TimeLike, format_time, parse_time
from hybridlog.record.losses import extent_of
from hybridlog.record.marks import mark_channel, mark_payload
from hybridlog_storage import journal
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import StoreError, TimeError, TopicError, UsageError
from hybridlog_storage.journal import Journal
from hybridlog_storage.messages import EXPIRED_IDS, Batch, Channel
from hybridlog_storage.mongo.index_state import IndexState
from hybridlog_storage.remote.store import RemoteDirectory
from hybridlog_storage.segments.chunk import pack
from hybridlog_storage.segments.chunk_builder import ChunkBuilder
from hybridlog_storage.segments.compression import Compressor
from hybridlog_storage.segments.segment_file import SegmentFile
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from hybridlog.entries import Inventory
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.segments.chunk import PackedChunk
    from hybridlog_storage.segments.segment_file import Sealed


def append(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    lines: Sequence[journal.Event],
) -> None:
    """Append lines to the journal of a recording; a new name changes its directory's label.

    Raises:
        StoreError: It is being written, or its journal cannot be written.
        TopicError: It is gone.
    """
    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:
        directory.append(label, *[_with_labels(directory, label, line) for line in lines])
        state = journal.read(directory.recording(label))
        put_entry(directory, catalog, finish_renaming(directory, label, state))


def _with_labels(directory: StoreDirectory, label: str, line: journal.Event) -> journal.Event:
    """A line of the journal; a renaming line also has the old and the new label."""
    if line["event"] != journal.RENAMED:
        return line
    new = directory.free_label(str(line["name"]), but=label)
    return line if new == label else {**line, "from": label, "to": new}


def time_of_mark(entry: RecordingEntry, moment: TimeLike) -> int:
    """Log time of a mark's beginning or end, ns.

    Outside of a recording that has ended, a mark would become its beginning or end, from which
    relative times count.

    Raises:
        TimeError: It is invalid, or outside the recording.
    """
    start, end = extent_of(entry)
    time = parse_time(moment, start=start, end=end)
    has_messages = entry.messages > len(entry.marks)
    if has_messages and entry.status != "open" and not start <= time <= end:
        ends = f"begins at {format_time(start)}" if time < start else f"ends at {format_time(end)}"
        is_ = f"{moment} is {format_time(time)}, and " if isinstance(moment, str) else ""
        raise TimeError(
            f"{is_ or f'A mark cannot be at {format_time(time)}: '}{entry.label} {ends}; ten "
            "seconds from its beginning are +10s, ten before its end -10s."
        )
    return time


def mark(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    moment: int,
    *,
    text: str,
    tags: Mapping[str, str],
    end: int | None = None,
) -> None:
    """Set a mark: a segment of one message, and a line of the journal.

    Args:
        directory: The store.
        catalog: Its catalog.
        entry: The recording.
        moment: Log time of the mark, ns.
        text: Text of the mark.
        tags: Tags of the mark.
        end: Log time of its end, ns; None for a moment.

    Raises:
        StoreError: The recording is being written, or a segment of it cannot be read.
        TimeError: The mark would be before 1970, or end before it begins.
        TopicError: It is gone.
    """
    if moment < 0:
        raise TimeError("A mark cannot be set before 1970: its log time has no sign.")
    if end is not None and end < moment:
        raise TimeError("A mark cannot end before it begins.")
    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:
        with directory.at_hand(label) as here:
            path = here.recording(label)
            inventory = take_inventory(directory, label)
            numbers = {*inventory.listing.sealed, *inventory.listing.open}
            numbers.update(inventory.state.sealed if inventory.state is not None else ())
            number = max(numbers, default=-1) + 1
            channel, channel_id, schema_id = _channel(inventory)
            payload = mark_payload(text, tags, end)
            seq = _next_seq(directory, label, inventory)
            segment = SegmentFile.create(path, number, recording_metadata(entry), seq)
            until = {} if end is None else {"end": end}
            marked = journal.event(
                journal.MARKED, time=moment, **until, text=text, tags=dict(tags), segment=number
            )

            def announce(sealed: Sealed) -> None:
                # In this order: a mark whose segment is not listed does not exist.
                Journal(path).append(marked, sealed_event(sealed))

            try:
                segment.define([(channel_id, schema_id, channel)])
                segment.append_chunks(
                    [_chunk(channel_id, moment, payload, seq)], segment.position + 1
                )
                segment.seal(sync=True, on_sealing=announce)
            except BaseException:
                segment.abandon()
                _take_back(segment)
                raise
        now = put_entry(directory, catalog, label)
        if entry.is_decoded:
            decode_again(directory, catalog, now)


def unmark(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    moment: int | None,
    *,
    text: str,
) -> None:
    """Remove the marks of a text: lines of the journal, then their segments.

    Args:
        directory: The store.
        catalog: Its catalog.
        entry: The recording.
        moment: Log time of the mark, ns; None for any.
        text: Text of the mark.

    Raises:
        StoreError: The recording is being written.
        TopicError: It is gone.
        UsageError: It has no such mark.
    """
    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:
        state = journal.read(directory.recording(label))
        marks = state.marks if state is not None else []
        gone = [m for m in marks if m["text"] == text and moment in {None, m["time"]}]
        if not gone:
            when = "" if moment is None else " at this time"
            raise UsageError(
                f"{label} has no mark {text!r}{when} that was set after it was recorded: those of "
                "a recorder are messages, and stay."
            )
        lines = [journal.event(journal.UNMARKED, segment=mark["segment"]) for mark in gone]
        with directory.at_hand(label, [mark["segment"] for mark in gone]) as here:
            path = here.recording(label)
            Journal(path).append(*lines)
            state = journal.read(path)
            assert state is not None
            remove_marks(path, state)
        now = put_entry(directory, catalog, label)
        if entry.is_decoded:
            decode_again(directory, catalog, now)


def _take_back(segment: SegmentFile) -> None:
    """Remove the segment of a failed mark, unless the journal lists it.

    The next opening of the store finishes a removal that fails, or a listed mark.
    """
    with suppress(StoreError, OSError):
        state = journal.read(segment.path.parent)
        if state is not None and segment.number not in state.sealed:
            files.unlink(segment.path)


def _channel(inventory: Inventory) -> tuple[Channel, int, int]:
    """The channel of marks with its id and schema id: those of the recording, or new ones."""
    wanted = mark_channel()
    known: dict[int, Channel] = {}
    schemas = 0
    for summary in inventory.summaries.values():
        known.update(summary.channels)
        schemas = max([schemas, *summary.schema_ids.values()])
        for channel_id, channel in summary.channels.items():
            same = channel.topic == wanted.topic and channel.schema == wanted.schema
            if same and channel.message_encoding == wanted.message_encoding:
                return channel, channel_id, summary.schema_ids[channel_id]
    # Ids of a lost segment are not reused either.
    lost = (int(c["id"]) for sealed in inventory.lost for c in sealed.channels)
    ids = [number % EXPIRED_IDS for number in known]
    return wanted, max([*ids, *lost], default=-1) + 1, schemas + 1


def _next_seq(directory: StoreDirectory, label: str, inventory: Inventory) -> int:
    """One more than the greatest arrival number of a recording.

    Raises:
        SegmentError: A segment cannot be read.
    """
    following = 0
    for number, summary in sorted(inventory.summaries.items(), reverse=True):
        if not summary.chunks:
            continue
        path = directory.recording(label) / inventory.listing.sealed[number]
        with SegmentReader(path, number) as reader:
            starts = summary.table.part_bounds()[:-1]
            messages = np.add.reduceat(summary.table.parts["messages"], starts)
            for place, count in zip(summary.chunks, messages.tolist(), strict=True):
                following = max(following, int(reader.read_arrivals(place, count).max()) + 1)
        if following >= int(cast("int", summary.recording.get("next_seq", 0))):
            break
    # Numbers of a lost segment are not reused: it may be restored from a copy.
    return following + sum(sealed.messages for sealed in inventory.lost)


def _chunk(channel_id: int, moment: int, payload: bytes, seq: int) -> PackedChunk:
    """Make a chunk of one message."""
    one = np.ones(1, np.int64)
    batch = Batch(
        payload,
        np.zeros(1, np.int64),
        one * len(payload),
        np.full(1, channel_id, np.int32),
        one * moment,
        one * moment,
        np.zeros(1, np.uint32),
    )
    builder = ChunkBuilder(1 << 10)
    builder.append(batch, one * seq)
    return pack(Compressor("none"), *builder.take())


def remove(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database | None,
    entry: RecordingEntry,
) -> None:
    """Delete a recording.

    The journal announces it first. Then the directory gets a hidden name, and the recording
    is gone; the next opening removes remaining files. In a bucket it is listed no more, and its
    objects stay for those who read them.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index; None if it is unavailable: the next connection clears it.
        entry: The recording.

    Raises:
        StoreError: It is being written, or cannot be removed.
        TopicError: It is gone.
        DatabaseError: MongoDB fails; the files are gone, and the next connection clears it.
    """
    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:
        if isinstance(directory, RemoteDirectory):
            directory.drop(label)
            catalog.remove(entry.id)
            return
        announce_removal(directory, label)
        tables.announce_removal(directory, entry.id)
        hidden = directory.hide(label)
        try:
            catalog.remove(entry.id)
            with suppress(OSError):  # the next connection removes them
                tables.remove(directory, entry.id, {c.type for c in entry.channels})
            if database is not None:
                _clear(database, entry)
        finally:
            # On a full disk, the space of these files is needed first.
            directory.sweep(hidden)


def _clear(database: Database, entry: RecordingEntry) -> None:
    """Remove a recording from the index."""
    state = IndexState(database)
    indexed = state.one(entry.key)
    if indexed is not None:
        state.put(entry, "removing", turn=indexed.turn + 1)
    remove_documents(database, entry.key, indexed)


def remove_copy(directory: StoreDirectory, label: str, recording: str) -> None:
    """Delete a directory with a copy of a recording; the index stays.

    Raises:
        StoreError: It is being written, or cannot be removed.
        TopicError: It is no copy of the recording any more.
    """
    with directory.writing(label, recording, wait_s=LOCK_WAIT_S) as now:
        if now != label or directory.labels_of(recording) == [label]:
            raise TopicError(f"{label!r} is no longer a copy of another recording.")
        directory.remove(label)
