"""Makes catalog entries of recordings from their manifests and segments, and puts them there.

Recording, recovery and opening use the same functions, so their entries are equal. Summaries of
whole recordings are made of manifests alone. Files that
differ from the manifest in size or content are not used; whole files are compared with its
digests by `verify` only. Content that the manifest lists and that is missing or
changed becomes rows of the loss ledger.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from msgspec import UNSET, ValidationError, convert, structs, to_builtins

from hybridlog.record.losses import Cause, extent_of, joined, topics_of
from hybridlog.record.marks import mark_channel
from hybridlog.schema.states import State, expired_messages
from hybridlog_storage import manifest as truth
from hybridlog_storage.catalog import (
    ChannelStats,
    Described,
    RecordingEntry,
    channel_entry,
    channel_totals,
    spans_of,
)
from hybridlog_storage.errors import (
    ManifestError,
    SegmentError,
    StoreError,
)
from hybridlog_storage.manifest import (
    File,
    Manifest,
    Source,
    free_name,
)
from hybridlog_storage.messages import EXPIRED, NOT_COPIED, REDUCED, Channel, schema_hash
from hybridlog_storage.segments.gone_log import GoneLog, open_log
from hybridlog_storage.segments.segment_file import (
    Sealed,
    is_rows,
    listed_parts,
    sealed_name,
)
from hybridlog_storage.segments.segment_format import group_of
from hybridlog_storage.segments.segment_reader import SegmentSummary
from hybridlog_storage.summary import RecordingSummary, TopicType, hash_of, topics_to_json
from hybridlog_storage.times import span_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from hybridlog_storage.catalog import Catalog
    from hybridlog_storage.disk.directory import Listing, StoreDirectory


NO_MANIFEST: Final = (
    "{} has no manifest: `hybridlog verify --repair` makes it again from `manifest.old` and the "
    "segments."
)
_TRIES = 10  # to read a recording while its files are replaced
_ENCODINGS: Final = {"expired": EXPIRED, "elsewhere": NOT_COPIED}
"""Of the messages of a log that is gone."""


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
    """A file of a recording that differs from the manifest.

    Attributes:
        segment: Number in the file's name.
        file: Its name; empty for one that is missing.
        is_unlisted: Whether it is a whole segment of this recording that the manifest lacks.
    """

    segment: int
    file: str
    reason: str
    is_unlisted: bool = False


@dataclass(slots=True)
class Inventory:
    """Content of a recording's directory, compared with its manifest.

    Attributes:
        id: Id of the recording, which is the name of its directory.
        listing: Names of its files; of several segments of one number, the listed one.
        summaries: Summaries of valid segments, by number.
        misfits: Files that differ from the manifest.
        lost: Listed segments that are missing or changed; of those that are gone, files of rows of
            which nothing is believed.
    """

    id: str
    path: Path
    listing: Listing
    manifest: Manifest | None
    summaries: dict[int, SegmentSummary] = field(default_factory=dict)
    misfits: list[Misfit] = field(default_factory=list)
    lost: list[File] = field(default_factory=list)

    @property
    def name(self) -> str:
        """The recording's name, or its folder's while that is unknown."""
        if self.manifest is not None:
            return self.manifest.name
        names = (str(summary.recording.get("name", "")) for summary in self.summaries.values())
        return next(filter(None, names), self.id)

    @property
    def rows(self) -> list[File]:
        """The files of rows that the manifest lists."""
        files = () if self.manifest is None else self.manifest.files
        return [file for file in files if file.kind == "rows"]

    @property
    def logs(self) -> Mapping[int, File]:
        """The segments that the manifest lists, by number."""
        return {} if self.manifest is None else self.manifest.logs

    def digest(self, number: int) -> str:
        """Digest of a valid segment; one that is not listed is read for it."""
        if number in self.logs:
            return self.logs[number].digest
        with open_log(self.path / self.listing.sealed[number], number) as reader:
            return reader.digest()

    @property
    def state(self) -> str:
        """A value that changes with its files, and with what the manifest says of them."""
        return state_of(self.listing, self.manifest)

    @property
    def is_proven(self) -> bool:
        """True if the manifest was never lost, and all segments that it lists are valid."""
        return self.manifest is not None and self.manifest.status != "unproven" and not self.lost


def state_of(listing: Listing, manifest: Manifest | None) -> str:
    """The state of a recording's files, as of `Inventory`, by its directory and its manifest."""
    return listing.print if manifest is None else truth.state_of(manifest, listing.print)


