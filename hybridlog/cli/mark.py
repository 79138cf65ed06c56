"""`hybridlog mark`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog_storage.errors import UsageError


@click.command()
@click.argument("text", metavar="TEXT", help="What happened.")
@options.tags
@options.running
@click.option(
    "--at",
    metavar="T",
    help="Mark a recording that has ended, at this time, written as for --between.",
)
@options.store
@options.quiet
def mark_command(
    *,
    text: str,
    tag: tuple[str, ...],
    recording: tuple[str, ...],
    at: str | None,
    store: Path | None,
    quiet: bool,
) -> None:
    """Set a mark that queries can use, now or at a past time.

    A mark is a message on /hybridlog/marks: `hybridlog fetch -t scan --where
    "/hybridlog/marks: text = 'gripper slipped'" --within 5s`.
    """
    tags = options.parse_tags(tag)
    if not text.strip():
        raise UsageError("A mark needs a text: say what happened.")
    if at is None:
        labels = _mark_running(text, tags, recording, store)
    elif len(recording) == 1:
        with opened_store(store, None, quiet=quiet) as opened:
            labels = iter([opened.mark(recording[0], at, text, tags).label])
    else:
        raise UsageError("A mark at a time needs one recording: name it with --recording.")
    for label in labels:
        if not quiet:
            output.note(f"Marked in {label}.")


def _mark_running(
    text: str, tags: dict[str, str], recordings: tuple[str, ...], store: Path | None
) -> Iterator[str]:
    from hybridlog.live.control_server import choose, request
    from hybridlog.store import store_path

    path = store_path(store)
    for name in choose(path, recordings):
        yield str(request(path, name, "mark", text=text, tags=tags)["recording"])
