"""`hybridlog info`: recordings and topics, or a segment file."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.binder import command, option
from hybridlog.cli.info_parts import (
    attachment_as_dict,
    show_attachments,
    show_losses,
    show_sizes,
    show_tables,
    show_topics,
)
from hybridlog.cli.keep import pin_cells
from hybridlog.cli.ls import recording_dict, status_text, with_misfits
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    Forced,
    InStore,
    names_argument,
    query_of,
)
from hybridlog.query.answers.completeness import coverage, line_of
from hybridlog.query.choice import Choice
from hybridlog.query.topics import resolve
from hybridlog.record.losses import losses_of
from hybridlog.wording import MAX_LISTED, listed
from hybridlog_storage.errors import SegmentError, SourceError, StoreError, UsageError

if TYPE_CHECKING:
    from hybridlog.attachments import StoredAttachment, StoredMetadata
    from hybridlog.drawing.density import Density
    from hybridlog.query.answers.video import VideoSummary
    from hybridlog.store import Store
    from hybridlog_storage.catalog import ChannelEntry, ChannelStats, RecordingEntry


_MAX_DRAWN = 20  # recordings with sparklines; for more, reading their chunk tables takes long
_DRAWN_TIMES = 1 << 18  # see `density`: little is read for a sparkline
_LETTERS = 40  # of the coverage bar and of the longest sparkline
_OVER_TIME = "over time"


@dataclass(frozen=True, kw_only=True)
class _Given(Choosing, InStore, AsJson, Forced):
    names: tuple[str, ...] = names_argument(  # type: ignore[misc]
        "[RECORDING|SEGMENT]...", "Only a segment file, or these recordings"
    )
    topic: tuple[str, ...] = options.topics(
        "Instead: the message definition and the fields of this topic. With --losses: only those "
        "of this topic."
    )
    tables: bool = option(
        "With --topic, instead: its Parquet files and SQL for DuckDB, and what is missing of them."
    )
    losses: bool = option("Instead: what is missing, from when to when, and why.")
    sizes: str | None = option(
        "Instead: the bytes of each recording, each topic, or each topic of each recording "
        "in segments, tables and MongoDB. Shares of what topics have in common are estimates.",
        type=click.Choice(["recording", "topic", "both"]),
    )
    attachments: bool = option("Instead: the attachments of the logs.")
    attachment: str | None = option(
        "Instead: the content of this attachment, or with -o those that fit a glob such as "
        "'*.yaml'.",
        "NAME",
    )
    output: Path | None = option(
        "Write the attachment to this file; several attachments into this directory.",
        "FILE|DIR",
        short="-o",
    )


@command(_Given)
def info_command(given: _Given) -> None:
    """Show topics, types, rates, sizes, times, clock skew, losses.

    Options show one thing instead: the definition of a topic, losses, sizes, attachments.
    """
    _check(given)
    if len(given.names) == 1 and _is_segment(given.names[0]):
        show_segment(Path(given.names[0]), as_json=given.as_json)
        return
    try:
        with given.opened(snapshot=True) as store:
            if not _show_part(store, given):
                _show(store, given)
    except (StoreError, UsageError):
        # The directory of a ROS 2 bag may be named like its recording.
        if len(given.names) == 1 and Path(given.names[0], "metadata.yaml").exists():
            _refuse_log(Path(given.names[0]))
        raise


def _check(given: _Given) -> None:
    """Refuse options that do not go together."""
    has_attachments = given.attachments or given.attachment is not None
    parts = {
        "--topic": bool(given.topic) and not given.losses,
        "--losses": given.losses,
        "--sizes": given.sizes is not None,
        "--attachments": has_attachments,
    }
    asked = [name for name, wanted in parts.items() if wanted]
    if len(asked) > 1:
        raise UsageError(f"{' and '.join(asked)} exclude each other: give one of them.")
    if given.tables and (len(given.topic) != 1 or given.losses):
        raise UsageError("--tables is about one topic: add --topic TOPIC.")
    if given.output is not None and not has_attachments:
        raise UsageError("--output is for --attachments and --attachment.")


def _show_part(store: Store, given: _Given) -> bool:
    """Show what options ask for instead of everything; returns whether they do."""
    as_json = given.as_json
    if given.losses:
        if given.topic:
            resolve(given.topic, store.topics())  # refuses a name that fits no topic
        show_losses([*given.recordings_in(store)], given.topic, as_json=as_json)
    elif given.topic:
        query = query_of(store, given.topic, given.choice)
        if given.tables:
            if len(query.topics) > 1:
                named = listed(query.topics)
                raise UsageError(f"--tables is about one topic: name one of {named}.")
            show_tables(store, query, as_json=as_json)
            return True
        show_topics(store, query, given.topic, as_json=as_json)
    elif given.sizes is not None:
        sizes = store.sizes(given.recordings_in(store))
        show_sizes(sizes, given.sizes, as_json=as_json, without=store.session.when_empty)
    elif given.attachments or given.attachment is not None:
        found = [one for entry in given.recordings_in(store) for one in store.attachments(entry)]
        show_attachments(found, given.attachment, given.output, force=given.force, as_json=as_json)
    else:
        return False
    return True


def _show(store: Store, given: _Given) -> None:
    from hybridlog.query.choosing import is_one

    choice = given.choice
    chosen = [with_misfits(store, entry) for entry in given.recordings_in(store)]
    extras = {entry.id: _extras(store, entry) for entry in chosen}
    videos = {entry.id: _videos(store, entry) for entry in chosen[:_MAX_DRAWN]}
    if given.as_json:
        full = [_as_dict(entry, *extras[entry.id], videos.get(entry.id, {})) for entry in chosen]
        is_single = choice == Choice.of(choice.name[:1]) and is_one(store.session, choice.name)
        output.print_json(full[0] if is_single else full)
        return
    drawn = {}
    if sys.stdout.isatty() and len(chosen) <= _MAX_DRAWN:
        drawn = {entry.id: _densities(store, entry) for entry in chosen}
    if not chosen:
        output.note(store.session.when_empty)
    for number, entry in enumerate(chosen):
        if number:
            output.say()
        _print_recording(
            entry,
            store.shared.index.connection.place,
            *extras[entry.id],
            videos=videos.get(entry.id, {}),
            drawn=drawn.get(entry.id),
        )


def _extras(
    store: Store, entry: RecordingEntry
) -> tuple[list[StoredAttachment], list[StoredMetadata], str]:
    """Attachments and metadata records of a recording that can be read, and its completeness."""
    attachments: list[StoredAttachment] = []
    metadata: list[StoredMetadata] = []
    try:
        attachments = store.attachments(entry)
        metadata = store.metadata(entry)
    except SegmentError as error:
        output.note(f"{entry.name}: {error}")
    return attachments, metadata, coverage(entry, losses_of(entry))


def _is_segment(what: str) -> bool:
    """True for the path of a file; names and ids of recordings have no slash."""
    looks = "/" in what or what.endswith((".mcap", ".mcap.open", ".bag", ".db3"))
    return looks and Path(what).exists()


def _videos(store: Store, entry: RecordingEntry) -> dict[str, VideoSummary]:
    """Codec and key frames of video topics, by topic; none of those that cannot be read."""
    from hybridlog.arrays import is_video_type

    topics = dict.fromkeys(one.topic for one in entry.channels if is_video_type(one.type))
    if not topics:
        return {}
    from hybridlog.query.answers.video import summary_of

    found: dict[str, VideoSummary] = {}
    for topic in topics:
        try:
            found[topic] = summary_of(store.session, entry.id, topic)
        except SegmentError as error:
            output.note(f"{entry.name}: {error}")
    return found


def _as_dict(
    entry: RecordingEntry,
    attachments: list[StoredAttachment],
    metadata: list[StoredMetadata],
    complete: str,
    videos: Mapping[str, VideoSummary],
) -> dict[str, Any]:
    from hybridlog.entries import summary_of
    from hybridlog.schema.states import shown_channels

    return {
        **recording_dict(summary_of(entry)),
        "chunks": entry.chunks,
        "coverage": complete,
        "losses": losses_of(entry),
        "marks": entry.marks,
        "pins": entry.pins,
        "attachments": [attachment_as_dict(each) for each in attachments],
        "metadata_records": [each._asdict() for each in metadata],
        "channels": [
            {
                "topic": c.topic,
                "type": c.type,
                "message_encoding": c.message_encoding,
                "messages": c.stats.messages,
                "payload_bytes": c.stats.payload_bytes,
                "rate_hz": _rate(c),
                "first_ns": c.stats.first,
                "last_ns": c.stats.last,
                "skew_ns": _skew(c.stats),
                "unset_stamps": c.stats.unset if entry.is_decoded else None,
                "unreadable": c.stats.unreadable if entry.is_decoded else None,
                "surplus": c.stats.surplus if entry.is_decoded else None,
                "not_indexed": c.unindexed,
                "metadata": c.metadata,
                "video": asdict(videos[c.topic]) if c.topic in videos else None,
            }
            for c in shown_channels(entry.channels)
        ],
    }


def _rate(channel: ChannelEntry) -> float | None:
    """Mean rate in Hz."""
    from hybridlog.query.periods import mean_rate

    stats = channel.stats
    return mean_rate(stats.messages, stats.first or 0, stats.last or 0)


def _skew(stats: ChannelStats) -> dict[str, float | int | None] | None:
    """Log time minus header stamp, ns; None if no stamp was set."""
    if stats.mean_skew is None:
        return None
    return {"mean": stats.mean_skew, "min": stats.skew_min, "max": stats.skew_max}


def _print_recording(
    entry: RecordingEntry,
    index: str | None,
    attachments: list[StoredAttachment],
    metadata: list[StoredMetadata],
    complete: str,
    *,
    videos: Mapping[str, VideoSummary],
    drawn: Density | None,
) -> None:
    from hybridlog.entries import summary_of
    from hybridlog.query.times import format_duration, format_time

    span = entry.span
    losses = losses_of(entry)
    source = entry.source
    summary = summary_of(entry)
    status = status_text(summary)
    if entry.status == "open":
        status += f"; `hybridlog top {quote(entry.name)}` shows it"
    held = (
        f"{output.size(entry.stored_bytes)} in {output.counted(entry.segments, 'segment')}, "
        f"{output.counted(entry.chunks, 'chunk')}"
    )
    rows = [
        ("id", entry.id),
        ("status", status),
        ("source", _source(source)),
        ("start", format_time(span[0]) if span else "-"),
        ("last", format_time(span[1]) if span else "-"),
        ("duration", format_duration(span[1] - span[0]) if span else "-"),
        ("messages", str(entry.messages)),
        ("stored", held),
        *_coverage(entry, complete),
        *(("", line_of(loss)) for loss in losses),
        *(("tag", f"{key}={value}") for key, value in sorted(entry.tags.items())),
        *(("note", note["text"]) for note in entry.notes),
        *_cut("pin", [f"{pin['id']}: {', '.join(pin_cells(pin))}" for pin in entry.pins]),
        *_cut("attachment", [f"{a.name} ({_content(a)})" for a in attachments]),
        *_cut("metadata", [f"{m.name} ({', '.join(m.values)})" for m in metadata]),
        ("index", index),
    ]
    output.print_table([("recording", "left"), (entry.name, "left")], rows)
    if not entry.channels:
        return
    output.say()
    columns: Sequence[output.Column] = [
        ("topic", "left"),
        ("type", "left"),
        ("messages", "right"),
        ("Hz", "right"),
        ("payload", "right"),
        ("log - header", "right"),
        ("note", "left"),
    ]
    from hybridlog.schema.states import shown_channels

    channels = sorted(shown_channels(entry.channels), key=lambda c: c.topic)
    cells = _with_short_types(
        columns,
        [_channel_row(c, is_decoded=entry.is_decoded, video=videos.get(c.topic)) for c in channels],
    )
    if output.is_narrow():
        columns, cells = output.fitted(columns, cells, ("payload",))
    if drawn is not None:
        headings = [name for name, _ in columns]
        # Names of types are cut short if that makes room for lines.
        for shown in (cells, _short_types(cells)):
            # The heading has taken its share of the room.
            room = output.room([*headings, _OVER_TIME], shown)
            lines = _sparklines(drawn, room + len(_OVER_TIME) if room >= 0 else 0)
            if lines:
                cells = [
                    [*row[:-1], lines.get(channel.topic, ""), row[-1]]
                    for channel, row in zip(channels, shown, strict=True)
                ]
                columns = [*columns[:-1], (_OVER_TIME, "whole"), columns[-1]]
                break
    output.print_table(*output.fitted(columns, cells, ("log - header",)))


_Rows = Sequence[Sequence[str]]


def _with_short_types(columns: Sequence[output.Column], rows: _Rows) -> _Rows:
    """Rows of a topic and its type, short where the terminal has no room for the package."""
    return rows if output.fits([name for name, _ in columns], rows) else _short_types(rows)


def _short_types(rows: _Rows) -> _Rows:
    return [[topic, kind.rpartition("/")[2], *others] for topic, kind, *others in rows]


def _coverage(entry: RecordingEntry, words: str) -> list[tuple[str, str]]:
    """The row about coverage; on a terminal with a bar."""
    if entry.span is None or not sys.stdout.isatty():
        return [("coverage", words)]
    from hybridlog.cli.sparkline import bar
    from hybridlog.query.answers.lost import lost_parts
    from hybridlog.record.losses import extent_of

    return [("coverage", bar(lost_parts(entry, extent_of(entry), _LETTERS))), ("", words)]


def _densities(store: Store, entry: RecordingEntry) -> Density | None:
    """Messages of each topic over time; None for a recording without any, or a damaged one."""
    from hybridlog.drawing.density import density
    from hybridlog.record.losses import extent_of

    begin, end = extent_of(entry)
    if begin == end:
        return None
    try:
        return density(store.session, entry, (begin, end), _LETTERS, max_times=_DRAWN_TIMES)
    except SegmentError as error:
        output.note(f"{entry.name}: {error}")
        return None


def _sparklines(drawn: Density, room: int) -> dict[str, str]:
    """A line for each topic, as long as there is room for, by topic; none without room."""
    from hybridlog.cli.sparkline import densities

    for step in (1, 2, 4):
        if _LETTERS // step <= room:
            counts = drawn.counts.reshape(len(drawn.topics), -1, step).sum(axis=2)
            return dict(zip(drawn.topics, map(densities, counts), strict=True))
    return {}


def _content(attachment: StoredAttachment) -> str:
    size = output.size(attachment.size)
    return f"{attachment.media_type}, {size}" if attachment.media_type else size


def _cut(name: str, lines: list[str]) -> list[tuple[str, str]]:
    """Rows of a table; the last one counts the lines that are left out."""
    rows = [(name, output.cut(line)) for line in lines[:MAX_LISTED]]
    more = len(lines) - len(rows)
    return [*rows, (name, f"and {more} more")] if more else rows


def _channel_row(
    channel: ChannelEntry,
    *,
    is_decoded: bool,
    video: VideoSummary | None,
) -> list[str]:
    from hybridlog.query.latching import depth_of
    from hybridlog.schema.states import State, encoding_of, state_of
    from hybridlog_storage.messages import SUPPLIED, Channel

    stats = channel.stats
    rate = _rate(channel)
    notes = []
    if channel.unindexed is not None:
        notes.append(f"not indexed: {channel.unindexed}")
    if SUPPLIED in channel.metadata:
        notes.append(f"definition of {channel.metadata[SUPPLIED]}")
    if stats.unreadable:
        notes.append(f"{stats.unreadable} unreadable")
    if stats.surplus:
        notes.append(f"{stats.surplus} with bytes left over")
    state = state_of(channel.message_encoding)
    if state is not State.WHOLE:
        why = {State.EXPIRED: ", expired", State.NOT_COPIED: ", not copied yet"}
        notes.append(f"fields only{why.get(state, '')}")
    if depth_of(Channel(channel.topic, channel.message_encoding, None, channel.metadata)):
        notes.append("latched")
    if video is not None and video.frames:
        notes.append(_video_text(video, stats.messages))
    skew = "-" if is_decoded else "?"
    if stats.mean_skew is not None:
        skew = output.short_duration(round(stats.mean_skew))
        if stats.unset:
            notes.append(f"{output.counted(stats.unset, 'stamp')} not set")
    elif stats.unset:
        skew = "not set"
    encoding = encoding_of(channel.message_encoding, channel.metadata)
    return [
        channel.topic,
        channel.type or encoding,
        str(stats.messages),
        f"{rate:.2f}" if rate is not None else "-",
        output.size(stats.payload_bytes),
        skew,
        "; ".join(notes),
    ]


def _video_text(video: VideoSummary, messages: int) -> str:
    frames = "" if video.frames >= messages else f" in the first {video.frames}"
    keys = output.counted(video.key_frames, "key frame")
    text = f"{', '.join(video.formats)}, {keys}{frames}" if video.formats else ""
    if video.unreadable:
        text = f"{text}; " if text else ""
        text += f"{output.counted(video.unreadable, 'frame')} of no known video{frames}"
    return text


def _source(source: Mapping[str, Any]) -> str:
    """Path or URL of the source, its kind, and the size of a log file."""
    size = f", {output.size(source['bytes'])}" if source["bytes"] else ""
    kind = f"{source['kind']}{size}"
    return f"{source['path']} ({kind})" if source["path"] else kind


def show_segment(path: Path, *, as_json: bool) -> None:
    """Print the summary of a sealed segment.

    Raises:
        StoreError: It is being written, or is no segment of a store.
    """
    from hybridlog_storage.manifests import DiskManifests
    from hybridlog_storage.segments.segment_reader import SegmentReader

    stem = path.name.split(".")[0]
    if path.name.endswith(".open"):
        raise StoreError(
            f"{path} is being written, or was left by a crash. Any command on its store, such as "
            "`hybridlog ls --store DIR`, seals segments that a crash left."
        )
    number = int(stem) if stem.isascii() and stem.isdigit() else 0
    try:
        with SegmentReader(path, number) as reader:
            summary = reader.summary()
            bytes_all = reader.size
    except SegmentError:
        if not DiskManifests(path.absolute().parents[2]).path(path.parent.name).exists():
            _refuse_log(path)
        raise
    chunks = summary.chunks
    channels = [
        {
            "topic": channel.topic,
            "type": channel.schema.name if channel.schema is not None else None,
            "messages": summary.counts.get(channel_id, 0),
            "chunks": sum(channel_id in place.channels for place in chunks),
        }
        for channel_id, channel in sorted(summary.channels.items())
    ]
    first = min((place.first for place in chunks), default=None)
    last = max((place.last for place in chunks), default=None)
    if as_json:
        output.print_json(
            {
                "segment": str(path),
                "bytes": bytes_all,
                "recording": summary.recording,
                "end": summary.end,
                "first_ns": first,
                "last_ns": last,
                "chunks": len(chunks),
                "channels": channels,
            }
        )
        return
    from hybridlog.query.times import format_time

    output.print_table(
        [("segment", "left"), (str(path), "left")],
        [
            ("recording", str(summary.recording.get("name"))),
            ("id", str(summary.recording.get("id"))),
            ("start", format_time(first) if first is not None else "-"),
            ("last", format_time(last) if last is not None else "-"),
            ("bytes", output.size(bytes_all)),
            ("chunks", str(len(chunks))),
            ("messages", str(sum(summary.counts.values()))),
        ],
    )
    output.say()
    columns: Sequence[output.Column] = [
        ("topic", "left"), ("type", "left"), ("messages", "right"), ("chunks", "right")
    ]  # fmt: skip
    rows = [["" if c[n] is None else str(c[n]) for n, _ in columns] for c in channels]
    output.print_table(columns, _with_short_types(columns, rows))


def _refuse_log(path: Path) -> None:
    """Tell a log, and a file of another kind, from a segment."""
    from hybridlog.formats.log_set import open_source
    from hybridlog.record.recorder import name_of

    try:
        open_source(path).close()
    except SourceError as error:
        raise StoreError(
            f"{path} is no segment of a hybridlog store, and no log: {error}"
        ) from None
    raise StoreError(
        f"{path} is a log, and `info` is about recordings: "
        f"`hybridlog record {quote(str(path))}`, then `hybridlog info {quote(name_of(path))}`."
    )