def take_inventory(directory: StoreDirectory, recording: str) -> Inventory:
    """Compare the sealed segments of a recording with its manifest."""
    listing = directory.listing(recording)
    return inventory_of(directory, recording, listing, directory.manifests.find(recording))


def inventory_of(
    directory: StoreDirectory, recording: str, listing: Listing, manifest: Manifest | None
) -> Inventory:
    """Compare the sealed segments of a recording with a manifest; None for a lost one."""
    path = directory.recording(recording)
    listed = manifest.logs if manifest is not None else {}
    listing = listing.choosing(manifest)
    found = Inventory(recording, path, listing, manifest)
    others = set[str]()
    for number, name in listing.sealed.items():
        if manifest is not None and manifest.has_let_go(number):
            continue
        try:
            summary = read_summary(path / name, number)
        except SegmentError as error:
            found.misfits.append(Misfit(number, name, str(error)))
            continue
        if not _is_listed(summary, recording, number, listed.get(number)):
            others.add(str(summary.recording.get("id")))
            found.misfits.append(Misfit(number, name, "it is another file than the one listed"))
            continue
        found.summaries[number] = summary
        if manifest is not None and number not in listed:
            reason = "the manifest does not list it"
            found.misfits.append(Misfit(number, name, reason, is_unlisted=True))
    if manifest is None and others and not found.summaries:
        raise StoreError(
            f"{path} has files of {', '.join(sorted(others))}: give the folder this name again, "
            "or remove it if it is a copy."
        )
    rows = {} if manifest is None else manifest.rows
    for number, file in listed.items():
        own: Sequence[File] = rows.get(number, ())
        if not file.is_here and number in found.summaries and not listing.has_all(own):
            del found.summaries[number]
            found.misfits += [
                Misfit(number, row.name, f"{row.name} {problem}")
                for row in own
                if (problem := _problem(listing.rows.get(row.name), row.bytes))
            ]
            found.lost += own
        elif number not in found.summaries and number not in listing.open:
            lost = [file] if file.is_here else own
            found.lost += lost
            if number not in listing.sealed:
                name = "" if file.is_here else lost[0].name
                found.misfits.append(Misfit(number, name, f"{lost[0].name} is missing"))
    found.misfits.sort(key=lambda misfit: misfit.segment)
    return found


def _problem(size: int | None, wanted: int) -> str:
    """The problem of a file of a size, None for a missing one; empty if there is none."""
    return "" if size == wanted else "is missing" if size is None else "has another size"


def steady_inventory(directory: StoreDirectory, recording: str) -> Inventory:
    """The inventory of a recording that may be changed meanwhile.

    Files come and go before or after the manifest says so. What seems to be missing is looked
    for again if anything has changed; edits alone, however many, are waited for by nobody.
    """
    for _ in range(_TRIES):
        found = take_inventory(directory, recording)
        if not (found.misfits or found.lost):
            return found
        manifest = directory.manifests.find(recording)
        if state_of(directory.listing(recording), manifest) == found.state:
            return found
    raise StoreError(f"The files of recording {recording!r} change while they are read. Ask again.")


def _is_listed(summary: SegmentSummary, recording: str, number: int, log: File | None) -> bool:
    """True for a whole segment of a recording and number that is as the manifest lists it."""
    said = summary.recording.get("id"), summary.recording.get("segment")
    parts = listed_parts(summary.table.as_stored())
    as_listed = log is None or (summary.size, parts) == (log.bytes, log.parts)
    return said == (recording, number) and as_listed


def read_summary(path: Path, number: int) -> SegmentSummary:
    """The summary of a sealed segment."""
    with open_log(path, number) as reader:
        return reader.summary()


def with_marks(entry: RecordingEntry) -> RecordingEntry:
    """The entry of a recording's files, and of the marks that somebody set."""
    if not entry.marks:
        return entry
    from hybridlog.record.marks_log import beside  # loads numpy

    return beside(entry)


