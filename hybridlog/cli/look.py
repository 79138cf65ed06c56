"""`hybridlog ls`, `info` and `schema`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog.cli import coverage, output
from hybridlog.cli.asking import question
from hybridlog.cli.observed import observed_fields
from hybridlog.cli.opening import opened
from hybridlog.cli.segment import show_segment
from hybridlog.latching import depth_of
from hybridlog.losses import Cause
from hybridlog_storage.errors import TopicError
from hybridlog_storage.messages import REDUCED, Channel

if TYPE_CHECKING:
    from hybridlog.query.question import RecordedChannel
    from hybridlog.store import Store
    from hybridlog_storage.catalog import ChannelEntry, RecordingEntry

_READABLE = {"ros1msg", "ros2msg", "ros2idl", "jsonschema"}
_STATUS = {
    "open": "being recorded",
    "damaged": "source damaged",
    "recovered": "cut short by a crash",
    "unfinished": "cut short by a crash, not recovered yet",
    "unproven": "journal lost",
}


def list_recordings(store: Path | None, mongo: str | None, *, as_json: bool) -> None:
    """Print one line a recording."""
    with opened(store, mongo, quiet=as_json) as view:
        recordings = view.recordings()
    if as_json:
        output.print_json([_brief(r) for r in recordings])
        return
    if not recordings:
        output.note("The store is empty: `hybridlog record FILE` fills it.")
        return
    narrow = output.is_narrow()
    columns: list[output.Column] = [
        ("recording", "left"),
        ("start", "whole"),
        ("duration", "right"),
        ("messages", "right"),
        ("note", "left"),
    ]
    if not narrow:
        columns.insert(3, ("topics", "right"))
        columns.insert(5, ("stored", "right"))
    output.print_table(columns, [_line(r, narrow=narrow) for r in recordings])


def _line(entry: RecordingEntry, *, narrow: bool) -> list[str]:
    span = entry.span
    notes = [] if entry.status == "complete" else [_status(entry)]
    if entry.name != entry.label:
        notes.append(entry.name)
    notes.extend(f"{key}={value}" for key, value in sorted(entry.tags.items()))
    known = not _is_unknown(entry)
    start = output.short_time(span[0], minutes=narrow) if span else "-"
    cells = [
        entry.label,
        start,
        output.short_duration(span[1] - span[0]) if span else "-",
        str(entry.messages) if known else "-",
        ", ".join(notes),
    ]
    if not narrow:
        cells.insert(3, str(len({c.topic for c in entry.channels})) if known else "-")
        cells.insert(5, output.size(entry.stored_bytes) if known else "-")
    return cells


def _is_unknown(entry: RecordingEntry) -> bool:
    """What a recording holds is written into the catalog when a segment is sealed."""
    return entry.status == "open" and not entry.channels


def show_info(what: str | None, store: Path | None, mongo: str | None, *, as_json: bool) -> None:
    """Print what a recording or a segment file holds."""
    if what is not None and _is_segment(what):
        show_segment(Path(what), as_json=as_json)
        return
    with opened(store, mongo, quiet=as_json) as view:
        chosen = view.select([what]) if what is not None else view.recordings()
        index = view.index_place
    if as_json:
        full = [_full(r) for r in chosen]
        output.print_json(full[0] if what is not None else full)
        return
    if not chosen:
        output.note("The store is empty: `hybridlog record FILE` fills it.")
    for number, entry in enumerate(chosen):
        if number:
            output.say()
        _print_recording(entry, index)


def _is_segment(what: str) -> bool:
    """A file by its path; the id of a recording has no slash, and may end in nothing of ours."""
    looks = "/" in what or what.endswith((".mcap", ".mcap.open"))
    return looks and Path(what).exists()


def show_schema(
    topic: str,
    store: Path | None,
    recordings: list[str] | None,
    mongo: str | None,
    *,
    as_json: bool,
) -> None:
    """Print a topic's definition and the paths that can be asked about."""
    seen: dict[tuple[str, str | None], dict[str, Any]] = {}
    with opened(store, mongo, quiet=as_json) as view:
        for recorded in question(view, [topic], recordings).channels():
            schema = recorded.channel.schema
            told = recorded.recording.id if schema is None else repr(schema)
            key = (recorded.channel.topic, told)
            if key in seen:
                seen[key]["recordings"].append(recorded.recording.label)
            else:
                seen[key] = _of_channel(view, recorded)
    if not seen:
        raise TopicError(f"No recording chosen has {topic}.")
    if as_json:
        output.print_json(list(seen.values()))
        return
    for item in seen.values():
        encoding = f"{item['message_encoding']}, {item['schema_encoding'] or 'no schema'}"
        output.say(f"{item['topic']}  {item['type'] or '(no type)'}  ({encoding})")
        if item["definition"]:
            for line in str(item["definition"]).splitlines():
                output.say("  " + line)
        if item["not_indexed"]:
            output.say(f"not indexed: {item['not_indexed']}")
        if item["fields"]:
            output.say()
            if item["observed"]:
                output.say("No definition fixes the fields. The first messages have these:")
            output.print_table(
                [("field", "left"), ("type", "left"), ("asked as", "left")],
                [
                    (f["path"], f["type"], f["path"] if item["observed"] else _asked_as(f))
                    for f in item["fields"]
                ],
            )
        output.say()


