"""Makes catalog entries of recordings from their journals and segments, and puts them there.

Recording, recovery, rebuilding and opening use the same functions, so their entries are
equal. Files that differ from the journal are not used. Content that the journal lists and
that is missing or changed becomes rows of the loss ledger.
"""

from __future__ import annotations

import os
import secrets
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.columns.layout import PAYLOAD_PARTS
from hybridlog.record.losses import Cause, extent_of, joined, topics_of
from hybridlog.schema.states import State, expired_messages
from hybridlog_storage import journal
from hybridlog_storage.catalog import (
    ChannelStats,
    Described,
    RecordingEntry,
    channel_entry,
    channel_totals,
    content_of,
)
from hybridlog_storage.disk.directory import PAYLOADS
from hybridlog_storage.errors import CatalogError, DiskFullError, SegmentError, StoreError
from hybridlog_storage.journal import Journal, PayloadFile
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_file import Sealed, sealed_channels
from hybridlog_storage.segments.segment_reader import SegmentReader, SegmentSummary
from hybridlog_storage.summary import RecordingSummary, TopicType, hash_of, topics_to_json

if TYPE_CHECKING:
    from hybridlog_storage.catalog import Catalog
    from hybridlog_storage.disk.directory import Listing, StoreDirectory
    from hybridlog_storage.journal import JournalState, SealedSegment


_TRIES = 10  # to read a recording while its directory is renamed


def new_id() -> str:
    """A random id of a recording: 32 hexadecimal digits."""
    return secrets.token_hex(16)


def recording_metadata(entry: RecordingEntry) -> dict[str, object]:
    """The metadata of a recording in each of its segments."""
    return {
        "id": entry.id,
        "name": entry.name,
        "tags": entry.tags,
        "source": entry.source,
        "created": entry.created,
    }


@dataclass(frozen=True, slots=True)
class Misfit:
    """A file of a recording that differs from the journal.

    Attributes:
        segment: Number in the file's name.
        file: Its name; empty for one that is missing.
        reason: Description of the problem.
        is_unlisted: Whether it is a whole segment of this recording that the journal lacks.
        belongs: Number under which the journal lists this content; None if it does not.
    """

    segment: int
    file: str
    reason: str
    is_unlisted: bool = False
    belongs: int | None = None


@dataclass(slots=True)
class Inventory:
    """Content of a recording's directory, compared with its journal.

    Attributes:
        label: Name of the directory.
        listing: Names of its files.
        state: State of the journal; None without one.
        summaries: Summaries of valid segments, by number.
        stored: Digest and size of the files of segments with expired chunks, by number. Their
            summaries have the digest of the segment as it was before.
        misfits: Files that differ from the journal.
        lost: Listed segments that are missing or changed.
        joined: Joined files of fields that a lost journal has listed.
        replaced: Files that these were joined of.
    """

    label: str
    listing: Listing
    state: JournalState | None
    summaries: dict[int, SegmentSummary] = field(default_factory=dict)
    stored: dict[int, tuple[str, int]] = field(default_factory=dict)
    misfits: list[Misfit] = field(default_factory=list)
    lost: list[SealedSegment] = field(default_factory=list)
    joined: dict[str, PayloadFile] = field(default_factory=dict)
    replaced: dict[str, PayloadFile] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """The recording's id; empty if unknown."""
        if self.state is not None and self.state.id:
            return self.state.id
        ids = Counter(str(s.recording.get("id", "")) for s in self.summaries.values())
        return ids.most_common(1)[0][0] if ids else ""

    @property
    def payloads(self) -> dict[str, PayloadFile]:
        """Files of fields of expired messages, as the journal and the segments list them."""
        found: dict[str, PayloadFile] = {}
        for summary in self.summaries.values():
            files = (summary.compacted or {}).get("files", ())
            found.update({file.file: file for file in files})
        if self.state is not None:
            found = {path: file for path, file in found.items() if path not in self.state.deleted}
            found |= self.state.payloads
        return {path: f for path, f in found.items() if path not in self.replaced} | self.joined

    def stored_file(self, number: int) -> tuple[str, int]:
        """Digest and size of the file of a valid segment."""
        summary = self.summaries[number]
        return self.stored.get(number, (summary.digest, summary.size))

    @property
    def end(self) -> Mapping[str, Any] | None:
        """The end of the recording: by its journal, else by the last segment that states it."""
        if self.state is not None and self.state.end is not None:
            return self.state.end
        ends = [summary.end for _, summary in sorted(self.summaries.items()) if summary.end]
        return ends[-1] if ends else None

    @property
    def is_proven(self) -> bool:
        """True if the journal is complete, and all segments that it lists are valid."""
        return (
            self.state is not None
            and self.state.is_proof
            and not self.lost
            and not any(misfit.is_unlisted for misfit in self.misfits)
        )