def describe(catalog: Catalog, inventory: Inventory, *, is_open: bool = False) -> Described:
    """Make the complete entry of a recording."""
    from hybridlog.schema.codecs import codec_for

    manifest = inventory.manifest
    if manifest is None:
        raise ManifestError(NO_MANIFEST.format(inventory.id))
    entry = _base(inventory, manifest)
    channels = channels_of(inventory.summaries.values())
    lost: list[dict[str, Any]] = []
    entry.stored_bytes = sum(size for _, _, size in entry.rows)
    for number, summary in inventory.summaries.items():
        lost += map(loss_values, summary.losses)
        entry.held[str(number)] = np.unique(summary.table.parts["channel"]).tolist()
        entry.digests[str(number)] = inventory.digest(number)
        entry.spans += spans_of(number, summary.table)
        name = inventory.listing.sealed[number]
        if name == sealed_name(number):
            entry.stored_bytes += summary.size
        else:
            entry.files[str(number)] = name
        entry.chunks += len(summary.table.chunks)
        entry.attachments += len(summary.attachments)
        entry.metadata_records += len(summary.metadata)
    entry.segments = len(inventory.summaries)
    entry.end = end_values(manifest) if manifest.is_ended else {}
    ours = [row for sealed in inventory.lost for row in _losses_of_segment(inventory, sealed)]
    ours += _losses_of_chunks(inventory, catalog.damage(inventory.id))
    if not manifest.is_ended:  # what went to make room
        ours += map(loss_values, manifest.losses)
    has_losses = bool(ours) or any(row.cause == Cause.SEGMENT for row in manifest.losses)
    entry.status = _status(inventory, manifest, is_open=is_open, has_losses=has_losses)
    if lost or ours:
        entry.end["losses"] = joined([*entry.end.get("losses", ()), *lost]) + ours
    entry.channels = [
        channel_entry(channel_id, channel, codec_for(channel).reason)
        for channel_id, channel in sorted(channels.items())
    ]
    _fill_stats(entry, inventory, catalog)
    return described_of(entry, inventory.listing.look, inventory.state, channels)


def described_of(
    entry: RecordingEntry, look: str, files: str, channels: Mapping[int, Channel] | None = None
) -> Described:
    """The rows of a recording in the catalog, with states of its directory and its files.

    The entry has no marks that somebody set; channels are None if the catalog has their
    definitions.
    """
    shown = with_marks(entry)
    return Described(entry, summary_of(shown, look), topic_types(shown), files, channels or {})


def put_entry(
    directory: StoreDirectory, catalog: Catalog, recording: str, *, is_open: bool = False
) -> RecordingEntry:
    """Read a recording's files and update its catalog row."""
    described = describe(catalog, steady_inventory(directory, recording), is_open=is_open)
    catalog.put(described)
    return described.entry


def with_said(entry: RecordingEntry, manifest: Manifest) -> RecordingEntry:
    """The entry with what people say of its recording by a manifest."""
    return replace(entry, name=manifest.name, tags=dict(manifest.tags), **_said(manifest))


