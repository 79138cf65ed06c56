"""`hybridlog info`: recordings, or one thing about them."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from operator import itemgetter
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click
from msgspec.structs import asdict

from hybridlog.cli import options, output
from hybridlog.cli.answers import check_room, writing
from hybridlog.cli.binder import command, option
from hybridlog.cli.commands.keep import pin_cells
from hybridlog.cli.commands.ls import recording_dict, status_text, with_misfits
from hybridlog.cli.options import AsJson, Choosing, Forced, InStore, names_argument, query_of
from hybridlog.cli.render import (
    Column,
    bytes_of,
    densities,
    duration_of,
    print_fields,
    print_table,
)
from hybridlog.query.topics import resolve
from hybridlog.wording import listed
from hybridlog_storage.errors import SegmentError, TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.attachments import StoredAttachment, StoredMetadata
    from hybridlog.query.query import Query
    from hybridlog.query.question import RecordedChannel
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry


_MAX_DRAWN = 20  # recordings with sparklines; for more, reading their chunk tables takes long
_DRAWN_TIMES = 1 << 18  # see `density`: little is read for a sparkline
_LETTERS = 40  # of the coverage bar
_DRAWN = 20  # letters of a sparkline
_MAX_NAMES = 5  # recordings in a note
_READABLE = {"ros1msg", "ros2msg", "ros2idl", "jsonschema"}


@dataclass(frozen=True, kw_only=True)
class _Given(Choosing, InStore, AsJson, Forced):
    names: tuple[str, ...] = names_argument()  # type: ignore[misc]
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
    with given.opened(snapshot=True) as store:
        if given.losses:
            _show_losses(store, given)
        elif given.topic:
            query = query_of(store, given.topic, given.choice)
            (_show_tables if given.tables else _show_topics)(store, query, given)
        elif given.sizes is not None:
            _show_sizes(store, given.sizes, given)
        elif given.attachments or given.attachment is not None:
            _show_attachments(store, given)
        else:
            _show_recordings(store, given)


def _show_recordings(store: Store, given: _Given) -> None:
    entries = [with_misfits(store, entry) for entry in given.recordings_in(store)]
    found = [_as_dict(store, one, with_videos=n < _MAX_DRAWN) for n, one in enumerate(entries)]
    if given.as_json:
        output.print_json(found)
        return
    if not entries:
        output.note(store.session.when_empty)
    for number, (entry, about) in enumerate(zip(entries, found, strict=True)):
        if number:
            output.say()
        drawn = sys.stdout.isatty() and len(entries) <= _MAX_DRAWN
        _show_recording(store, entry, about, _sparklines(store, entry) if drawn else {})


def _show_recording(
    store: Store, entry: RecordingEntry, about: dict[str, Any], drawn: Mapping[str, str]
) -> None:
    print_fields(_fields(store, entry, about))
    if about["channels"]:
        output.say()
        over_time = Column("over time", lambda c: drawn.get(c["topic"]), "whole", order=1)
        columns = [*_CHANNELS, *([over_time] if drawn else []), Column("note", _channel_note)]
        print_table(columns, sorted(about["channels"], key=itemgetter("topic")))


def _as_dict(store: Store, entry: RecordingEntry, *, with_videos: bool) -> dict[str, Any]:
    from hybridlog.entries import summary_of
    from hybridlog.query.answers.lost import coverage
    from hybridlog.query.periods import mean_rate
    from hybridlog.record.losses import losses_of
    from hybridlog.schema.codecs import unindexed
    from hybridlog.schema.states import shown_channels

    attachments: list[StoredAttachment] = []
    metadata: list[StoredMetadata] = []
    try:
        attachments, metadata = store.attachments(entry), store.metadata(entry)
    except SegmentError as error:
        output.note(f"{entry.name}: {error}")
    losses, videos = losses_of(entry), _videos(store, entry) if with_videos else {}
    reasons = unindexed(store.session.definitions(entry))
    return {
        **recording_dict(summary_of(entry)),
        "chunks": entry.chunks,
        "coverage": coverage(entry, losses),
        "losses": losses,
        "marks": entry.marks,
        "pins": entry.pins,
        "attachments": [*map(_attachment_dict, attachments)],
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
                "not_indexed": reasons.get(c.id),
                "metadata": c.metadata,
                "video": videos.get(c.topic),
            }
            for c in shown_channels(entry.channels)
        ],
    }


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


def _fields(store: Store, entry: RecordingEntry, about: dict[str, Any]) -> list[tuple[str, object]]:
    """The lines of a recording: name and value."""
    from hybridlog.entries import summary_of
    from hybridlog.query.answers.lost import line_of
    from hybridlog.query.times import format_duration

    status, source = status_text(summary_of(entry)), entry.source["kind"]
    if entry.status == "open":
        status += f"; `hybridlog top {quote(entry.name)}` shows it"
    if entry.source["bytes"]:
        source += f", {output.size(entry.source['bytes'])}"
    if entry.source["path"]:
        source = f"{entry.source['path']} ({source})"
    first, last = about["first_ns"], about["last_ns"]
    segments, chunks = (
        output.counted(getattr(entry, f"{what}s"), what) for what in ("segment", "chunk")
    )
    bar = _coverage_bar(entry)
    return [
        ("recording", entry.name),
        ("id", entry.id),
        ("status", status),
        ("source", source),
        ("start", output.time_text(first)),
        ("last", output.time_text(last)),
        ("duration", "-" if first is None else format_duration(last - first)),
        ("messages", entry.messages),
        ("stored", f"{output.size(entry.stored_bytes)} in {segments}, {chunks}"),
        *([("coverage", bar)] if bar else ()),
        ("" if bar else "coverage", about["coverage"]),
        *(("", line_of(loss)) for loss in about["losses"]),
        *(("tag", f"{key}={value}") for key, value in sorted(entry.tags.items())),
        *(("note", note["text"]) for note in entry.notes),
        *(("pin", f"{pin['id']}: {', '.join(filter(None, pin_cells(pin)))}") for pin in entry.pins),
        *(
            ("attachment", f"{one['name']} ({', '.join(filter(None, _about(one)))})")
            for one in about["attachments"]
        ),
        *(
            ("metadata", f"{one['name']} ({', '.join(one['values'])})")
            for one in about["metadata_records"]
        ),
        ("index", store.shared.index.place),
    ]


def _about(attachment: Mapping[str, Any]) -> tuple[str, str]:
    return attachment["media_type"], output.size(attachment["bytes"])


def _coverage_bar(entry: RecordingEntry) -> str:
    """A bar of letters that shows where messages are lost; empty without a terminal."""
    if entry.span is None or not sys.stdout.isatty():
        return ""
    from hybridlog.query.answers.lost import lost_parts
    from hybridlog.record.losses import extent_of

    lost = lost_parts(entry, extent_of(entry), _LETTERS).tolist()
    return "".join("░" if one else "█" for one in lost)


def _sparklines(store: Store, entry: RecordingEntry) -> dict[str, str]:
    """Messages of each topic over time; none without any, or if they cannot be read."""
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


def _channel_note(channel: Mapping[str, Any]) -> str:
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
    bytes_of("payload", "payload_bytes", order=2),
    Column("log - header", _skew_text, "right", order=3),
]


def _show_topics(store: Store, query: Query, given: _Given) -> None:
    """Print the definition and the fields of topics, those of each type once."""
    from hybridlog.query.query import channels_of

    seen: dict[tuple[str, str], dict[str, Any]] = {}
    for recorded in channels_of(query):
        schema = recorded.channel.schema
        key = recorded.channel.topic, recorded.recording.id if schema is None else repr(schema)
        if key not in seen:
            seen[key] = _topic_dict(store, recorded)
        seen[key]["recordings"].append(recorded.recording.name)
    if not seen:
        raise TopicError(f"No chosen recording has {' or '.join(query.topics)}.")
    if given.as_json:
        output.print_json(list(seen.values()))
        return
    for number, item in enumerate(seen.values()):
        if number:
            output.say()
        encoding = f"{item['message_encoding']}, {item['schema_encoding'] or 'no schema'}"
        output.say(f"{item['topic']}  {item['type'] or '(no type)'}  ({encoding})")
        for line in (item["definition"] or "").splitlines():
            output.say(line)
        if item["not_indexed"]:
            output.say(f"not indexed: {item['not_indexed']}")
        if item["arrays"]:
            output.say("Its tables have long arrays, not only their summaries.")
        if item["fields"]:
            output.say()
            if item["observed"]:
                output.say("No definition fixes the fields. The first messages have these:")
            asked = Column("asked as", "path" if item["observed"] else _asked_as)
            print_table([Column("field", "path"), Column("type"), asked], item["fields"])


def _topic_dict(store: Store, recorded: RecordedChannel) -> dict[str, Any]:
    from hybridlog.query.answers.infer_fields import infer_fields

    channel, codec = recorded.channel, recorded.codec
    schema, text = channel.schema, None
    if schema is not None and schema.encoding in _READABLE:
        text = bytes(schema.data).decode("utf-8", "replace")
    fields: list[dict[str, object]] = [
        {"path": p.path, "type": p.type, "array": p.array} for p in codec.paths()
    ]
    observed = codec.indexed and not fields
    if observed:
        fields = infer_fields(store.query([channel.topic], [recorded.recording.id]))
    return {
        "topic": channel.topic,
        "type": schema.name if schema is not None else None,
        "message_encoding": channel.message_encoding,
        "schema_encoding": schema.encoding if schema is not None else None,
        "definition": text,
        "recordings": [],
        "not_indexed": codec.reason,
        "observed": observed,
        "arrays": channel.topic in store.directory.settings.arrays,
        "fields": fields,
    }


def _asked_as(field: dict[str, Any]) -> str:
    path, kind = str(field["path"]), str(field["type"])
    if "[" in kind and kind.startswith(("int", "uint", "float", "bool")):
        return f"{path}.min, {path}.max, {path}.mean, {path}.n"
    return path


def _show_tables(store: Store, query: Query, _: _Given) -> None:
    """Print the Parquet files with the rows of a topic, and SQL for DuckDB."""
    from hybridlog.maintenance.tables import missing
    from hybridlog.query.query import channels_of
    from hybridlog.record.marks import MARKS
    from hybridlog.snapshot import UNFINISHED

    topic, *others = query.topics
    if others:
        raise UsageError(f"--tables is about one topic: name one of {listed(query.topics)}.")
    channels = channels_of(query)
    recordings = {one.recording.id: one.recording for one in channels}.values()
    ended = [one for one in recordings if one.status not in UNFINISHED]
    going = [one.name for one in recordings if one.status in UNFINISHED]
    found = _tables_of(store, query, [one for one in channels if one.recording in ended])
    tables = store.session.tables
    lacking = [one.name for one in ended if topic in missing(store.directory, one, tables)]
    shown = ((*one["files"], "", f"{one['statement']};", "") for one in found)
    output.tell({"tables": found, "missing": lacking}, [line for each in shown for line in each])
    marks = sum(len(one.marks) for one in recordings) if topic == MARKS else 0
    without = {
        f"{listed(lacking, _MAX_NAMES)}, whose rows are missing: `hybridlog verify --repair` "
        "makes them again": lacking,
        f"{listed(going)}: rows are added when a recording ends": going,
        f"{output.counted(marks, 'mark')} that somebody set: no table has them, `hybridlog sql` "
        "has": marks,
    }
    output.notes(f"Without {what}." for what, applies in without.items() if applies)


def _tables_of(
    store: Store, query: Query, channels: Collection[RecordedChannel]
) -> list[dict[str, Any]]:
    """Folders with rows of a topic in some recordings: files, rows, statement."""
    from glob import escape

    from hybridlog.columns.folders import files_of
    from hybridlog.columns.layout import type_prefix

    (topic,), recordings = query.topics, {one.recording.id for one in channels}
    schemas = [one.channel.schema for one in channels]
    prefixes = {type_prefix("" if schema is None else schema.name) for schema in schemas}
    where = f"topic = {_quoted(topic)}"
    if query.question.recordings is not None:
        where += f" and recording in ({', '.join(map(_quoted, sorted(recordings)))})"
    folders: dict[Path, dict[str, Any]] = {}
    for file in files_of(store.directory.path, prefixes) if prefixes else ():
        own = (one for one in file.about.sections if one.topic == topic and one.id in recordings)
        if rows := sum(one.rows for one in own):
            folder = file.path.parent
            found = folders.setdefault(folder, {"folder": str(folder), "rows": 0, "files": []})
            found["rows"] += rows
            found["files"].append(str(file.path))
            files = _quoted(f"{escape(str(folder))}/*.parquet")
            # The only texts in it are quoted, and nothing is run here.
            found["statement"] = f"select * from {files} where {where}"  # noqa: S608
    return list(folders.values())


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _show_losses(store: Store, given: _Given) -> None:
    """Print what is missing of topics, from when to when, and why."""
    from hybridlog.query.topics import matcher
    from hybridlog.record.losses import losses_of

    if given.topic:
        resolve(given.topic, store.topics())  # refuses a name that fits no topic
    fits = matcher(given.topic) if given.topic else None
    entries = [*given.recordings_in(store)]
    rows = [
        {"recording": entry.name, **loss}
        for entry in entries
        for loss in losses_of(entry)
        if fits is None or (loss.get("topic") is not None and fits(loss["topic"]))
    ]
    named = output.counted(len(entries), "recording")
    without = f"Nothing is missing from {named}, as far as the ledger knows."
    given.show(rows, _LOSSES[len(entries) == 1 :], without)
    if running := [entry.name for entry in entries if entry.status == "open"]:
        output.note(f"Still being recorded, so later losses are to come: {listed(running)}.")


def _span(loss: Mapping[str, Any]) -> int | None:
    begin, end = loss.get("from"), loss.get("to")
    return None if begin is None or end is None else end - begin


_LOSSES = [
    Column("recording"),
    Column("topic", lambda loss: loss.get("topic") or "any"),
    Column("cause"),
    Column("messages", lambda loss: "unknown" if loss["count"] is None else loss["count"], "right"),
    Column("from", lambda loss: output.short_time(loss.get("from")), "whole"),
    duration_of("for", _span),
    Column("detail", lambda loss: ": ".join(filter(None, (loss.get("file"), loss.get("reason"))))),
]


def _show_sizes(store: Store, by: str, given: _Given) -> None:
    """Print the bytes by `recording`, by `topic`, or by `both`."""
    sizes = store.sizes(given.recordings_in(store))
    found = {"recording": sizes.by_recording, "topic": sizes.by_topic}.get(by, lambda: sizes.rows)()
    total, *rows = (
        {name: value for name, value in asdict(one).items() if value != ""}
        | {"total_bytes": one.total_bytes}
        for one in (sizes.total, *found)
    )
    if given.as_json:
        output.print_json({"rows": rows, "total": total})
        return
    names = [Column("recording"), Column("topic", lambda row: row.get("topic", "(no topic)"))]
    names = [one for one in names if by in {one.name, "both"}]
    last = total | {one.name: "" for one in names[1:]} | {names[0].name: "total"}
    columns = [column for column in _SIZES if column.name != "fields" or total["column_bytes"]]
    given.show([*rows, last] if rows else [], [*names, *columns], store.session.when_empty)


_SIZES = [
    Column("messages", side="right", order=1),
    bytes_of("payload", "payload_bytes", order=2),
    bytes_of("segments", "segment_bytes"),
    bytes_of("fields", "column_bytes"),
    bytes_of("tables", "table_bytes"),
    bytes_of("MongoDB", "index_bytes"),
    bytes_of("total", "total_bytes"),
]


def _show_attachments(store: Store, given: _Given) -> None:
    """List attachments, print the one that is named or fits a glob, or write some into files."""
    there = [one for entry in given.recordings_in(store) for one in store.attachments(entry)]
    found, name = there, given.attachment
    if name is not None:
        found = [one for one in there if one.name == name]
        found = found or [one for one in there if fnmatchcase(one.name, name)]
        if not found:
            names = listed(output.quoted(one.name) for one in there)
            raise TopicError(f"There is no attachment {output.quoted(name)}. There are: {names}.")
    if given.output is not None:
        is_one = name is not None and len(found) == 1
        _write_attachments(found, given.output, is_one=is_one, force=given.force)
    elif name is None or given.as_json:
        given.show([*map(_attachment_dict, found)], _ATTACHMENTS, "There are no attachments.")
    elif len(found) > 1:
        raise UsageError(
            f"{len(found)} attachments have this name: -o DIR writes each of them into a file."
        )
    elif sys.stdout.isatty() and not found[0].media_type.startswith("text/"):
        raise UsageError(f"{found[0].name} may be no text: name a file with -o.")
    else:
        for piece in found[0].pieces():
            sys.stdout.buffer.write(piece)


def _write_attachments(
    found: list[StoredAttachment], target: Path, *, is_one: bool, force: bool
) -> None:
    """Write one attachment to a file, or each into a directory under a name made from its own."""
    from hybridlog.attachments import file_names

    paths = [target]
    if target.is_dir() or not is_one:
        paths = [target / name for name in file_names(found)]
    for path in paths:
        check_room(path, force=force)
    if paths != [target]:
        try:
            target.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{target} cannot be made: {error.strerror}.") from error
    for attachment, path in zip(found, paths, strict=True):
        with writing(path):
            attachment.save(path)
        output.note(f"{path}: {output.size(attachment.size)}")


def _attachment_dict(attachment: StoredAttachment) -> dict[str, Any]:
    """An attachment as JSON."""
    return {
        "recording": attachment.recording,
        "name": attachment.name,
        "media_type": attachment.media_type,
        "bytes": attachment.size,
        "log_time_ns": attachment.log_time_ns,
        "create_time_ns": attachment.create_time_ns,
    }


_ATTACHMENTS = [
    Column("attachment", "name"),
    Column("media type", "media_type"),
    bytes_of("size", "bytes"),
    Column("log time", lambda row: output.time_text(row["log_time_ns"] or None)),
]
