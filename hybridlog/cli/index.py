"""`hybridlog index`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options, output
from hybridlog.cli.completion import complete_topic
from hybridlog.cli.open_store import opened_store
from hybridlog_storage.errors import UsageError


@click.command()
@click.argument(
    "topic",
    required=False,
    metavar="[TOPIC]",
    shell_complete=complete_topic,
    help="A topic; without, list the indexes.",
)
@click.argument(
    "field", nargs=-1, metavar="[FIELD]...", help="Its fields, the most selective first."
)
@options.store
@click.option("--remove", is_flag=True, help="Drop this index.")
@options.mongo
@options.as_json
@options.quiet
def command(
    *,
    topic: str | None,
    field: tuple[str, ...],
    store: Path | None,
    remove: bool,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make, list or drop an index of a field.

    Queries of that field become faster.
    """
    if remove and not field:
        raise UsageError("--remove needs an index. Name the topic and the fields after it.")
    with opened_store(store, mongo, needs_database=True, quiet=quiet) as opened:
        if topic is None:
            found = opened.indexes()
        elif remove:
            if not opened.remove_index(topic, *field):
                known = ", ".join(" ".join(one.fields) for one in opened.indexes(topic)) or "none"
                raise UsageError(
                    f"{topic} has no index on {' '.join(field)}. Its indexes: {known}."
                )
            found = opened.indexes(topic)
        elif field:
            found = opened.add_index(topic, *field)
        else:
            found = opened.indexes(topic)
    if as_json:
        output.print_json([{"topic": one.topic, "fields": list(one.fields)} for one in found])
    elif found:
        output.print_table(
            (("topic", "whole"), ("fields", "left")),
            [(one.topic, " ".join(one.fields)) for one in found],
        )
    elif not quiet:
        output.say("no index on a field")