def summary_by(
    manifest: Manifest, look: str
) -> tuple[RecordingSummary, frozenset[TopicType]] | None:
    """The summary and the topics of a whole recording by its manifest.

    They are as of `summary_of` and `topic_types`; None if only its files say what is left.
    """
    if not manifest.is_ended:
        return None
    logs = [file for file in manifest.files if file.kind == "log"]
    # Of those whose messages a ring has let go, no file says anything.
    channels = [c for c in manifest.channels.values() if c.messages or manifest.let_go is None]
    times = [time for c in channels for time in (c.first, c.last) if time is not None]
    times += [mark.time for mark in manifest.marks]
    lost = [row for row in manifest.losses if row.cause == Cause.SEGMENT]
    spans = [time for row in lost for time in (row.first, row.last) if time is not None]
    topics = {TopicType(c.topic, c.encoding, c.schema) for c in channels}
    topics |= {_marks_type()} if manifest.marks else set()
    gone = Counter[str]()
    for file in logs:
        if file.gone is UNSET:
            continue
        encoding = _ENCODINGS[file.gone]
        for number, part in file.parts.items():
            of = manifest.channels[number]
            if of.encoding != REDUCED:  # it had no payloads before
                topics.add(TopicType(of.topic, encoding, of.schema))
                gone[encoding] += part.messages
    has_losses = bool(manifest.losses) or any(file.has_losses for file in logs)
    names = {topic.topic for topic in topics}
    topics |= {TopicType(row.topic, "", "") for row in lost if row.topic not in {*names, ""}}
    types = frozenset(topics)
    summary = RecordingSummary(
        id=manifest.id,
        name=manifest.name,
        tags=manifest.tags,
        source=_source_of(manifest.source),
        created=manifest.created,
        status="damaged" if lost else manifest.status,
        span=(min(times), max(times)) if times else None,
        extent=span_of(min(times + spans), max(times + spans)) if times or spans else (0, 0),
        topics=_hash_of(types),
        topic_count=len(names),
        messages=sum(c.messages for c in channels) + len(manifest.marks),
        stored_bytes=sum(file.bytes for file in manifest.files if file.is_here),
        segments=len(logs),
        has_losses=has_losses,
        has_lost_segments=bool(lost),
        expired=gone[EXPIRED],
        not_copied=gone[NOT_COPIED],
        notes=_said(manifest)["notes"],
        look=look,
    )
    return summary, types


@lru_cache(maxsize=1024)
def _hash_of(topics: frozenset[TopicType]) -> str:
    return hash_of(topics_to_json(topics))


@lru_cache(maxsize=1)
def _marks_type() -> TopicType:
    """The topic of marks that somebody set."""
    channel = mark_channel()
    assert channel.schema is not None
    return TopicType(channel.topic, channel.message_encoding, schema_hash(channel.schema))


def summary_of(entry: RecordingEntry, look: str = "") -> RecordingSummary:
    """The summary of a recording."""
    losses, gone = entry.end.get("losses", ()), expired_messages(entry)
    return RecordingSummary(
        id=entry.id,
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
        look=look,
    )


def topic_types(entry: RecordingEntry) -> set[TopicType]:
    """Topics of a recording and their types; includes those that have lost all messages."""
    found = {TopicType(c.topic, c.message_encoding, c.schema or "") for c in entry.channels}
    lost = topics_of(entry) - {topic.topic for topic in found}
    return found | {TopicType(topic, "", "") for topic in lost}


def _base(inventory: Inventory, manifest: Manifest) -> RecordingEntry:
    return RecordingEntry(
        id=manifest.id,
        name=manifest.name,
        tags=dict(manifest.tags),
        source=_source_of(manifest.source),
        created=manifest.created,
        status="open",
        rows=[(file.name, topic_of(file, manifest), file.bytes) for file in inventory.rows],
        copies=sorted({file.copy for file in manifest.files if file.copy}),
        **_said(manifest),
    )


def topic_of(rows: File, manifest: Manifest) -> str:
    """The topic of a file of rows."""
    return manifest.channels[next(iter(rows.parts))].topic


def _said(manifest: Manifest) -> dict[str, Any]:
    marks = [structs.asdict(mark) for mark in manifest.marks]
    return {
        "notes": [structs.asdict(note) for note in manifest.notes],
        "marks": [{k: v for k, v in mark.items() if v is not None} for mark in marks],
        "pins": [pin_values(pin) for pin in manifest.pins],
    }


_SOURCE = {"path": "", "kind": "", "profile": "", "bytes": 0}


def _source_of(source: Source) -> dict[str, Any]:
    """A source as the catalog keeps it, in JSON."""
    said = {**_SOURCE, **to_builtins(source)}
    return {**said, "parts": [*source.parts]} if source.parts else said


def lost_in_crash(manifest: Manifest, after: Sealed) -> list[truth.Loss]:
    """Rows of the loss ledger for content of a listed segment that a crash has taken."""
    before, left = manifest.logs[after.file.number], after.file.parts
    lost = {
        number: part.messages - (left[number].messages if number in left else 0)
        for number, part in before.parts.items()
    }
    return [
        truth.Loss(
            Cause.SEGMENT.value,
            manifest.channels[number].topic,
            count,
            before.parts[number].first,
            before.parts[number].last,
            "a crash took what was written last",
            before.name,
        )
        for number, count in lost.items()
        if count > 0
    ]


