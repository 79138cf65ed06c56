"""`hybridlog info`: recordings, or one thing about them."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec.structs import asdict

from hybridlog.cli import options, output
from hybridlog.cli.answers import check_room
from hybridlog.cli.commands.keep import pin_dict
from hybridlog.cli.commands.ls import recording_dict, status_text
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    Forced,
    InStore,
    command,
    names_argument,
    option,
    query_of,
)
from hybridlog.cli.output import Column, print_fields, print_table
from hybridlog.query.times import format_duration
from hybridlog.query.topics import matcher, resolve
from hybridlog.wording import listed
from hybridlog_storage.errors import SegmentError, TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.attachments import StoredAttachment, StoredMetadata
    from hybridlog.query.query import Query
    from hybridlog.query.question import RecordedChannel
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry

_MAX_NAMES = 5  # recordings in a note
_READABLE = {"ros1msg", "ros2msg", "ros2idl", "jsonschema"}


class _Given(Choosing, InStore, AsJson, Forced):
    names: tuple[str, ...] = names_argument()  # type: ignore[misc]
    topic: tuple[str, ...] = options.topics(
        "Instead: the message definition and the fields of this topic. With --losses: only those "
        "of this topic."
    )
    tables: bool = option(
        "With --topic, instead: SQL for DuckDB about its Parquet files, and what is missing of "
        "them.",
        needs=("topic",),
        excludes=("losses",),
    )
    losses: bool = option(
        "Instead: what is missing, from when to when, and why.",
        excludes=("sizes", "attachments", "attachment"),
    )
    sizes: str | None = option(
        "Instead: the bytes of each recording, each topic, or each topic of each recording "
        "in segments and tables. Shares of what topics have in common are estimates.",
        type=click.Choice(["recording", "topic", "both"]),
        excludes=("topic", "attachments", "attachment"),
    )
    attachments: bool = option("Instead: the attachments of the logs.", excludes=("topic",))
    attachment: str | None = option(
        "Instead: the content of this attachment.",
        "NAME",
        excludes=("topic", "attachments"),
    )
    output: Path | None = option(
        "Write the attachment to this file.", "FILE", short="-o", needs=("attachment",)
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
    found = [(entry, _as_dict(store, entry)) for entry in given.recordings_in(store)]
    if given.as_json:
        output.print_json([about for _, about in found])
        return
    if not found:
        output.note(store.session.when_empty)
    for number, (entry, about) in enumerate(found):
        if number:
            output.say()
        print_fields(_fields(store, entry, about))
        if about["channels"]:
            output.say()
            print_table(_CHANNELS, sorted(about["channels"], key=itemgetter("topic")))


def _as_dict(store: Store, entry: RecordingEntry) -> dict[str, Any]:
    from hybridlog.entries import summary_of
    from hybridlog.query.answers.completeness import coverage
    from hybridlog.query.intervals import mean_rate
    from hybridlog.record.losses import losses_of
    from hybridlog.schema.codecs import unindexed
    from hybridlog.schema.states import shown_channels

    attachments: list[StoredAttachment] = []
    metadata: list[StoredMetadata] = []
    try:
        attachments, metadata = store.attachments(entry), store.metadata(entry)
    except SegmentError as error:
        output.note(f"{entry.name}: {error}")
    losses, reasons = losses_of(entry), unindexed(store.session.definitions(entry))
    return {
        **recording_dict(summary_of(entry)),
        "chunks": entry.chunks,
        "coverage": coverage(entry, losses),
        "losses": losses,
        "marks": [*map(asdict, entry.manifest.marks)],
        "pins": [*map(pin_dict, entry.manifest.pins)],
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
            }
            for c in shown_channels(entry.channels)
        ],
    }


def _fields(store: Store, entry: RecordingEntry, about: dict[str, Any]) -> list[tuple[str, object]]:
    """The lines of a recording: name and value."""
    from hybridlog.entries import summary_of
    from hybridlog.query.answers.completeness import line_of

    manifest, origin = entry.manifest, entry.manifest.source
    kind = f"{origin.kind}, {output.size(origin.bytes)}" if origin.bytes else origin.kind
    first, last = about["first_ns"], about["last_ns"]
    files = (output.counted(about[f"{what}s"], what) for what in ("segment", "chunk"))
    return [
        ("recording", entry.name),
        ("id", entry.id),
        ("status", status_text(summary_of(entry))),
        ("source", f"{origin.path} ({kind})" if origin.path else kind),
        ("start", output.time_text(first)),
        ("last", output.time_text(last)),
        ("duration", "-" if first is None else format_duration(last - first)),
        ("messages", entry.messages),
        ("stored", f"{output.size(entry.stored_bytes)} in {', '.join(files)}"),
        ("coverage", about["coverage"]),
        *(("", line_of(loss)) for loss in about["losses"]),
        *(("tag", f"{key}={value}") for key, value in sorted(entry.tags.items())),
        *(("note", note.text) for note in manifest.notes),
        ("index", store.shared.index.place),
    ]


def _skew_text(channel: Mapping[str, Any]) -> str:
    if channel["skew_ns"] is not None:
        return output.short_duration(round(channel["skew_ns"]["mean"]))
    return {None: "?", 0: "-"}.get(channel["unset_stamps"], "not set")


def _kind(channel: Mapping[str, Any]) -> str:
    from hybridlog.schema.states import encoding_of

    return channel["type"] or encoding_of(channel["message_encoding"], channel["metadata"])


def _channel_note(channel: Mapping[str, Any]) -> str:
    """Remarks on the messages of a topic, such as that they are latched or expired."""
    from hybridlog.query.latching import depth_of
    from hybridlog.schema.states import State, state_of
    from hybridlog_storage.messages import SUPPLIED, Channel

    encoding, metadata = channel["message_encoding"], channel["metadata"]
    state = state_of(encoding)
    why = {State.EXPIRED: ", expired", State.NOT_COPIED: ", not copied yet"}.get(state, "")
    unset = channel["skew_ns"] is not None and channel["unset_stamps"]
    notes = {
        f"not indexed: {channel['not_indexed']}": channel["not_indexed"] is not None,
        f"definition of {metadata.get(SUPPLIED)}": SUPPLIED in metadata,
        f"{channel['unreadable']} unreadable": channel["unreadable"],
        f"{channel['surplus']} with bytes left over": channel["surplus"],
        f"fields only{why}": state is not State.WHOLE,
        "latched": depth_of(Channel(channel["topic"], encoding, None, metadata)),
        f"{output.counted(unset or 0, 'stamp')} not set": unset,
    }
    return "; ".join(text for text, applies in notes.items() if applies)


_CHANNELS = [
    Column("topic"),
    Column("type", _kind, cut=12),
    Column("messages", kind="number"),
    Column("Hz", "rate_hz", "rate"),
    Column("payload", "payload_bytes", "bytes", order=1),
    Column("log - header", _skew_text, "number", order=2),
    Column("note", _channel_note, cut=12),
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
        encoding = f"{item['message_encoding']}, {item['schema_encoding'] or 'no schema'}"
        lines = [
            *([""] if number else []),
            f"{item['topic']}  {item['type'] or '(no type)'}  ({encoding})",
            *(item["definition"] or "").splitlines(),
        ]
        if item["not_indexed"]:
            lines.append(f"not indexed: {item['not_indexed']}")
        if item["arrays"]:
            lines.append("Its tables have long arrays, not only their summaries.")
        if item["observed"]:
            lines += ["", "No definition fixes the fields. The first messages have these:"]
        elif item["fields"]:
            lines.append("")
        for line in lines:
            output.say(line)
        asked = Column("asked as", "path" if item["observed"] else _asked_as, cut=20)
        print_table([Column("field", "path"), Column("type"), asked], item["fields"])


def _topic_dict(store: Store, recorded: RecordedChannel) -> dict[str, Any]:
    from hybridlog.query.answers.statistics import infer_fields

    channel, codec, fields = recorded.channel, recorded.codec, recorded.codec.paths()
    schema, text = channel.schema, None
    if schema is not None and schema.encoding in _READABLE:
        text = bytes(schema.data).decode("utf-8", "replace")
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
        "fields": [{"path": p.path, "type": p.type, "array": p.array} for p in fields],
    }


def _asked_as(field: dict[str, Any]) -> str:
    path, kind = str(field["path"]), str(field["type"])
    if "[" in kind and kind.startswith(("int", "uint", "float", "bool")):
        return ", ".join(f"{path}.{name}" for name in ("min", "max", "mean", "n"))
    return path


def _show_tables(store: Store, query: Query, _: _Given) -> None:
    """Print SQL for DuckDB about the Parquet files of a topic, and which recordings they lack."""
    from glob import escape

    from hybridlog.columns.layout import type_prefix
    from hybridlog.columns.tables import files_of
    from hybridlog.maintenance.opening import missing
    from hybridlog.query.query import channels_of
    from hybridlog.snapshot import UNFINISHED

    topic, *others = query.topics
    if others:
        raise UsageError(f"--tables is about one topic: name one of {listed(query.topics)}.")
    channels, place = channels_of(query), store.directory.path
    recordings = {one.recording.id: one.recording for one in channels}
    ended = {id_: one for id_, one in recordings.items() if one.status not in UNFINISHED}
    where = f"topic = {_quoted(topic)}"
    if query.question.recordings is not None:
        where += f" and recording in ({', '.join(map(_quoted, sorted(ended)))})"
    schemas = [one.channel.schema for one in channels if one.recording.id in ended]
    types = {type_prefix("" if schema is None else schema.name) for schema in schemas}
    folders: Counter[Path] = Counter()
    for file in files_of(place, types) if types else ():
        own = (one for one in file.sections if one.topic == topic and one.id in ended)
        folders[file.path.parent] += sum(one.rows for one in own)
    found = [
        {
            "folder": str(folder),
            "rows": rows,
            # The only texts in it are quoted, and nothing is run here.
            "statement": f"select * from {_quoted(f'{escape(str(folder))}/*.parquet')} where {where}",  # noqa: S608, E501
        }
        for folder, rows in folders.items()
        if rows
    ]
    tables = store.session.tables
    lacking = [one.name for one in ended.values() if topic in missing(store.directory, one, tables)]
    output.tell({"tables": found, "missing": lacking}, (f"{one['statement']};" for one in found))
    going = [one.name for id_, one in recordings.items() if id_ not in ended]
    if lacking:
        named = listed(lacking, _MAX_NAMES)
        output.note(f"Without {named}: `hybridlog verify --repair` makes their rows again.")
    if going:
        output.note(f"Without {listed(going)}: rows are added when a recording ends.")


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _show_losses(store: Store, given: _Given) -> None:
    """Print what is missing of topics, from when to when, and why."""
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
    Column("messages", lambda row: "unknown" if row["count"] is None else row["count"], "number"),
    Column("from", lambda loss: loss.get("from"), "second"),
    Column("for", _span, "duration"),
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
    last = total | {"recording": "", "topic": "", names[0].name: "total"}
    given.show([*rows, last] if rows else [], [*names, *_SIZES], store.session.when_empty)


_SIZES = [
    Column("messages", kind="number", order=1),
    Column("payload", "payload_bytes", "bytes", order=2),
    *(Column(f"{what}s", f"{what}_bytes", "bytes") for what in ("segment", "table")),
    Column("total", "total_bytes", "bytes"),
]


def _show_attachments(store: Store, given: _Given) -> None:
    """List attachments, or give the content of one."""
    there = [one for entry in given.recordings_in(store) for one in store.attachments(entry)]
    name = given.attachment
    if name is None:
        given.show([*map(_attachment_dict, there)], _ATTACHMENTS, "There are no attachments.")
        return
    found = [one for one in there if one.name == name]
    if len(found) != 1:
        many = f"{len(found)} attachments have" if found else "There is no attachment with"
        names = listed(output.quoted(one.name) for one in there)
        raise TopicError(f"{many} the name {output.quoted(name)}. There are: {names}.")
    if given.output is not None:
        check_room(given.output, force=given.force)
        found[0].save(given.output)
        output.note(f"{given.output}: {output.size(found[0].size)}")
    elif sys.stdout.isatty() and not found[0].media_type.startswith("text/"):
        raise UsageError(f"{found[0].name} may be no text: name a file with -o.")
    else:
        for piece in found[0].pieces():
            sys.stdout.buffer.write(piece)


def _attachment_dict(attachment: StoredAttachment) -> dict[str, Any]:
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
    Column("size", "bytes", "bytes"),
    Column("log time", lambda row: row["log_time_ns"] or None, "time"),
]