def take_inventory(directory: StoreDirectory, label: str) -> Inventory:
    """Compare the sealed segments of a recording with its journal.

    Raises:
        StoreError: Directory or journal cannot be read.
    """
    path = directory.recording(label)
    listing = directory.listing(label)
    state = journal.read(path) if listing.journal else None
    found = Inventory(label, listing, state)
    listed = state.sealed if state is not None else {}
    numbers = {sealed.digest: number for number, sealed in listed.items()}
    unmarked = state.unmarked if state is not None else set()
    for number, name in listing.sealed.items():
        if number in unmarked:
            continue  # it is about to be removed
        try:
            found.summaries[number] = read_summary(path / name, number)
        except SegmentError as error:
            found.misfits.append(Misfit(number, name, str(error)))
    recording = found.id
    _find_joined(found, path / PAYLOADS)
    for number, summary in list(found.summaries.items()):
        name = listing.sealed[number]
        problem = _difference(found, summary, number, recording)
        if problem is not None:
            del found.summaries[number]
            belongs = numbers.get(summary.whole_digest)
            found.misfits.append(Misfit(number, name, problem, belongs=belongs))
        elif state is not None and not _is_listed(found, state, number):
            reason = "the journal does not list it"
            found.misfits.append(Misfit(number, name, reason, is_unlisted=True))
    for number, sealed in listed.items():
        # A listed segment with its old name is about to be renamed.
        if number not in found.summaries and number not in listing.open:
            found.lost.append(sealed)
            if number not in listing.sealed:
                found.misfits.append(Misfit(number, "", f"{sealed.file} is missing"))
    found.misfits.sort(key=lambda misfit: misfit.segment)
    return found


def _find_joined(inventory: Inventory, folder: Path) -> None:
    """Find what took the place of files of fields that are missing; the journal may be lost."""
    listed, there = inventory.payloads, inventory.listing.payloads
    if listed.keys() <= there.keys():
        return
    from hybridlog.columns.column_file import ColumnFile

    for path in there.keys() - listed.keys():
        with suppress(StoreError, FileNotFoundError, LookupError, ValueError, TypeError):
            file = ColumnFile(folder / path)
            (section,) = file.about.recordings
            ((topic, counts),) = section.topics.items()
            replaced = {*file.about.payloads["replaces"]} & listed.keys()
            if section.id == inventory.id and replaced:
                about = PayloadFile(path, file.size_bytes, file.digest, topic, counts.rows)
                inventory.joined[path] = about
                inventory.replaced |= {one: listed[one] for one in replaced}


def _difference(
    inventory: Inventory, summary: SegmentSummary, number: int, recording: str
) -> str | None:
    """The difference of a whole segment from the journal; None if it matches.

    A segment with expired chunks gets the digest that it had before, which it names itself: the
    journal may lack the line about it.
    """
    its_id, its_number = summary.recording.get("id"), summary.recording.get("segment")
    if its_id != recording:
        return f"it is a segment of another recording, {its_id}"
    if its_number != number:
        return f"it is segment {its_number} of this recording"
    state = inventory.state
    sealed = state.sealed.get(number) if state is not None else None
    whole = summary.whole_digest
    if whole != summary.digest and (sealed is None or sealed.digest == whole):
        inventory.stored[number] = summary.digest, summary.size
        inventory.summaries[number] = replace(summary, digest=whole)
    elif sealed is not None and (summary.digest, summary.size) != (sealed.digest, sealed.bytes):
        return "it is not the segment that the journal lists: an older or a changed one"
    return None