def _of_channel(store: Store, recorded: RecordedChannel) -> dict[str, Any]:
    channel, codec = recorded.channel, recorded.codec
    schema = channel.schema
    text = None
    if schema is not None and schema.encoding in _READABLE:
        text = bytes(schema.data).decode("utf-8", "replace")
    fields: list[dict[str, object]] = [
        {"path": p.path, "type": p.type, "array": p.array} for p in codec.paths()
    ]
    observed = codec.indexed and not fields
    if observed:
        fields = observed_fields(store.query([channel.topic], [recorded.recording.id]))
    return {
        "topic": channel.topic,
        "type": schema.name if schema is not None else None,
        "message_encoding": channel.message_encoding,
        "schema_encoding": schema.encoding if schema is not None else None,
        "definition": text,
        "recordings": [recorded.recording.label],
        "not_indexed": codec.reason,
        "observed": observed,
        "fields": fields,
    }


def _asked_as(field: dict[str, Any]) -> str:
    path, kind = str(field["path"]), str(field["type"])
    if "[" in kind and any(kind.startswith(n) for n in ("int", "uint", "float", "bool")):
        return f"{path}.min, {path}.max, {path}.mean, {path}.n"
    return path


def _status(entry: RecordingEntry) -> str:
    """The status of a recording, for people."""
    losses = entry.end.get("losses", ())
    if entry.status == "damaged" and any(loss["cause"] == Cause.SEGMENT for loss in losses):
        return "stored data lost"
    return _STATUS.get(entry.status, entry.status)


def _brief(entry: RecordingEntry) -> dict[str, Any]:
    span = entry.span
    return {
        "recording": entry.label,
        "id": entry.id,
        "name": entry.name,
        "tags": entry.tags,
        "status": entry.status,
        "start_ns": span[0] if span else None,
        "last_ns": span[1] if span else None,
        "topics": len({c.topic for c in entry.channels}),
        "messages": entry.messages,
        "stored_bytes": entry.stored_bytes,
        "segments": entry.segments,
        "source": entry.source,
        "created_ns": entry.created,
    }


def _full(entry: RecordingEntry) -> dict[str, Any]:
    return {
        **_brief(entry),
        "chunks": entry.chunks,
        "coverage": coverage.describe(entry, coverage.losses_of(entry)),
        "losses": coverage.losses_of(entry),
        "notes": entry.notes,
        "marks": entry.marks,
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
                "skew_ns": _skew(c),
                "unreadable": c.stats.unreadable if entry.is_decoded else None,
                "not_indexed": c.reason,
                "metadata": c.metadata,
            }
            for c in entry.channels
        ],
    }


