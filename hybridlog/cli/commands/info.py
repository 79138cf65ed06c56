"""`hybridlog info`: recordings and topics, or a segment file."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.binder import command, option
from hybridlog.cli.commands.keep import pin_cells
from hybridlog.cli.commands.ls import recording_dict, status_text, with_misfits
from hybridlog.cli.info_parts import (
    attachment_as_dict,
    show_attachments,
    show_losses,
    show_sizes,
    show_tables,
    show_topics,
)
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    Forced,
    InStore,
    names_argument,
    query_of,
)
from hybridlog.cli.render import Column, numbers, print_fields, print_table
from hybridlog.query.answers.lost import coverage, line_of
from hybridlog.query.topics import resolve
from hybridlog.record.losses import losses_of
from hybridlog_storage.errors import SegmentError, StoreError

if TYPE_CHECKING:
    from hybridlog.attachments import StoredAttachment, StoredMetadata
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry


_MAX_DRAWN = 20  # recordings with sparklines; for more, reading their chunk tables takes long
_DRAWN_TIMES = 1 << 18  # see `density`: little is read for a sparkline
_LETTERS = 40  # of the coverage bar
_DRAWN = 20  # letters of a sparkline
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
        "With --topic, instead: its Parquet files and SQL for DuckDB, and what is missing of them.",
        needs=("topic",),
        excludes=("losses",),
    )
    losses: bool = option(
        "Instead: what is missing, from when to when, and why.",
        excludes=("sizes", "attachments", "attachment"),
    )
    sizes: str | None = option(
        "Instead: the bytes of each recording, each topic, or each topic of each recording "
        "in segments, tables and MongoDB. Shares of what topics have in common are estimates.",
        type=click.Choice(["recording", "topic", "both"]),
        excludes=("topic", "attachments", "attachment"),
    )
    attachments: bool = option("Instead: the attachments of the logs.", excludes=("topic",))
    attachment: str | None = option(
        "Instead: the content of this attachment, or with -o those that fit a glob such as "
        "'*.yaml'.",
        "NAME",
        excludes=("topic",),
    )
    output: Path | None = option(
        "Write the attachment to this file; several attachments into this directory.",
        "FILE|DIR",
        short="-o",
        needs=("attachments", "attachment"),
    )


@command(_Given)
def info_command(given: _Given) -> None:
    """Show topics, types, rates, sizes, times, clock skew, losses.

    Options show one thing instead: the definition of a topic, losses, sizes, attachments.
    """
    if len(given.names) == 1 and _is_segment(given.names[0]):
        show_segment(Path(given.names[0]), as_json=given.as_json)
        return
    with given.opened(snapshot=True) as store:
        if given.losses:
            if given.topic:
                resolve(given.topic, store.topics())  # refuses a name that fits no topic
            show_losses([*given.recordings_in(store)], given.topic, given)
        elif given.topic:
            query = query_of(store, given.topic, given.choice)
            if given.tables:
                show_tables(store, query)
            else:
                show_topics(store, query, as_json=given.as_json)
        elif given.sizes is not None:
            sizes = store.sizes(given.recordings_in(store))
            show_sizes(sizes, given.sizes, given, store.session.when_empty)
        elif given.attachments or given.attachment is not None:
            entries = given.recordings_in(store)
            found = [one for entry in entries for one in store.attachments(entry)]
            show_attachments(found, given.attachment, given.output, given, force=given.force)
        else:
            _show(store, given)


def _show(store: Store, given: _Given) -> None:
    entries = [with_misfits(store, entry) for entry in given.recordings_in(store)]
    found = [
        _as_dict(store, entry, _videos(store, entry) if number < _MAX_DRAWN else {})
        for number, entry in enumerate(entries)
    ]
    if given.as_json:
        output.print_json(found)
        return
    if not entries:
        output.note(store.session.when_empty)
    for number, (entry, about) in enumerate(zip(entries, found, strict=True)):
        if number:
            output.say()
        drawn = sys.stdout.isatty() and len(entries) <= _MAX_DRAWN
        _print_recording(entry, about, store, _sparklines(store, entry) if drawn else {})


def _is_segment(what: str) -> bool:
    """True for the path of a file; names and ids of recordings have no slash."""
    looks = "/" in what or what.endswith((".mcap", ".mcap.open", ".bag", ".db3"))
    return looks and Path(what).exists()


def _videos(store: Store, entry: RecordingEntry) -> dict[str, dict[str, Any]]:
    """Codec and key frames of video topics, by topic; none of those that cannot be read."""
    from hybridlog.arrays import is_video_type

    found: dict[str, dict[str, Any]] = {}
    for topic in dict.fromkeys(one.topic for one in entry.channels if is_video_type(one.type)):
        from hybridlog.query.answers.video import summary_of

        try:
            found[topic] = summary_of(store.session, entry.id, topic)
        except SegmentError as error:
            output.note(f"{entry.name}: {error}")
    return found


def _as_dict(store: Store, entry: RecordingEntry, videos: Mapping[str, Any]) -> dict[str, Any]:
    from hybridlog.entries import summary_of
    from hybridlog.query.periods import mean_rate
    from hybridlog.schema.states import shown_channels

    attachments: list[StoredAttachment] = []
    metadata: list[StoredMetadata] = []
    try:
        attachments, metadata = store.attachments(entry), store.metadata(entry)
    except SegmentError as error:
        output.note(f"{entry.name}: {error}")
    losses = losses_of(entry)
    return {
        **recording_dict(summary_of(entry)),
        "chunks": entry.chunks,
        "coverage": coverage(entry, losses),
        "losses": losses,
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
                "rate_hz": mean_rate(c.stats.messages, c.stats.first or 0, c.stats.last or 0),
                "first_ns": c.stats.first,
                "last_ns": c.stats.last,
                "skew_ns": None
                if c.stats.mean_skew is None
                else {"mean": c.stats.mean_skew, "min": c.stats.skew_min, "max": c.stats.skew_max},
                "unset_stamps": c.stats.unset if entry.is_decoded else None,
                "unreadable": c.stats.unreadable if entry.is_decoded else None,
                "surplus": c.stats.surplus if entry.is_decoded else None,
                "not_indexed": c.unindexed,
                "metadata": c.metadata,
                "video": videos.get(c.topic),
            }
            for c in shown_channels(entry.channels)
        ],
    }


def _print_recording(
    entry: RecordingEntry, about: dict[str, Any], store: Store, drawn: Mapping[str, str]
) -> None:
    from hybridlog.entries import summary_of
    from hybridlog.query.times import format_duration

    status = status_text(summary_of(entry))
    if entry.status == "open":
        status += f"; `hybridlog top {quote(entry.name)}` shows it"
    source = entry.source["kind"]
    if entry.source["bytes"]:
        source += f", {output.size(entry.source['bytes'])}"
    if entry.source["path"]:
        source = f"{entry.source['path']} ({source})"
    first, last = about["first_ns"], about["last_ns"]
    print_fields(
        [
            ("recording", entry.name),
            ("id", entry.id),
            ("status", status),
            ("source", source),
            ("start", output.time_text(first)),
            ("last", output.time_text(last)),
            ("duration", "-" if first is None else format_duration(last - first)),
            ("messages", entry.messages),
            (
                "stored",
                f"{output.size(entry.stored_bytes)} in {output.counted(entry.segments, 'segment')}"
                f", {output.counted(entry.chunks, 'chunk')}",
            ),
            *_coverage(entry, about["coverage"]),
            *(("", line_of(loss)) for loss in about["losses"]),
            *(("tag", f"{key}={value}") for key, value in sorted(entry.tags.items())),
            *(("note", note["text"]) for note in entry.notes),
            *(
                ("pin", f"{pin['id']}: {', '.join(filter(None, pin_cells(pin)))}")
                for pin in entry.pins
            ),
            *(
                (
                    "attachment",
                    f"{one['name']} "
                    f"({', '.join(filter(None, (one['media_type'], output.size(one['bytes']))))})",
                )
                for one in about["attachments"]
            ),
            *(
                ("metadata", f"{one['name']} ({', '.join(one['values'])})")
                for one in about["metadata_records"]
            ),
            ("index", store.shared.index.place),
        ]
    )
    if about["channels"]:
        output.say()
        over_time = Column(_OVER_TIME, lambda c: drawn.get(c["topic"]), "whole", order=1)
        columns = [*_CHANNELS[:-1], *([over_time] if drawn else []), _CHANNELS[-1]]
        print_table(columns, sorted(about["channels"], key=itemgetter("topic")))


def _coverage(entry: RecordingEntry, words: str) -> list[tuple[str, str]]:
    """The row about coverage; on a terminal with a bar."""
    if entry.span is None or not sys.stdout.isatty():
        return [("coverage", words)]
    from hybridlog.query.answers.lost import lost_parts
    from hybridlog.record.losses import extent_of

    lost = lost_parts(entry, extent_of(entry), _LETTERS).tolist()
    return [("coverage", "".join("░" if one else "█" for one in lost)), ("", words)]


def _sparklines(store: Store, entry: RecordingEntry) -> dict[str, str]:
    """Messages of each topic over time; none without any, or if they cannot be read."""
    from hybridlog.cli.sparkline import densities
    from hybridlog.drawing.times import evenly, lane_of
    from hybridlog.record.losses import extent_of

    begin, end = extent_of(entry)
    if begin == end:
        return {}
    edges = evenly((begin, end), _DRAWN)
    try:
        return {
            topic: densities(lane_of(store.session, entry, topic, _DRAWN_TIMES).counts(edges))
            for topic in sorted({channel.topic for channel in entry.channels})
        }
    except SegmentError as error:
        output.note(f"{entry.name}: {error}")
        return {}


def _kind(channel: Mapping[str, Any]) -> str:
    from hybridlog.schema.states import encoding_of

    return channel["type"] or encoding_of(channel["message_encoding"], channel["metadata"])


def _skew_text(channel: Mapping[str, Any]) -> str:
    if channel["skew_ns"] is not None:
        return output.short_duration(round(channel["skew_ns"]["mean"]))
    if channel["unset_stamps"]:
        return "not set"
    return "?" if channel["unset_stamps"] is None else "-"


def channel_note(channel: Mapping[str, Any]) -> str:
    """Remarks on the messages of a topic, such as that they are latched or expired."""
    from hybridlog.query.latching import depth_of
    from hybridlog.schema.states import State, state_of
    from hybridlog_storage.messages import SUPPLIED, Channel

    encoding, metadata = channel["message_encoding"], channel["metadata"]
    state, video = state_of(encoding), channel["video"]
    why = {State.EXPIRED: ", expired", State.NOT_COPIED: ", not copied yet"}.get(state, "")
    unset = channel["skew_ns"] is not None and channel["unset_stamps"]
    notes = {
        f"not indexed: {channel['not_indexed']}": channel["not_indexed"] is not None,
        f"definition of {metadata.get(SUPPLIED)}": SUPPLIED in metadata,
        f"{channel['unreadable']} unreadable": channel["unreadable"],
        f"{channel['surplus']} with bytes left over": channel["surplus"],
        f"fields only{why}": state is not State.WHOLE,
        "latched": depth_of(Channel(channel["topic"], encoding, None, metadata)),
        _video_text(video, channel["messages"]): video and video["frames"],
        f"{output.counted(unset or 0, 'stamp')} not set": unset,
    }
    return "; ".join(text for text, applies in notes.items() if applies)


def _video_text(video: Mapping[str, Any] | None, messages: int) -> str:
    if video is None:
        return ""
    frames = "" if video["frames"] >= messages else f" in the first {video['frames']}"
    keys = output.counted(video["key_frames"], "key frame")
    parts = [f"{', '.join(video['formats'])}, {keys}{frames}"] if video["formats"] else []
    if video["unreadable"]:
        parts.append(f"{output.counted(video['unreadable'], 'frame')} of no known video{frames}")
    return "; ".join(parts)


_CHANNELS = [
    Column("topic"),
    Column("type", _kind, short=lambda channel: _kind(channel).rpartition("/")[2]),
    Column("messages", side="right"),
    Column("Hz", lambda c: "-" if c["rate_hz"] is None else f"{c['rate_hz']:.2f}", "right"),
    Column("payload", lambda c: output.size(c["payload_bytes"]), "right", order=2),
    Column("log - header", _skew_text, "right", order=3),
    Column("note", channel_note),
]


def show_segment(path: Path, *, as_json: bool) -> None:
    """Print the summary of a sealed segment."""
    from hybridlog_storage.segments.segment_reader import SegmentReader

    if path.name.endswith(".open"):
        raise StoreError(
            f"{path} is being written, or was left by a crash. Any command on its store, such as "
            "`hybridlog ls --store DIR`, seals segments that a crash left."
        )
    stem = path.name.split(".")[0]
    try:
        with SegmentReader(path, int(stem) if stem.isdecimal() else 0) as reader:
            summary = reader.summary()
            bytes_all = reader.size
    except SegmentError as error:
        raise StoreError(
            f"{path} is no whole segment of a store. Of a log, `hybridlog record "
            f"{quote(str(path))}` makes a recording. {error}"
        ) from error
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
    about: dict[str, Any] = {
        "segment": str(path),
        "bytes": bytes_all,
        "recording": summary.recording,
        "first_ns": min((place.first for place in chunks), default=None),
        "last_ns": max((place.last for place in chunks), default=None),
        "chunks": len(chunks),
        "channels": channels,
    }
    if as_json:
        output.print_json(about)
        return
    print_fields(
        [
            ("segment", path),
            ("recording", summary.recording.get("name")),
            ("id", summary.recording.get("id")),
            ("start", output.time_text(about["first_ns"])),
            ("last", output.time_text(about["last_ns"])),
            ("bytes", output.size(bytes_all)),
            ("chunks", len(chunks)),
            ("messages", sum(summary.counts.values())),
        ]
    )
    output.say()
    kind = Column("type", short=lambda channel: (channel["type"] or "").rpartition("/")[2])
    print_table([Column("topic"), kind, *numbers("messages", "chunks")], channels)
