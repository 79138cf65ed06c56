"""Makes entries of recordings of their manifests, and compares their files with these.

An entry needs no file but the manifest: only names and sizes of the others are looked at. What is
missing, or was found to be unreadable, becomes rows of the loss ledger. Summaries of files are read
of those that no manifest lists.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from msgspec import UNSET, ValidationError, convert, structs, to_builtins

from hybridlog.record.losses import Cause, joined
from hybridlog.record.marks import with_marks
from hybridlog.schema.states import State, expired_messages
from hybridlog_storage import manifest as truth
from hybridlog_storage.catalog import (
    WHOLE,
    Catalog,
    ChannelEntry,
    ChannelStats,
    Damage,
    RecordingEntry,
    RecordingSummary,
    TopicType,
    file_of,
    hash_of,
    is_of,
    topics_to_json,
)
from hybridlog_storage.errors import (
    ManifestError,
    SegmentError,
    StoreError,
)
from hybridlog_storage.manifest import (
    File,
    Manifest,
    free_name,
)
from hybridlog_storage.messages import (
    EXPIRED,
    EXPIRED_IDS,
    NOT_COPIED,
    ORIGINAL_ENCODING,
    REDUCED,
    Schema,
    schema_hash,
)
from hybridlog_storage.segments.segment_file import Sealed, is_rows
from hybridlog_storage.segments.segment_format import group_of
from hybridlog_storage.segments.segment_reader import GoneLog, SegmentSummary, open_log

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog_storage.disk.directory import Listing, StoreDirectory


NO_MANIFEST: Final = (
    "{} has no manifest: `hybridlog verify --repair` makes it again from `manifest.old` and the "
    "segments. If the folder was renamed, give it its name again; remove it if it is a copy."
)
_ANOTHER: Final = "it is another file than the one listed"
_TRIES = 10  # to read a recording while its files are replaced
_GONE: Final = {"expired": (EXPIRED_IDS, EXPIRED), "elsewhere": (2 * EXPIRED_IDS, NOT_COPIED)}
"""Added to the channel ids of a file that is gone, and the encoding that these channels get."""
_SOURCE: Final = {"path": "", "kind": "", "profile": "", "bytes": 0}
_SAID: Final = ("id", "name", "tags", "source", "created")


def recording_metadata(manifest: Manifest) -> dict[str, object]:
    """The metadata of a recording in each of its segments."""
    return {name: to_builtins(getattr(manifest, name)) for name in _SAID}


def segments_in(
    directory: StoreDirectory, recording: str, listing: Listing, but: Collection[int] = ()
) -> dict[int, SegmentSummary]:
    """Summaries of a recording's valid segments by number, without some numbers."""
    path, found = directory.recording(recording), dict[int, SegmentSummary]()
    for number, name in listing.sealed.items():
        if number not in but:
            with suppress(SegmentError):
                summary = read_summary(path / name, number)
                if is_of(summary, recording, None, {}, number):
                    found[number] = summary
    return found


def read_summary(path: Path, number: int) -> SegmentSummary:
    """The summary of a sealed segment."""
    with open_log(path, number) as reader:
        return reader.summary()


class Seen(NamedTuple):
    """A recording as its manifest and its files are now.

    `look` is as of `StoreDirectory.looks`. It is empty if a recorder or a change that was
    interrupted has left something (`has_left`), so that each process sees that.
    """

    entry: RecordingEntry
    look: str
    has_left: bool


def see(
    directory: StoreDirectory, recording: str, damage: Damage, catalog: Catalog | None = None
) -> Seen:
    """A recording by its manifest, and by the names and sizes of its files.

    Of segments with damage, the summaries are read. Without a catalog, nothing is known of
    decoding. Files come and go before or after the manifest says so: what seems to be missing is
    looked for until nothing has changed between; edits alone are waited for by nobody.
    """
    before: object = None
    for _ in range(_TRIES):
        listing, known = directory.listing(recording), directory.manifests.find(recording)
        if known is None:
            raise ManifestError(NO_MANIFEST.format(recording))
        manifest, new = known, listing.sealed.keys() - known.logs.keys()
        if any(not known.has_let_go(number) for number in new):
            manifest = unlisted(directory, recording, listing, known)(known)
        logs, lost = _logs(directory.recording(recording), manifest, listing, damage)
        goes_on = not manifest.is_ended or bool(listing.open)
        is_open = goes_on and directory.is_recorded(recording)
        now = listing.sizes, listing.open, known.files, known.status
        if (not lost and goes_on == is_open) or now == before:
            digests = {number: log.digest for number, log in logs.items()}
            decoded = {} if catalog is None else catalog.decoded(recording, digests)
            status = _status(manifest, lost, is_open=is_open, is_left=bool(listing.open))
            has_left = not is_open and bool(goes_on or new or listing.left_over(known))
            entry = entry_of(manifest, status, logs, lost, decoded)
            return Seen(entry, "" if has_left else listing.look, has_left)
        before = now
    raise StoreError(f"The files of recording {recording!r} change while they are read. Ask again.")