def _is_listed(inventory: Inventory, state: JournalState, number: int) -> bool:
    """True if the journal lists a valid segment as its file is now, and what that needs."""
    files = (inventory.summaries[number].compacted or {}).get("files", ())
    is_listed_size = inventory.stored.get(number) in (None, *state.thinned.get(number, ()))
    known = state.payloads.keys() | state.deleted
    return number in state.sealed and is_listed_size and {f.file for f in files} <= known


def read_summary(path: Path, number: int) -> SegmentSummary:
    """The summary of a sealed segment.

    Raises:
        SegmentError: It has no readable summary, or cannot be opened.
    """
    with SegmentReader(path, number) as reader:
        return reader.summary()


def describe(catalog: Catalog, inventory: Inventory, *, is_open: bool = False) -> Described:
    """Make the complete entry of a recording.

    Args:
        catalog: Has the decoding results of its segments, and its unreadable chunks.
        inventory: Content of its directory.
        is_open: Whether a process is writing it.

    Raises:
        SegmentError: Neither journal nor segments say what recording it is.
    """
    from hybridlog.schema.codecs import codec_for

    if not inventory.id:
        raise SegmentError(
            f"Recording {inventory.label!r} has neither a journal nor a segment that can be "
            "read. Restore the files, or remove the directory."
        )
    entry = _base(inventory)
    channels: dict[int, Channel] = {}
    lost: list[dict[str, Any]] = []
    end = inventory.end
    for summary in inventory.summaries.values():
        channels.update(summary.channels)
        lost += summary.losses
        entry.stored_bytes += summary.size
        entry.chunks += len(summary.table.chunks)
        entry.attachments += len(summary.attachments)
        entry.metadata_records += len(summary.metadata)
    entry.segments = len(inventory.summaries)
    entry.stored_bytes += sum(file["bytes"] for file in entry.payloads)
    entry.end = dict(end) if end is not None else {}
    ours = [row for sealed in inventory.lost for row in _losses_of_segment(inventory, sealed)]
    ours += _losses_of_crash(inventory)
    ours += _losses_of_fields(inventory)
    ours += _losses_of_chunks(inventory, catalog.damage(inventory.id))
    entry.status = _status(inventory, end, is_open=is_open, has_losses=bool(ours))
    if lost or ours:
        entry.end["losses"] = joined([*entry.end.get("losses", ()), *lost]) + ours
    entry.stored = {str(number): digest for number, (digest, _) in inventory.stored.items()}
    entry.digests = {str(number): summary.digest for number, summary in inventory.summaries.items()}
    entry.spans = [
        (number, int(summary.table.chunks["first"].min()), int(summary.table.chunks["last"].max()))
        for number, summary in inventory.summaries.items()
        if len(summary.table.chunks)
    ]
    entry.channels = [
        channel_entry(channel_id, channel, codec_for(channel).reason)
        for channel_id, channel in sorted(channels.items())
    ]
    _fill_stats(entry, inventory, catalog)
    return Described(
        entry,
        summary_of(entry, inventory.listing.look),
        topic_types(entry),
        inventory.listing.print,
        channels,
    )


def describe_now(
    directory: StoreDirectory, catalog: Catalog, label: str, *, is_open: bool = False
) -> Described:
    """Read a recording from its files.

    Raises:
        SegmentError: The recording cannot be identified.
        StoreError: Its files change all the time.
    """
    for _ in range(_TRIES):
        inventory = take_inventory(directory, label)
        # Of a directory that is renamed meanwhile, files would be missing.
        if directory.listing(label).print == inventory.listing.print:
            return describe(catalog, inventory, is_open=is_open)
    raise StoreError(f"The files of recording {label!r} change while they are read. Ask again.")


def put_entry(
    directory: StoreDirectory, catalog: Catalog, label: str, *, is_open: bool = False
) -> RecordingEntry:
    """Read a recording's files and update its catalog row.

    Raises:
        SegmentError: The recording cannot be identified.
    """
    described = describe_now(directory, catalog, label, is_open=is_open)
    catalog.put(described)
    return described.entry


