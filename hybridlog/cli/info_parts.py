"""Parts of `hybridlog info`, by option: definitions, tables, losses, sizes, attachments."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.answers import check_room, writing
from hybridlog.cli.options import AsJson
from hybridlog.cli.render import Column, bytes_of, print_table
from hybridlog.record.losses import losses_of
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.attachments import StoredAttachment
    from hybridlog.maintenance.sizes import Size, Sizes
    from hybridlog.query.query import Query
    from hybridlog.query.question import RecordedChannel
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry


_MAX_NAMES = 5  # recordings in a note
_READABLE = {"ros1msg", "ros2msg", "ros2idl", "jsonschema"}


def show_topics(store: Store, query: Query, *, as_json: bool) -> None:
    """Print the definition and the fields of topics, those of each type once."""
    from hybridlog.query.query import channels_of

    seen: dict[tuple[str, str | None], dict[str, Any]] = {}
    for recorded in channels_of(query):
        schema = recorded.channel.schema
        key = (
            recorded.channel.topic,
            recorded.recording.id if schema is None else repr(schema),
        )
        if key in seen:
            seen[key]["recordings"].append(recorded.recording.name)
        else:
            seen[key] = _topic_as_dict(store, recorded)
    if not seen:
        raise TopicError(f"No chosen recording has {' or '.join(query.topics)}.")
    if as_json:
        output.print_json(list(seen.values()))
        return
    for number, item in enumerate(seen.values()):
        if number:
            output.say()
        _print_topic(item)


def _print_topic(item: dict[str, Any]) -> None:
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
        asked = "path" if item["observed"] else _asked_as
        columns = [Column("field", "path"), Column("type"), Column("asked as", asked)]
        print_table(columns, item["fields"])


def _topic_as_dict(store: Store, recorded: RecordedChannel) -> dict[str, Any]:
    from hybridlog.query.answers.infer_fields import infer_fields

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
        fields = infer_fields(store.query([channel.topic], [recorded.recording.id]))
    return {
        "topic": channel.topic,
        "type": schema.name if schema is not None else None,
        "message_encoding": channel.message_encoding,
        "schema_encoding": schema.encoding if schema is not None else None,
        "definition": text,
        "recordings": [recorded.recording.name],
        "not_indexed": codec.reason,
        "observed": observed,
        "arrays": channel.topic in store.directory.settings.arrays,
        "fields": fields,
    }


def _asked_as(field: dict[str, Any]) -> str:
    path, kind = str(field["path"]), str(field["type"])
    if "[" in kind and any(kind.startswith(n) for n in ("int", "uint", "float", "bool")):
        return f"{path}.min, {path}.max, {path}.mean, {path}.n"
    return path


def show_losses(entries: Sequence[RecordingEntry], topics: Sequence[str], given: AsJson) -> None:
    """Print what is missing of topics (patterns; none: all), from when to when, and why."""
    from hybridlog.query.topics import matcher

    fits = matcher(topics) if topics else None
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


def _duration(loss: Mapping[str, Any]) -> str:
    begin, end = loss.get("from"), loss.get("to")
    return "" if begin is None or end is None else output.short_duration(end - begin)


_LOSSES = [
    Column("recording"),
    Column("topic", lambda loss: loss.get("topic") or "any"),
    Column("cause"),
    Column("messages", lambda loss: "unknown" if loss["count"] is None else loss["count"], "right"),
    Column("from", lambda loss: output.short_time(loss.get("from")), "whole"),
    Column("for", _duration, "right"),
    Column("detail", lambda loss: ": ".join(filter(None, (loss.get("file"), loss.get("reason"))))),
]


def show_sizes(sizes: Sizes, by: str, given: AsJson, without: str) -> None:
    """Print the bytes by `recording`, by `topic`, or by `both`."""
    found = sizes.rows
    if by != "both":
        found = sizes.by_recording() if by == "recording" else sizes.by_topic()
    rows, total = [_size_as_dict(row) for row in found], _size_as_dict(sizes.total)
    if given.as_json:
        output.print_json({"rows": rows, "total": total})
        return
    names = [Column("recording"), Column("topic", lambda row: row.get("topic", "(no topic)"))]
    names = [one for one in names if by in {one.name, "both"}]
    last = total | {one.name: "" for one in names[1:]} | {names[0].name: "total"}
    columns = [column for column in _SIZES if column.name != "fields" or total["column_bytes"]]
    given.show([*rows, last] if rows else [], [*names, *columns], without)


def _size_as_dict(row: Size) -> dict[str, Any]:
    """A row for JSON, without empty names."""
    return {
        **{name: value for name, value in asdict(row).items() if value != ""},
        "total_bytes": row.total_bytes,
    }


_SIZES = [
    Column("messages", side="right", order=1),
    bytes_of("payload", "payload_bytes", order=2),
    bytes_of("segments", "segment_bytes"),
    bytes_of("fields", "column_bytes"),
    bytes_of("tables", "table_bytes"),
    bytes_of("MongoDB", "index_bytes"),
    bytes_of("total", "total_bytes"),
]


def show_attachments(
    found: list[StoredAttachment],
    name: str | None,
    target: Path | None,
    given: AsJson,
    *,
    force: bool,
) -> None:
    """List attachments, print the one that is named or fits a glob, or write some into files."""
    if name is not None:
        there, found = found, [each for each in found if each.name == name]
        found = found or [each for each in there if fnmatchcase(each.name, name)]
        if not found:
            names = listed(output.quoted(each.name) for each in there)
            raise TopicError(f"There is no attachment {output.quoted(name)}. There are: {names}.")
    if target is not None:
        _write(found, target, is_one=name is not None and len(found) == 1, force=force)
    elif name is None or given.as_json:
        given.show(list(map(attachment_as_dict, found)), _ATTACHMENTS, "There are no attachments.")
    elif len(found) > 1:
        raise UsageError(
            f"{len(found)} attachments have this name: -o DIR writes each of them into a file."
        )
    elif sys.stdout.isatty() and not found[0].media_type.startswith("text/"):
        raise UsageError(f"{found[0].name} may be no text: name a file with -o.")
    else:
        for piece in found[0].pieces():
            sys.stdout.buffer.write(piece)


def _write(found: list[StoredAttachment], target: Path, *, is_one: bool, force: bool) -> None:
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


def attachment_as_dict(attachment: StoredAttachment) -> dict[str, Any]:
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


def show_tables(store: Store, query: Query) -> None:
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