def described(inventory: Inventory) -> Manifest:
    """A manifest made of what the segments of a recording say about it; it lists no files yet."""
    for _, summary in sorted(inventory.summaries.items()):
        said = summary.recording
        known = {name: said.get(name) for name in ("id", "name", "tags", "source", "created")}
        with suppress(ValidationError):
            return convert(known, Manifest)
    raise SegmentError(
        f"Recording {inventory.id!r} has neither a manifest nor a segment that can be read."
    )


def end_values(manifest: Manifest) -> dict[str, Any]:
    """The end of a recording as entries have it."""
    values: dict[str, Any] = {
        "status": manifest.status,
        "losses": [loss_values(one) for one in manifest.losses],
    }
    if manifest.status == "recovered":
        values |= {"cut_bytes": manifest.cut_bytes, "damage": [*manifest.damage]}
    return values


def loss_values(loss: truth.Loss) -> dict[str, Any]:
    """A row of the loss ledger as entries and segments have it."""
    values = structs.asdict(loss)
    span = {"from": values.pop("first"), "to": values.pop("last"), "topic": loss.topic or None}
    return dict(sorted({**values, **span}.items()))


def pin_values(pin: truth.Pin) -> dict[str, Any]:
    """A pin as entries have it."""
    topics = None if pin.topics is None else [*pin.topics]
    span = {"from": pin.first, "to": None if pin.last is None else pin.last + 1}
    return {"id": pin.id, **span, "topics": topics, "reason": pin.reason}


def _status(inventory: Inventory, manifest: Manifest, *, is_open: bool, has_losses: bool) -> str:
    # The holder of an ended recording does not record it.
    if is_open and (inventory.listing.open or not manifest.is_ended):
        return "open"
    if inventory.listing.open:
        return "unfinished"
    if has_losses:
        return "damaged"
    if not inventory.is_proven:
        return "unproven"
    return manifest.status if manifest.is_ended else "recovered"


def _losses_of_segment(inventory: Inventory, file: File) -> list[dict[str, Any]]:
    """Rows of the loss ledger for a listed file that is not readable."""
    reasons = [m.reason for m in inventory.misfits if m.segment == file.number]
    reason = "; ".join(reasons) or "it cannot be read"
    channels = inventory.manifest.channels if inventory.manifest is not None else {}
    rows = [
        _loss(file.name, reason, channels[number].topic, part, length=file.bytes)
        for number, part in file.parts.items()
        if part.messages
    ]
    return rows or [_loss(file.name, reason, "", truth.Part(0, 0), length=file.bytes)]


def _losses_of_chunks(
    inventory: Inventory, damage: Mapping[tuple[int, int], str]
) -> list[dict[str, Any]]:
    """Rows for unreadable chunks."""
    rows = []
    for (segment, number), reason in sorted(damage.items()):
        summary = inventory.summaries.get(segment)
        if summary is None or number >= len(summary.table.chunks):
            continue
        chunk, bounds = summary.table.chunks[number], summary.table.part_bounds()
        place = {name: int(chunk[name]) for name in ("offset", "length")}
        for part in summary.table.parts[bounds[number] : bounds[number + 1]]:
            channel = summary.channels.get(int(part["channel"]))
            topic = channel.topic if channel is not None else ""
            lost = truth.Part(int(part["messages"]), 0, int(part["first"]), int(part["last"]))
            rows.append(_loss(inventory.listing.sealed[segment], reason, topic, lost, **place))
    return rows


def _loss(
    file: str, reason: str, topic: str, lost: truth.Part, *, length: int, offset: int | None = None
) -> dict[str, Any]:
    """A row of the loss ledger for messages that were stored in a file."""
    cause, count = Cause.SEGMENT.value, lost.messages
    return loss_values(
        truth.Loss(cause, topic, count, lost.first, lost.last, reason, file, offset, length)
    )