def put_entry(directory: StoreDirectory, catalog: Catalog, recording: str) -> RecordingEntry:
    """The entry of a recording as its files are now; the catalog gets its summary."""
    seen = see(directory, recording, catalog.damage(recording), catalog)
    catalog.put([summary_by(seen)])
    return seen.entry


def summary_by(seen: Seen) -> tuple[RecordingSummary, frozenset[TopicType]]:
    """The summary of a recording with its marks, and its topics."""
    shown = with_marks(seen.entry)
    return summary_of(shown, seen.look), topic_types(shown)


def _logs(
    path: Path, manifest: Manifest, listing: Listing, damage: Damage
) -> tuple[dict[int, File], list[truth.Loss]]:
    """The segments that can be read, by number, and rows of the ledger for what is lost."""
    found, lost = dict[int, File](), list[truth.Loss]()
    rows, suspects = manifest.rows, {number for number, _ in damage}
    for number, log in sorted(manifest.logs.items()):
        files = [log] if log.is_here else rows[number]
        reason = "; ".join(
            f"{one.name} {'has another size' if one.name in listing.sizes else 'is missing'}"
            for one in files
            if listing.sizes.get(one.name) != one.bytes
        )
        if not reason and number in suspects:
            reason, own = _losses_of_chunks(path / files[0].name, manifest, log, damage)
            lost += own
        if not reason:
            found[number] = log
        elif number not in listing.open:  # it is about to get its name
            lost += [row for file in files for row in _losses_of_file(manifest, file, reason)]
    return found, lost


def entry_of(
    manifest: Manifest,
    status: str,
    logs: Mapping[int, File],
    lost: Sequence[truth.Loss],
    decoded: Mapping[int, Mapping[int, ChannelStats]],
) -> RecordingEntry:
    """The entry of a recording by its manifest.

    `logs` are those that can be read, with the results of decoding, by number; `lost` are rows of
    the ledger for the others.
    """
    rows = manifest.rows
    files = [*chain(*rows.values()), *(log for log in logs.values() if log.is_here)]
    noted = chain(manifest.losses, *(log.losses for log in logs.values()))
    return RecordingEntry(
        manifest,
        status,
        losses=[*joined([*map(loss_values, noted)]), *map(loss_values, lost)],
        channels=_channels(manifest, logs, decoded),
        stored_bytes=sum(file.bytes for file in files),
        segments=len(logs),
        chunks=sum(log.chunks for log in logs.values()),
        attachments=sum(log.attachments for log in logs.values()),
        metadata_records=sum(log.metadata for log in logs.values()),
        spans=[
            (number, log.first, log.last)
            for number, log in logs.items()
            if log.first is not None and log.last is not None
        ],
        logs=dict(logs),
        digests={str(number): log.digest for number, log in logs.items()},
        files={str(number): rows[number][0].name for number in logs if not logs[number].is_here},
        is_decoded=all(number in decoded or not log.parts for number, log in logs.items()),
    )


def _channels(
    manifest: Manifest,
    logs: Mapping[int, File],
    decoded: Mapping[int, Mapping[int, ChannelStats]],
) -> list[ChannelEntry]:
    """The channels with messages in some logs, and those that never had any, by id."""
    found: dict[int, ChannelEntry] = {}
    for number, channel in manifest.channels.items():
        if not channel.messages and manifest.let_go is None:
            found[number] = _channel(number, channel)
    for number, log in logs.items():
        added, encoding = (0, "") if log.is_here else _GONE[str(log.gone)]
        known = decoded.get(number, {})
        for own, part in log.parts.items():
            channel = manifest.channels[own]
            if own not in found:
                found[own] = _channel(own, channel)
            if own + added not in found:
                found[own + added] = _channel(own + added, channel, encoding)
            entry, stats = found[own + added], ChannelStats(part.messages, part.bytes)
            stats.first, stats.last = part.first, part.last
            if own in known:
                stats.add(known[own])
            if entry.stats.messages:
                stats.add(entry.stats)
            entry.stats = stats
    return [found[number] for number in sorted(found)]


