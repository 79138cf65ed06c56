"""Edits recordings that have ended: name, tags, notes and marks; and removes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, cast

import numpy as np

from hybridlog.entries import (
    free_name_in,
    listed,
    put_entry,
    put_said,
    recording_metadata,
    take_inventory,
)
from hybridlog.maintenance import tables
from hybridlog.maintenance.index import decode_again, remove_documents
from hybridlog.maintenance.opening import remove_marks
from hybridlog.query.times import TimeLike, format_time, parse_time
from hybridlog.record.losses import extent_of
from hybridlog.record.marks import mark_channel, mark_payload
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import LOCK_WAIT_S, gone
from hybridlog_storage.errors import (
    ConnectionLostError,
    RecordingGoneError,
    StoreError,
    TimeError,
    UsageError,
)
from hybridlog_storage.manifest import Manifest, Mark, new_random, replace, with_totals
from hybridlog_storage.messages import EXPIRED_IDS, Batch, Channel
from hybridlog_storage.mongo.index_state import IndexState
from hybridlog_storage.segments.chunk import pack
from hybridlog_storage.segments.chunk_builder import ChunkBuilder
from hybridlog_storage.segments.compression import Compressor
from hybridlog_storage.segments.segment_file import SegmentFile
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from hybridlog.entries import Inventory
    from hybridlog.opened import OpenStore
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.segments.chunk import PackedChunk
    from hybridlog_storage.segments.segment_file import Sealed


def change(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    how: Callable[[Manifest], Manifest],
    name: str | None = None,
) -> None:
    """Change the manifest of a recording, also of a running one, and give it another name.

    Args:
        directory: The store.
        catalog: Its catalog.
        entry: The recording.
        how: The change.
        name: The name; it gets a number if another recording has it. None to leave it.

    Raises:
        StoreError: The manifest cannot be written.
        TopicError: The recording is gone.
    """
    directory.check_changes()
    with ExitStack() as held:
        if name is not None:
            held.enter_context(directory.manifests.creating())
            free, others = free_name_in(catalog, name, entry.id), how

            def how(now: Manifest) -> Manifest:
                return replace(others(now), name=free)

        try:
            directory.manifests.change(entry.id, how)
        except RecordingGoneError as error:
            raise gone(entry.name) from error
        put_said(directory, catalog, entry.id, is_open=directory.is_recorded(entry.id))


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
            f"{is_ or f'A mark cannot be at {format_time(time)}: '}{entry.name} {ends}; ten "
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
    """Set a mark: a segment of one message, and a line of the manifest.

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
    with directory.writing(entry.id, entry.name, wait_s=LOCK_WAIT_S):
        with directory.at_hand(entry.id) as here:
            path = here.recording(entry.id)
            inventory = take_inventory(directory, entry.id)
            numbers = {*inventory.listing.sealed, *inventory.listing.open}
            numbers.update(inventory.manifest.logs if inventory.manifest is not None else ())
            number = max(numbers, default=-1) + 1
            channel, channel_id, schema_id = _channel(inventory)
            payload = mark_payload(text, tags, end)
            seq = _next_seq(directory, inventory)
            segment = SegmentFile.create(path, number, recording_metadata(entry), seq)
            marked = Mark(new_random(), moment, text, dict(tags), end, number)

            def announce(sealed: Sealed) -> None:
                change = listed(sealed)
                here.manifests.change(
                    entry.id, lambda now: replace(change(now), marks=(*now.marks, marked))
                )

            try:
                segment.define([(channel_id, schema_id, channel)])
                segment.append_chunks(
                    [_chunk(channel_id, moment, payload, seq)], segment.position + 1
                )
                segment.seal(sync=True, on_sealing=announce)
            except BaseException:
                segment.abandon()
                _take_back(here, entry.id, segment)
                raise
        now = put_entry(directory, catalog, entry.id)
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
    """Remove the marks of a text from the manifest, then their segments.

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
    with directory.writing(entry.id, entry.name, wait_s=LOCK_WAIT_S):
        marks = directory.manifests.read(entry.id).marks
        chosen = [mark for mark in marks if mark.text == text and moment in {None, mark.time}]
        if not chosen:
            when = "" if moment is None else " at this time"
            raise UsageError(
                f"{entry.name} has no mark {text!r}{when} that was set after it was recorded: "
                "those of a recorder are messages, and stay."
            )
        numbers = [mark.segment for mark in chosen if mark.segment is not None]
        ids = {mark.id for mark in chosen}

        def change(now: Manifest) -> Manifest:
            made = replace(
                now,
                marks=tuple(mark for mark in now.marks if mark.id not in ids),
                files=tuple(one for one in now.files if one.number not in numbers),
                unmarked=(*now.unmarked, *(one for one in numbers if one not in now.unmarked)),
            )
            return with_totals(made)

        with directory.at_hand(entry.id, numbers) as here:
            remove_marks(here.recording(entry.id), here.manifests.change(entry.id, change))
        now = put_entry(directory, catalog, entry.id)
        if entry.is_decoded:
            decode_again(directory, catalog, now)


def _take_back(directory: StoreDirectory, recording: str, segment: SegmentFile) -> None:
    """Remove the segment of a failed mark, unless the manifest lists it.

    The next opening of the store finishes a removal that fails, or a listed mark.
    """
    with suppress(StoreError, OSError):
        if segment.number not in directory.manifests.read(recording).logs:
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
    lost = (number for file in inventory.lost for number in file.parts)
    ids = [number % EXPIRED_IDS for number in known]
    return wanted, max([*ids, *lost], default=-1) + 1, schemas + 1


def _next_seq(directory: StoreDirectory, inventory: Inventory) -> int:
    """One more than the greatest arrival number of a recording.

    Raises:
        SegmentError: A segment cannot be read.
    """
    following = 0
    for number, summary in sorted(inventory.summaries.items(), reverse=True):
        if not summary.chunks:
            continue
        path = directory.recording(inventory.folder) / inventory.listing.sealed[number]
        with SegmentReader(path, number) as reader:
            starts = summary.table.part_bounds()[:-1]
            messages = np.add.reduceat(summary.table.parts["messages"], starts)
            for place, count in zip(summary.chunks, messages.tolist(), strict=True):
                following = max(following, int(reader.read_arrivals(place, count).max()) + 1)
        if following >= int(cast("int", summary.recording.get("next_seq", 0))):
            break
    # Numbers of a lost segment are not reused: it may be restored from a copy.
    lost = (part for file in inventory.lost for part in file.parts.values())
    return following + sum(part.messages for part in lost)


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


def remove_if(
    shared: OpenStore, recording: str, check: Callable[[Manifest], None] = lambda _: None
) -> None:
    """Delete a recording of an open store, by its id.

    Args:
        shared: The open store.
        recording: The recording.
        check: Called with the newest manifest; raises to keep the recording.
    """
    try:
        entry = shared.now().entry(recording)
        remove(shared.directory, shared.catalog, shared.index.writable_database, entry, check)
    except ConnectionLostError:
        shared.invalidate()
        shared.index.connect()  # a new connection removes the rest
    finally:
        shared.catch_up()


def remove(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database | None,
    entry: RecordingEntry,
    check: Callable[[Manifest], None],
) -> None:
    """Delete a recording.

    Its manifest says so first, then its files go, then the manifest; who may write finishes what
    was interrupted.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index; None if it is unavailable: the next connection clears it.
        entry: The recording.
        check: Called with the newest manifest; raises to keep the recording.

    Raises:
        StoreError: It is being written, or cannot be removed.
        TopicError: It is gone.
        DatabaseError: MongoDB fails; the files are gone, and the next connection clears it.
    """
    with directory.writing(entry.id, entry.name, wait_s=LOCK_WAIT_S):
        try:
            directory.manifests.remove(entry.id, check)
        except RecordingGoneError as error:
            raise gone(entry.name) from error
        catalog.remove(entry.id)
        with suppress(OSError, StoreError):  # the next connection removes them
            tables.remove(directory, entry.id, {c.type for c in entry.channels})
        if database is not None:
            _clear(database, entry)


def _clear(database: Database, entry: RecordingEntry) -> None:
    """Remove a recording from the index."""
    state = IndexState(database)
    indexed = state.one(entry.key)
    if indexed is not None:
        state.put(entry, "removing", turn=indexed.turn + 1)
    remove_documents(database, entry.key, indexed)