def _fill_stats(entry: RecordingEntry, inventory: Inventory, catalog: Catalog) -> None:
    silent = {c.id for c in entry.channels if not c.has_publish_time}
    totals: dict[int, ChannelStats] = {}
    entry.is_decoded = True
    for number, summary in inventory.summaries.items():
        decoded = catalog.decoded(entry, number)
        entry.is_decoded &= decoded is not None or not len(summary.table.parts)
        for channel_id, stats in channel_totals(summary.table, decoded, silent).items():
            totals.setdefault(channel_id, ChannelStats()).add(stats)
    for channel in entry.channels:
        channel.stats = totals.get(channel.id, ChannelStats())


def channels_of(summaries: Iterable[SegmentSummary]) -> dict[int, Channel]:
    """All channels of a recording, by id."""
    channels: dict[int, Channel] = {}
    for summary in summaries:
        channels.update(summary.channels)
    return channels


def listed(*segments: Sealed) -> Callable[[Manifest], Manifest]:
    """The change that lists segments, in the place of those of their numbers."""
    files = tuple(sealed.file for sealed in segments)
    numbers = {file.number for file in files}
    channels = {n: one for sealed in segments for n, one in sealed.channels.items()}

    def how(now: Manifest) -> Manifest:
        others = (one for one in now.files if one.kind != "log" or one.number not in numbers)
        known = {**channels, **now.channels}
        return truth.with_totals(truth.replace(now, files=(*others, *files), channels=known))

    return how


def ended(
    status: Literal["complete", "damaged", "recovered"], losses: Sequence[truth.Loss] = ()
) -> Callable[[Manifest], Manifest]:
    """The change that ends a recording."""

    def how(now: Manifest) -> Manifest:
        return truth.replace(
            now,
            status="unproven" if now.status == "unproven" else status,
            losses=(*now.losses, *losses),
        )

    return how


def unlisted(inventory: Inventory) -> Callable[[Manifest], Manifest]:
    """The change that lists valid segments which the manifest lacks, and what they need."""
    return _listing_of(inventory, [one.segment for one in inventory.misfits if one.is_unlisted])


def made_again(inventory: Inventory, old: Manifest | None) -> Manifest:
    """The manifest of a recording that has lost it, from its files and an `old` one, if any."""
    made = old or described(inventory)
    numbers = [
        number
        for number, name in inventory.listing.sealed.items()
        if number in inventory.summaries
        and (number not in made.logs or made.logs[number].is_here == is_rows(name))
    ]
    made = _listing_of(inventory, numbers)(made)
    return truth.replace(made, status="unproven", changes=made.changes + 1)


def _listing_of(inventory: Inventory, numbers: Iterable[int]) -> Callable[[Manifest], Manifest]:
    found = [(sealed_of(inventory, number), *_rows_of(inventory, number)) for number in numbers]

    def how(now: Manifest) -> Manifest:
        for sealed, log, rows in found:
            if sealed.file.number not in now.logs:
                now = listed(sealed)(now)
            line = log or truth.replace(now.logs[sealed.file.number], gone=UNSET, copy="")
            now = truth.with_rows(now, line, rows)
        return now

    return how


def _rows_of(inventory: Inventory, number: int) -> tuple[File | None, Sequence[File]]:
    """The manifest's lines of a log that is gone and of its files of rows, from these files."""
    name = inventory.listing.sealed[number]
    if not is_rows(name):
        return None, ()
    from hybridlog.columns.rows_file import line_of

    with GoneLog(inventory.path / name, number) as reader:
        log = reader.log
    others = sorted(n for n in inventory.listing.rows if int(n[:6]) == number and n != name)
    return log, [line_of(inventory.path, log, one) for one in (name, *others)]


def sealed_of(inventory: Inventory, number: int) -> Sealed:
    """An existing segment, as a manifest lists it."""
    summary = inventory.summaries[number]
    return Sealed.of(
        (number, group_of(summary.recording, number)),
        (summary.size, inventory.digest(number)),
        summary.table.as_stored(),
        summary.channels,
        has_losses=bool(summary.losses),
    )


def free_name_in(others: Iterable[RecordingSummary | Manifest], name: str, but: str = "") -> str:
    """A name that no recording of a store has, but for one, by its id; within `creating`."""
    return free_name(text(name), {one.name for one in others if one.id != but})


def text(name: str) -> str:
    """A name as valid text for MongoDB and JSON, with escapes for invalid UTF-8."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")