def _rate(channel: ChannelEntry) -> float | None:
    """Mean rate in Hz: intervals over the time between first and last message."""
    stats = channel.stats
    if stats.messages < 2 or stats.first is None or stats.last is None or stats.last <= stats.first:
        return None
    return (stats.messages - 1) * 1e9 / (stats.last - stats.first)


def _skew(channel: ChannelEntry) -> dict[str, float | int | None] | None:
    """Log time minus header stamp, ns."""
    stats = channel.stats
    if not stats.stamped:
        return None
    return {
        "mean": stats.skew_sum / stats.stamped,
        "min": stats.skew_min,
        "max": stats.skew_max,
    }


def _print_recording(entry: RecordingEntry, index: str | None) -> None:
    from hybridlog.query.times import format_duration, format_time

    span = entry.span
    losses = coverage.losses_of(entry)
    source = entry.source
    status = _status(entry)
    if entry.status == "open":
        status += f"; `hybridlog top {entry.label}` shows it"
    held = (
        f"{output.size(entry.stored_bytes)} in {output.counted(entry.segments, 'segment')}, "
        f"{output.counted(entry.chunks, 'chunk')}"
    )
    rows = [
        ("id", entry.id),
        ("name", entry.name),
        ("status", status),
        ("source", _source(source)),
        ("start", format_time(span[0]) if span else "-"),
        ("last", format_time(span[1]) if span else "-"),
        ("duration", format_duration(span[1] - span[0]) if span else "-"),
        ("messages", "-" if _is_unknown(entry) else str(entry.messages)),
        ("stored", "-" if _is_unknown(entry) else held),
        ("coverage", coverage.describe(entry, losses)),
        *(("", coverage.line_of(loss)) for loss in losses),
        *(("tag", f"{key}={value}") for key, value in sorted(entry.tags.items())),
        *(("note", note["text"]) for note in entry.notes),
        ("index", index or "MongoDB is away"),
    ]
    output.print_table([("recording", "left"), (entry.label, "left")], rows)
    if not entry.channels:
        return
    output.say()
    narrow = output.is_narrow()
    columns: list[output.Column] = [
        ("topic", "left"),
        ("type", "left"),
        ("messages", "right"),
        ("Hz", "right"),
        ("log - header", "right"),
        ("note", "left"),
    ]
    if not narrow:
        columns.insert(4, ("payload", "right"))
    output.print_table(
        columns,
        [
            _channel_row(c, is_decoded=entry.is_decoded, narrow=narrow)
            for c in sorted(entry.channels, key=lambda c: c.topic)
        ],
    )


def _channel_row(channel: ChannelEntry, *, is_decoded: bool, narrow: bool) -> list[str]:
    stats = channel.stats
    rate = _rate(channel)
    notes = []
    if channel.reason is not None:
        notes.append(f"not indexed: {channel.reason}")
    if stats.unreadable:
        notes.append(f"{stats.unreadable} unreadable")
    if channel.message_encoding == REDUCED:
        notes.append("fields only")
    if depth_of(Channel(channel.topic, channel.message_encoding, None, channel.metadata)):
        notes.append("latched")
    skew = "-" if is_decoded else "?"
    if stats.stamped:
        skew = output.short_duration(round(stats.skew_sum / stats.stamped))
    kind = channel.type or channel.message_encoding
    cells = [
        channel.topic,
        kind.rpartition("/")[2] if narrow else kind,
        str(stats.messages),
        f"{rate:.2f}" if rate is not None else "-",
        skew,
        "; ".join(notes),
    ]
    if not narrow:
        cells.insert(4, output.size(stats.payload_bytes))
    return cells


def _source(source: Mapping[str, Any]) -> str:
    """Where a recording came from; a robot has no size, a program that records no address."""
    size = f", {output.size(source['bytes'])}" if source["bytes"] else ""
    kind = f"{source['kind']}{size}"
    return f"{source['path']} ({kind})" if source["path"] else kind
