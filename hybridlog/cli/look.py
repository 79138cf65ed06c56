"""`hybridlog ls`, `info` and `schema`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog_storage.errors import StoreError, TopicError

from hybridlog.cli import output

if TYPE_CHECKING:
    from hybridlog_storage.catalog import ChannelEntry, RecordingEntry


def list_recordings(store: Path | None, mongo: str | None, *, as_json: bool) -> None:
    """Print one line a recording."""
    from hybridlog.query.times import format_duration, format_time

    with output.opened(store, mongo) as opened:
        recordings = opened.recordings()
    if as_json:
        output.print_json([_brief(r) for r in recordings])
        return
    if not recordings:
        output.note("The store is empty: `hybridlog record FILE` fills it.")
        return
    rows = []
    for r in recordings:
        span = r.span
        rows.append(
            (
                r.id,
                format_time(span[0]) if span else "-",
                format_duration(span[1] - span[0]) if span else "-",
                str(len({c.topic for c in r.channels})),
                str(r.messages),
                output.size(r.stored_bytes),
                r.status,
                " ".join(f"{k}={v}" for k, v in sorted(r.tags.items())),
            )
        )
    output.print_table(
        [
            ("recording", "left"),
            ("start", "left"),
            ("duration", "right"),
            ("topics", "right"),
            ("messages", "right"),
            ("stored", "right"),
            ("status", "left"),
            ("tags", "left"),
        ],
        rows,
    )


def show_info(what: str | None, store: Path | None, mongo: str | None, *, as_json: bool) -> None:
    """Print what a recording or a segment file holds."""
    if what is not None and (what.endswith(".mcap") or "/" in what) and Path(what).is_file():
        _show_segment(Path(what), as_json=as_json)
        return
    with output.opened(store, mongo) as opened:
        chosen = opened.select([what]) if what is not None else opened.recordings()
        database = opened.database.name if opened.database is not None else None
        address = opened.database.address if opened.database is not None else None
    if as_json:
        full = [_full(r) for r in chosen]
        output.print_json(full[0] if what is not None else full)
        return
    if not chosen:
        output.note("The store is empty: `hybridlog record FILE` fills it.")
    for number, entry in enumerate(chosen):
        if number:
            output.note("")
        _print_recording(entry)
    if database is not None and chosen:
        output.note(f"index: database {database} at {address}")


def show_schema(
    topic: str,
    store: Path | None,
    recordings: list[str] | None,
    mongo: str | None,
    *,
    as_json: bool,
) -> None:
    """Print a topic's definition and the paths that can be asked about."""
    with output.opened(store, mongo) as opened:
        query = opened.topic(topic)
        if recordings:
            query = query.in_recording(*recordings)
        lanes = query.lanes()
    if not lanes:
        raise TopicError(f"No recording chosen has {topic}.")
    seen: dict[tuple[str, str | None], dict[str, Any]] = {}
    for lane in lanes:
        schema = lane.channel.schema
        key = (lane.channel.topic, lane.recording.id if schema is None else repr(schema))
        if key in seen:
            seen[key]["recordings"].append(lane.recording.id)
            continue
        text = None
        if schema is not None and schema.encoding in {"ros1msg", "ros2msg", "ros2idl", "jsonschema"}:
            text = bytes(schema.data).decode("utf-8", "replace")
        seen[key] = {
            "topic": lane.channel.topic,
            "type": schema.name if schema is not None else None,
            "message_encoding": lane.channel.message_encoding,
            "schema_encoding": schema.encoding if schema is not None else None,
            "definition": text,
            "recordings": [lane.recording.id],
            "not_indexed": lane.codec.reason,
            "fields": [
                {"path": p.path, "type": p.type, "array": p.array} for p in lane.codec.paths()
            ],
        }
    if as_json:
        output.print_json(list(seen.values()))
        return
    for item in seen.values():
        encoding = f"{item['message_encoding']}, {item['schema_encoding'] or 'no schema'}"
        print(output.printable(f"{item['topic']}  {item['type'] or '(no type)'}  ({encoding})"))
        if item["definition"]:
            for line in str(item["definition"]).splitlines():
                print("  " + output.printable(line))
        if item["not_indexed"]:
            print(f"not indexed: {output.printable(str(item['not_indexed']))}")
        if item["fields"]:
            print()
            output.print_table(
                [("field", "left"), ("type", "left"), ("asked as", "left")],
                [(f["path"], f["type"], _asked_as(f)) for f in item["fields"]],
            )
        print()


def _asked_as(field: dict[str, Any]) -> str:
    path, kind = str(field["path"]), str(field["type"])
    if "[" in kind and any(kind.startswith(n) for n in ("int", "uint", "float", "bool")):
        return f"{path}.min, {path}.max, {path}.mean, {path}.n"
    return path


