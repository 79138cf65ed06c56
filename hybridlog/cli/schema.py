"""`hybridlog schema`."""

from __future__ import annotations

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
