"""`hybridlog compact`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.query_options import recordings_of
from hybridlog.cli.signals import if_stopped

if TYPE_CHECKING:
    from hybridlog.maintenance.report import CompactedTopic
    from hybridlog.query.choice import Choice


@click.command()
@options.choice
@options.only_topics
@click.option(
    "--older-than",
    metavar="DURATION",
    help="Only recordings whose last message is at least this old, such as 1d.",
)
@click.option(
    "--drop-mcap",
    is_flag=True,
    help="Take payloads that are in columns out of the segments.",
)
@click.option("--dry-run", is_flag=True, help="Only say what would be done.")
@options.store
@options.mongo
@options.as_json
@options.quiet
def compact_command(
    *,
    choice: Choice,
    topic: tuple[str, ...],
    older_than: str | None,
    drop_mcap: bool,
    dry_run: bool,
    store: Path | None,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Write payloads into columns that any reader opens.

    Of ended recordings: laser scans, point clouds by their own fields, images, and other
    arrays of numbers. Every message is rebuilt from its columns and compared byte for byte
    before the columns are used. Without --topic, topics are chosen that consist of arrays
    mostly.
    """
    from hybridlog.query.times import parse_duration

    age = 0 if older_than is None else parse_duration(older_than)
    with (
        opened_store(store, mongo, quiet=quiet) as opened,
        if_stopped("Recordings that were finished have their columns; run it again."),
        progress_bar("compact", 0, quiet=quiet) as bar,
    ):
        found = opened.compact(
            None if choice.is_everything else recordings_of(opened, choice),
            topic or None,
            older_than_ns=age,
            drop_mcap=drop_mcap,
            dry_run=dry_run,
            progress=Stages(bar),
        )
    if as_json:
        output.print_json([asdict(one) for one in found])
        return
    for one in found:
        output.say(_told(one, dry_run=dry_run))
    if not found and not quiet:
        output.say("nothing to compact")


def _told(one: CompactedTopic, *, dry_run: bool) -> str:
    """A line about a topic."""
    parts = []
    if one.messages and dry_run:
        parts.append(f"{one.messages} messages would get columns")
    elif one.messages:
        parts.append(
            f"{one.messages} messages, {output.size(one.payload_bytes)}, in columns of "
            f"{output.size(one.column_bytes)}"
        )
    if one.dropped:
        parts.append(f"{one.dropped} messages taken out of the segments")
    if one.both:
        parts.append(f"{one.both} stay there, too: their chunks hold messages without columns")
    if one.kept:
        parts.append(f"{one.kept} without columns: {one.reason}")
    return f"{one.recording} {one.topic}: {'; '.join(parts)}"