def _brief(entry: RecordingEntry) -> dict[str, Any]:
    span = entry.span
    return {
        "recording": entry.id,
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
        "losses": entry.end.get("losses", []),
        "damage": entry.end.get("damage", []),
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
                "unreadable": c.stats.unreadable,
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


def _print_recording(entry: RecordingEntry) -> None:
    from hybridlog.query.times import format_duration, format_time

    span = entry.span
    losses = entry.end.get("losses", [])
    lost = sum(loss["count"] or 0 for loss in losses)
    unknown = any(loss["count"] is None for loss in losses)
    rows = [
        ("name", entry.name),
        ("status", entry.status),
        ("source", f"{entry.source['path']} ({entry.source['kind']}, "
                   f"{output.size(entry.source['bytes'])})"),
        ("start", format_time(span[0]) if span else "-"),
        ("last", format_time(span[1]) if span else "-"),
        ("duration", format_duration(span[1] - span[0]) if span else "-"),
        ("messages", str(entry.messages)),
        ("stored", f"{output.size(entry.stored_bytes)} in {entry.segments} segments, "
                   f"{entry.chunks} chunks"),
        ("coverage", _coverage(entry.messages, lost, places=len(losses), unknown=unknown)),
    ]
    if entry.tags:
        rows.append(("tags", " ".join(f"{k}={v}" for k, v in sorted(entry.tags.items()))))
    output.print_table([("recording", "left"), (entry.id, "left")], rows)
    for loss in losses:
        place = f" at byte {loss['offset']}" if loss["offset"] is not None else ""
        output.note(f"lost: {loss['count'] if loss['count'] is not None else '?'} messages, "
                    f"{loss['cause']}: {loss['file']}{place}: {loss['reason']}")
    print()
    output.print_table(
        [
            ("topic", "left"),
            ("type", "left"),
            ("messages", "right"),
            ("Hz", "right"),
            ("payload", "right"),
            ("log - header", "right"),
            ("note", "left"),
        ],
        [_channel_row(c) for c in sorted(entry.channels, key=lambda c: c.topic)],
    )


def _coverage(messages: int, lost: int, *, places: int, unknown: bool) -> str:
    if not places:
        return "complete"
    least = "at least " if unknown else ""
    share = 100 * messages / (messages + lost) if messages + lost else 0.0
    return f"{least}{lost} messages lost in {places} places ({share:.2f} % there)"


def _channel_row(channel: ChannelEntry) -> tuple[str, ...]:
    from hybridlog.query.times import format_duration

    stats = channel.stats
    rate = _rate(channel)
    notes = []
    if channel.reason is not None:
        notes.append(f"not indexed: {channel.reason}")
    if stats.unreadable:
        notes.append(f"{stats.unreadable} unreadable")
    if channel.metadata.get("latching") == "1":
        notes.append("latched")
    skew = "-"
    if stats.stamped:
        mean = round(stats.skew_sum / stats.stamped)
        skew = ("-" if mean < 0 else "") + format_duration(abs(mean))
    return (
        channel.topic,
        channel.type or channel.message_encoding,
        str(stats.messages),
        f"{rate:.2f}" if rate is not None else "-",
        output.size(stats.payload_bytes),
        skew,
        "; ".join(notes),
    )


def _show_segment(path: Path, *, as_json: bool) -> None:
    """What a segment file (or any sealed MCAP of ours) says of itself."""
    from hybridlog_storage.segment_reader import SegmentReader

    stem = path.name.split(".")[0]
    if path.name.endswith(".open"):
        raise StoreError(f"{path} is being written, or was left by a crash; open its store first.")
    with SegmentReader(path, int(stem) if stem.isdigit() else 0) as reader:
        summary = reader.summary()
        bytes_all = reader.size
    rows = [
        (c.topic, c.schema.name if c.schema else "", str(summary.counts.get(i, 0)),
         str(sum(i in place.channels for place in summary.chunks)))
        for i, c in sorted(summary.channels.items())
    ]
    if as_json:
        output.print_json(
            {
                "segment": str(path),
                "bytes": bytes_all,
                "recording": summary.recording,
                "end": summary.end,
                "chunks": len(summary.chunks),
                "channels": [
                    {"topic": t, "type": k, "messages": int(n), "chunks": int(m)}
                    for t, k, n, m in rows
                ],
            }
        )
        return
    output.print_table(
        [("segment", "left"), (str(path), "left")],
        [
            ("recording", str(summary.recording.get("id"))),
            ("bytes", output.size(bytes_all)),
            ("chunks", str(len(summary.chunks))),
            ("messages", str(sum(summary.counts.values()))),
        ],
    )
    print()
    output.print_table(
        [("topic", "left"), ("type", "left"), ("messages", "right"), ("chunks", "right")], rows
    )
