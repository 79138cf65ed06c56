"""`hybridlog schema` and `tables`."""

from __future__ import annotations

import math
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.completion import complete_topic
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import query_of
from hybridlog.query.answers.infer_fields import infer_fields
from hybridlog_storage.errors import TopicError

if TYPE_CHECKING:
    from collections.abc import Collection

    from hybridlog.query.choice import Choice
    from hybridlog.query.question import RecordedChannel
    from hybridlog.store import Store


_READABLE = {"ros1msg", "ros2msg", "ros2idl", "jsonschema"}


@click.command()
@click.argument("topic", metavar="TOPIC", shell_complete=complete_topic, help="A topic.")
@options.store
@options.choice
@options.mongo
@options.as_json
def schema_command(
    *, topic: str, store: Path | None, choice: Choice, mongo: str | None, as_json: bool
) -> None:
    """Show a topic's message definition and its fields."""
    seen: dict[tuple[str, str | None], dict[str, Any]] = {}
    with opened_store(store, mongo, quiet=as_json) as opened:
        for recorded in query_of(opened, [topic], choice).channels():
            schema = recorded.channel.schema
            key = (
                recorded.channel.topic,
                recorded.recording.id if schema is None else repr(schema),
            )
            if key in seen:
                seen[key]["recordings"].append(recorded.recording.label)
            else:
                seen[key] = _describe(opened, recorded)
    if not seen:
        raise TopicError(f"No chosen recording has {topic}: `hybridlog info` lists the topics.")
    if as_json:
        output.print_json(list(seen.values()))
        return
    for item in seen.values():
        _print(item)


def _print(item: dict[str, Any]) -> None:
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


def _describe(store: Store, recorded: RecordedChannel) -> dict[str, Any]:
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


@click.command()
@options.one_topic
@options.store
@options.choice
@options.mongo
@options.as_json
def tables_command(
    *, topic: str, store: Path | None, choice: Choice, mongo: str | None, as_json: bool
) -> None:
    """Show a topic's Parquet files, and SQL for DuckDB."""
    from hybridlog.snapshot import UNFINISHED

    with opened_store(store, mongo, quiet=as_json) as opened:
        channels = query_of(opened, [topic], choice).channels()
        ended = [one for one in channels if one.recording.status not in UNFINISHED]
        for one in ended:  # made again where they are missing
            opened.session.table(one.recording, one.channel.topic)
        opened.mend(math.inf)
        opened.session.write_recordings_file()
        found = _found(opened, ended)
        others = len({one.recording.id for one in channels}) - len(
            {one.recording.id for one in ended}
        )
    if as_json:
        output.print_json(found)
        return
    if not found:
        raise TopicError(f"No chosen recording that has ended has a table of {topic}.")
    for item in found:
        for name in item["files"]:
            output.say(name)
        output.say()
        output.say(f"{item['statement']};")
        output.say()
    if others:
        left = output.counted(others, "unfinished recording")
        output.note(f"Without {left}: rows are added when a recording ends.")


def _found(store: Store, channels: Collection[RecordedChannel]) -> list[dict[str, Any]]:
    """Folders with rows of a topic in some recordings: files, rows, statement."""
    from hybridlog.columns.folders import files_of
    from hybridlog.columns.layout import type_prefix

    topics = {one.channel.topic for one in channels}
    recordings = {one.recording.id for one in channels}
    schemas = [one.channel.schema for one in channels]
    prefixes = {type_prefix("" if schema is None else schema.name) for schema in schemas}
    (name,) = topics or {""}
    folders: dict[Path, dict[str, Any]] = {}
    others: set[Path] = set()
    for file in files_of(store.directory.path, prefixes) if prefixes else ():
        sections = [one for one in file.about.recordings if name in one.topics]
        rows = sum(one.topics[name].rows for one in sections if one.id in recordings)
        if not all(one.id in recordings for one in sections):
            others.add(file.path.parent)
        if rows:
            folder = file.path.parent
            found = folders.setdefault(folder, {"folder": str(folder), "rows": 0, "files": []})
            found["rows"] += rows
            found["files"].append(str(file.path))
    chosen = f" and recording in ({', '.join(map(_quoted, sorted(recordings)))})"
    for folder, found in folders.items():
        files = _quoted(f"{escape(str(folder))}/*.parquet")
        # The only texts in it are quoted, and nothing is run here.
        statement = f"select * from {files} where topic = {_quoted(name)}"  # noqa: S608
        found["statement"] = statement + (chosen if folder in others else "")
    return list(folders.values())


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