def _channel(number: int, channel: truth.Channel, gone: str = "") -> ChannelEntry:
    metadata, encoding = dict(channel.metadata), channel.encoding
    if gone and encoding != REDUCED:  # which had no payloads before
        metadata[ORIGINAL_ENCODING], encoding = encoding, gone
    return ChannelEntry(
        number,
        channel.topic,
        encoding,
        channel.schema or None,
        channel.type,
        metadata,
        channel.has_publish_time,
        is_indexed=channel.is_indexed,
    )


def schemas_in(
    directory: StoreDirectory, entry: RecordingEntry, channels: Sequence[ChannelEntry]
) -> dict[str, Schema]:
    """Definitions of some channels of a recording by hash, from the segments that can be read."""
    found: dict[str, Schema] = {}
    wanted = {channel.schema for channel in channels} - {None}
    ids = {channel.id % EXPIRED_IDS for channel in channels}
    # Those with messages of them first: a question reads the files of its topics alone.
    for number in sorted(entry.logs, key=lambda number: ids.isdisjoint(entry.logs[number].parts)):
        if wanted <= found.keys():
            break
        with suppress(SegmentError):
            path = directory.recording(entry.id) / file_of(entry, number)
            own = (channel.schema for channel in read_summary(path, number).channels.values())
            found |= {schema_hash(schema): schema for schema in own if schema is not None}
    return found


@lru_cache(maxsize=1024)
def _hash_of(topics: frozenset[TopicType]) -> str:
    return hash_of(topics_to_json(topics))


def summary_of(entry: RecordingEntry, look: str = "") -> RecordingSummary:
    """The summary of a recording; `look` is as of `StoreDirectory.looks`."""
    gone, source = expired_messages(entry), entry.manifest.source
    parts = {"parts": [*source.parts]} if source.parts else {}
    return RecordingSummary(
        id=entry.id,
        name=entry.name,
        tags=entry.tags,
        source={**_SOURCE, **to_builtins(source), **parts},
        created=entry.created,
        status=entry.status,
        span=entry.span,
        extent=entry.extent,
        topics=_hash_of(topic_types(entry)),
        topic_count=len({channel.topic for channel in entry.channels}),
        messages=entry.messages,
        stored_bytes=entry.stored_bytes,
        segments=entry.segments,
        has_losses=bool(entry.losses),
        has_lost_segments=any(row["cause"] == Cause.SEGMENT for row in entry.losses),
        expired=gone.get(State.EXPIRED, 0),
        not_copied=gone.get(State.NOT_COPIED, 0),
        notes=[*map(structs.asdict, entry.manifest.notes)],
        look=look,
    )


def topic_types(entry: RecordingEntry) -> frozenset[TopicType]:
    """Topics of a recording and their types; includes those that have lost all messages."""
    found = {TopicType(c.topic, c.message_encoding, c.schema or "", c.type) for c in entry.channels}
    lost = entry.topics - {topic.topic for topic in found}
    return frozenset(found | {TopicType(topic, "", "", "") for topic in lost})


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


def loss_values(loss: truth.Loss) -> dict[str, Any]:
    """A row of the loss ledger as entries and segments have it."""
    values = structs.asdict(loss)
    span = {"from": values.pop("first"), "to": values.pop("last"), "topic": loss.topic or None}
    return dict(sorted({**values, **span}.items()))


def _status(manifest: Manifest, lost: Sequence[truth.Loss], *, is_open: bool, is_left: bool) -> str:
    """The status of a recording; `is_left` says that it has segments that are not sealed."""
    if is_open:
        return "open"
    if is_left:
        return "unfinished"
    if lost or any(row.cause == Cause.SEGMENT for row in manifest.losses):
        return "damaged"
    return manifest.status if manifest.is_ended else "recovered"


def _losses_of_file(manifest: Manifest, file: File, reason: str) -> list[truth.Loss]:
    """Rows of the loss ledger for a listed file that cannot be read."""
    cause = Cause.SEGMENT.value
    unknown = truth.Loss(cause, count=0, reason=reason, file=file.name, length=file.bytes)
    rows = [
        truth.replace(
            unknown,
            topic=manifest.channels[number].topic,
            count=part.messages,
            first=part.first,
            last=part.last,
        )
        for number, part in file.parts.items()
        if part.messages
    ]
    return rows or [unknown]