def read_again(directory: StoreDirectory, catalog: Catalog, entry: RecordingEntry) -> None:
    """Read the files of a recording again, after one of them was not what its entry says.

    Raises:
        StoreError: They cannot be read, or have changed.
    """
    is_open = directory.is_recorded(entry.label)
    now = describe_now(directory, catalog, entry.label, is_open=is_open)
    catalog.put(now, waits=False)
    for number, _, _ in entry.spans:
        try:
            catalog.table(entry, number)
        except CatalogError as error:
            raise StoreError(
                f"The files of recording {entry.label!r} have changed since the store was "
                "opened. Open it again."
            ) from error


def summary_of(entry: RecordingEntry, look: str = "") -> RecordingSummary:
    """The summary of a recording.

    Args:
        entry: Its entry.
        look: State of its directory; empty if that does not matter.
    """
    losses, gone = entry.end.get("losses", ()), expired_messages(entry)
    return RecordingSummary(
        id=entry.id,
        label=entry.label,
        name=entry.name,
        tags=entry.tags,
        source=entry.source,
        created=entry.created,
        status=entry.status,
        span=entry.span,
        extent=extent_of(entry),
        topics=hash_of(topics_to_json(topic_types(entry))),
        topic_count=len({channel.topic for channel in entry.channels}),
        messages=entry.messages,
        stored_bytes=entry.stored_bytes,
        segments=entry.segments,
        has_losses=bool(losses),
        has_lost_segments=any(row["cause"] == Cause.SEGMENT for row in losses),
        expired=gone.get(State.EXPIRED, 0),
        not_copied=gone.get(State.NOT_COPIED, 0),
        notes=entry.notes,
        content=content_of(entry),
        look=look,
    )


def topic_types(entry: RecordingEntry) -> set[TopicType]:
    """Topics of a recording and their types; includes those that have lost all messages."""
    found = {TopicType(c.topic, c.message_encoding, c.schema or "") for c in entry.channels}
    lost = topics_of(entry) - {topic.topic for topic in found}
    return found | {TopicType(topic, "", "") for topic in lost}


def _base(inventory: Inventory) -> RecordingEntry:
    state = inventory.state
    said: dict[str, Any]
    if state is not None and state.begun:
        said = {**state.begun, "name": state.name, "tags": state.tags}
    elif inventory.summaries:
        said = dict(inventory.summaries[min(inventory.summaries)].recording)
    else:
        raise SegmentError(
            f"Recording {inventory.label!r} has neither a journal nor a segment that can be read."
        )
    try:
        said = journal.description_of(said)
    except (KeyError, TypeError, ValueError) as error:
        raise SegmentError(
            f"The description of recording {inventory.label!r} is damaged: {error!r}"
        ) from error
    entry = RecordingEntry(label=inventory.label, status="open", **said)
    entry.source = {"path": "", "kind": "", "bytes": 0, **entry.source}
    if state is not None:
        entry.name = state.name or entry.name  # also where only the first line is lost
        entry.tags |= state.tags
        entry.notes = list(state.notes)
        entry.marks = list(state.marks)
        entry.pins = list(state.pins.values())
    entry.payloads = [asdict(file) for file in inventory.payloads.values()]
    return entry


def _status(
    inventory: Inventory, end: Mapping[str, Any] | None, *, is_open: bool, has_losses: bool
) -> str:
    # The holder of an ended recording does not record it.
    if is_open and (end is None or inventory.listing.open):
        return "open"
    if inventory.listing.open:
        return "unfinished"
    if has_losses:
        return "damaged"
    if not inventory.is_proven:
        return "unproven"
    return str(end.get("status", "complete")) if end is not None else "recovered"


def _losses_of_segment(inventory: Inventory, sealed: SealedSegment) -> list[dict[str, Any]]:
    """Rows of the loss ledger for a listed segment that is not readable."""
    reasons = [m.reason for m in inventory.misfits if m.segment == sealed.segment]
    reason = "; ".join(reasons) or "it cannot be read"
    lost = [channel for channel in sealed.channels if channel["messages"]]
    nothing = {"messages": 0, "topic": None, "first": None, "last": None}
    return [_loss(sealed.file, reason, c, length=sealed.bytes) for c in lost or [nothing]]


