"""`hybridlog trigger`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options, output
from hybridlog_storage.errors import UsageError


@click.command()
@click.argument("name", metavar="NAME", help="The reason, in a word.")
@options.running
@options.store
@options.quiet
def command(*, name: str, recording: tuple[str, ...], store: Path | None, quiet: bool) -> None:
    """Let a recorder write its ring to disk now."""
    from hybridlog.live.control_server import choose, request
    from hybridlog.store import store_path

    if not name.strip():
        raise UsageError("A trigger needs a name: give the reason in a word.")
    path = store_path(store)
    for recorder in choose(path, recording):
        answer = request(path, recorder, "trigger", reason=name)
        if not quiet:
            output.note(f"{answer['recording']} writes a snapshot.")