def _losses_of_chunks(
    path: Path, manifest: Manifest, log: File, damage: Damage
) -> tuple[str, list[truth.Loss]]:
    """Why a segment with damage cannot be read at all, if so, and rows for unreadable chunks."""
    try:
        summary = read_summary(path, log.number)
    except SegmentError as error:
        return str(error), []
    channels = {n: (one.topic, one.schema or None) for n, one in manifest.channels.items()}
    if not is_of(summary, manifest.id, log, channels, log.number):
        return _ANOTHER, []
    table = summary.table
    chunks = {
        number: reason
        for (segment, number), reason in sorted(damage.items())
        if segment == log.number and WHOLE < number < len(table.chunks)
    }
    return "", [
        truth.Loss(
            Cause.SEGMENT.value,
            summary.channels[int(part["channel"])].topic,
            int(part["messages"]),
            int(part["first"]),
            int(part["last"]),
            reason,
            path.name,
            int(table.chunks[number]["offset"]),
            int(table.chunks[number]["length"]),
        )
        for number, reason in chunks.items()
        for part in table.chunk_parts(number)
    ]


def with_segments(*segments: Sealed) -> Callable[[Manifest], Manifest]:
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


def unlisted(
    directory: StoreDirectory, recording: str, listing: Listing, manifest: Manifest
) -> Callable[[Manifest], Manifest]:
    """The change that lists valid segments which the manifest lacks, and what they need."""
    listing = listing.choosing(manifest)
    known = [n for n in listing.sealed if n in manifest.logs or manifest.has_let_go(n)]
    numbers = segments_in(directory, recording, listing, known)
    return _listing_of(directory.recording(recording), listing, numbers)


def made_again(
    directory: StoreDirectory, recording: str, listing: Listing, old: Manifest | None
) -> Manifest:
    """The manifest of a recording that has lost it, from its files and an `old` one, if any."""
    listing = listing.choosing(None)
    summaries = segments_in(directory, recording, listing)
    made = old or _described(recording, summaries.values())
    numbers = [
        number
        for number in summaries
        if number not in made.logs or made.logs[number].is_here == is_rows(listing.sealed[number])
    ]
    made = _listing_of(directory.recording(recording), listing, numbers)(made)
    return truth.replace(made, status="unproven", changes=made.changes + 1)


def _described(recording: str, summaries: Iterable[SegmentSummary]) -> Manifest:
    """A manifest made of what the segments of a recording say about it; it lists no files yet."""
    for summary in summaries:
        known = {name: summary.recording.get(name) for name in _SAID}
        with suppress(ValidationError):
            return convert(known, Manifest)
    raise SegmentError(
        f"Recording {recording!r} has neither a manifest nor a segment that can be read."
    )


def _listing_of(
    path: Path, listing: Listing, numbers: Iterable[int]
) -> Callable[[Manifest], Manifest]:
    found = [_lines_of(path, listing, number) for number in numbers]

    def how(now: Manifest) -> Manifest:
        for sealed, log, rows in found:
            if sealed.file.number not in now.logs:
                now = with_segments(sealed)(now)
            line = log or truth.replace(now.logs[sealed.file.number], gone=UNSET, copy="")
            now = truth.with_rows(now, line, rows)
        return now

    return how


def _lines_of(
    path: Path, listing: Listing, number: int
) -> tuple[Sealed, File | None, Sequence[File]]:
    """An existing segment as a manifest lists it; if it is gone, its line and those of its rows."""
    name = listing.sealed[number]
    with open_log(path / name, number) as reader:
        summary = reader.summary()
        sealed = Sealed.of(
            (number, group_of(summary.recording, number)),
            (summary.size, reader.digest()),
            summary.table.as_stored(),
            summary.channels,
            extras=(len(summary.attachments), len(summary.metadata)),
            losses=summary.losses,
        )
        if not isinstance(reader, GoneLog):
            return sealed, None, ()
        log = reader.log
    from hybridlog.columns.rows import line_of

    others = sorted(n for n in listing.rows if int(n[:6]) == number and n != name)
    return sealed, log, [line_of(path, log, one) for one in (name, *others)]


def free_name_in(others: Iterable[RecordingSummary | Manifest], name: str, but: str = "") -> str:
    """A name that no recording of a store has, but for one, by its id; within `creating`."""
    return free_name(text(name), {one.name for one in others if one.id != but})


def text(name: str) -> str:
    """A name as valid text for MongoDB and JSON, with escapes for invalid UTF-8."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")