def _losses_of_crash(inventory: Inventory) -> list[dict[str, Any]]:
    """Rows for listed content that was lost in a crash."""
    rows = []
    for before, after in inventory.state.replaced if inventory.state is not None else ():
        left = {channel["id"]: channel["messages"] for channel in after.channels}
        for channel in before.channels:
            count = channel["messages"] - left.get(channel["id"], 0)
            if count > 0:
                reason = "a crash took what was written last"
                rows.append(_loss(before.file, reason, {**channel, "messages": count}))
    return rows


def _losses_of_fields(inventory: Inventory) -> list[dict[str, Any]]:
    """Rows for missing or changed files of fields of expired messages."""
    rows = []
    for file in inventory.payloads.values():
        size = inventory.listing.payloads.get(file.file)
        if size == file.bytes or (size is None and PAYLOAD_PARTS in inventory.listing.others):
            continue  # or it is about to get its name
        spans = [span for s in inventory.summaries.values() if (span := _span_of(s, file))]
        if spans:
            problem = "is missing" if size is None else "has another size"
            lost = {
                "topic": file.topic,
                "messages": file.messages,
                "first": min(first for first, _ in spans),
                "last": max(last for _, last in spans),
            }
            name = f"{PAYLOADS}/{file.file}"
            rows.append(_loss(name, f"a file of fields {problem}", lost, length=file.bytes))
    return rows


def _span_of(summary: SegmentSummary, file: PayloadFile) -> tuple[int, int] | None:
    """First and last log time of messages that need a file: expired ones of its topic."""
    table = summary.table
    needs_file = np.repeat(table.is_expired, table.chunks["parts"])
    channels = [n for n, channel in summary.channels.items() if channel.topic == file.topic]
    parts = table.parts[needs_file & np.isin(table.parts["channel"], channels)]
    return (int(parts["first"].min()), int(parts["last"].max())) if len(parts) else None


def _losses_of_chunks(
    inventory: Inventory, damage: Mapping[tuple[int, int], str]
) -> list[dict[str, Any]]:
    """Rows for unreadable chunks."""
    rows = []
    for (segment, number), reason in sorted(damage.items()):
        summary = inventory.summaries.get(segment)
        if summary is None or number >= len(summary.table.chunks):
            continue
        chunk = summary.table.chunks[number]
        bounds = summary.table.part_bounds()
        for part in summary.table.parts[bounds[number] : bounds[number + 1]]:
            channel = summary.channels.get(int(part["channel"]))
            lost = {
                "topic": channel.topic if channel is not None else None,
                **{name: int(part[name]) for name in ("messages", "first", "last")},
            }
            place = {"offset": int(chunk["offset"]), "length": int(chunk["length"])}
            rows.append(_loss(inventory.listing.sealed[segment], reason, lost, **place))
    return rows


def _loss(
    file: str,
    reason: str,
    channel: Mapping[str, Any],
    *,
    offset: int | None = None,
    length: int | None = None,
) -> dict[str, Any]:
    """A row of the loss ledger for messages of a channel that were stored in a file."""
    return {
        "cause": Cause.SEGMENT.value,
        "file": file,
        "offset": offset,
        "length": length,
        "reason": reason,
        "count": channel["messages"],
        "topic": channel["topic"],
        "from": channel["first"],
        "to": channel["last"],
    }


def _fill_stats(entry: RecordingEntry, inventory: Inventory, catalog: Catalog) -> None:
    silent = {c.id for c in entry.channels if not c.has_publish_time}
    totals: dict[int, ChannelStats] = {}
    entry.is_decoded = True
    for number, summary in inventory.summaries.items():
        found = catalog.stamps(entry, number, summary.table)
        entry.is_decoded &= found is not None or not len(summary.table.chunks)
        for channel_id, stats in channel_totals(summary.table, found, silent).items():
            totals.setdefault(channel_id, ChannelStats()).add(stats)
    for channel in entry.channels:
        channel.stats = totals.get(channel.id, ChannelStats())


def channels_of(summaries: Iterable[SegmentSummary]) -> dict[int, Channel]:
    """All channels of a recording, by id."""
    channels: dict[int, Channel] = {}
    for summary in summaries:
        channels.update(summary.channels)
    return channels


def journal_from_segments(inventory: Inventory, store_id: str, reason: str) -> list[journal.Event]:
    """The lines of a journal rebuilt from the files.

    It has the whole lines of the old one, and lists missing segments.

    Raises:
        SegmentError: Neither journal nor segments say what recording it is.
    """
    entry = _base(inventory)
    state = inventory.state
    lines: list[journal.Event] = [
        journal.event(journal.BEGUN, store=store_id, **_begun(entry, state)),
        journal.event(journal.REBUILT, reason=reason),
    ]
    listed = dict(state.sealed) if state is not None else {}
    for number in sorted(listed.keys() | inventory.summaries.keys()):
        sealed = listed.get(number)
        if sealed is not None:
            before = [old for old, _ in state.replaced if old.segment == number] if state else []
            lines += map(sealed_event, [*before, sealed])
        else:
            lines.append(sealed_line(inventory, number))
    if state is not None:
        lines += [
            journal.event(journal.NOTED, text=n["text"]) | {"at": n["at"]} for n in state.notes
        ]
        lines += [journal.event(journal.MARKED, **mark) for mark in state.marks]
        lines += [journal.event(journal.PINNED, **pin) for pin in state.pins.values()]
    lines += _expired_lines(inventory)
    if inventory.end is not None:
        lines.append(journal.event(journal.ENDED, end=dict(inventory.end)))
    return lines


def unlisted_lines(inventory: Inventory) -> list[journal.Event]:
    """The lines about valid segments, and the fields that they need, that a journal lacks."""
    unlisted = {misfit.segment: misfit.file for misfit in inventory.misfits if misfit.is_unlisted}
    state = inventory.state
    if state is None or not unlisted:
        return []
    # It may have listed other segments that are gone; this cannot be excluded.
    reason = f"it did not list {', '.join(unlisted.values())}"
    new = [sealed_line(inventory, number) for number in unlisted if number not in state.sealed]
    return [journal.event(journal.REBUILT, reason=reason), *new, *_expired_lines(inventory)]


def _expired_lines(inventory: Inventory) -> list[journal.Event]:
    def topics(number: int) -> list[str]:
        summary = inventory.summaries[number]
        return summary.topics_in(one for one in summary.chunks if one.is_expired)

    replaced = inventory.replaced
    files = [asdict(file) for file in (*replaced.values(), *inventory.payloads.values())]
    segments = [
        {"segment": number, "digest": digest, "bytes": size, "topics": topics(number)}
        for number, (digest, size) in inventory.stored.items()
    ]
    lines: list[journal.Event] = []
    if files:
        lines.append(journal.event(journal.EXPIRED, files=files, segments=segments))
    if replaced:
        lines.append(journal.event(journal.EXPIRED, deleted=[*replaced]))
    return lines


def _begun(entry: RecordingEntry, state: JournalState | None) -> dict[str, Any]:
    origin = state.begun.get("origin", {}) if state is not None else {}
    return {**recording_metadata(entry), "origin": origin}


def sealed_line(inventory: Inventory, number: int) -> journal.Event:
    """The journal line for an existing segment."""
    summary = inventory.summaries[number]
    channels = sealed_channels(summary.table.as_stored(), summary.channels)
    file = inventory.listing.sealed[number]
    size = summary.size
    if number in inventory.stored and summary.compacted is not None:
        size = summary.compacted.get("bytes", size)
    return sealed_event(Sealed(number, file, size, summary.digest, channels))


def sealed_event(sealed: Sealed | SealedSegment) -> journal.Event:
    """The journal line for a segment; one that was listed has the time of that."""
    line = journal.event(
        journal.SEALED,
        segment=sealed.segment,
        file=sealed.file,
        bytes=sealed.bytes,
        digest=sealed.digest,
        channels=[dict(c) if isinstance(c, Mapping) else asdict(c) for c in sealed.channels],
    )
    written = sealed.at if isinstance(sealed, journal.SealedSegment) else 0
    return {**line, "at": written} if written else line


def announce_removal(directory: StoreDirectory, label: str) -> None:
    """Announce the removal of a recording in its journal.

    On a full disk the line may not fit; then the directory's hidden name announces it.
    """
    path = directory.recording(label)
    if directory.listing(label).journal:
        with suppress(DiskFullError):
            Journal(path).append(journal.event(journal.REMOVING, by=os.getpid()))


def text(name: str) -> str:
    """A name as valid text for MongoDB and JSON, with escapes for invalid UTF-8."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")
