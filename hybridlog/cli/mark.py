"""`hybridlog mark` and `trigger`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hybridlog.cli import output
from hybridlog_storage.errors import UsageError


def run(
    text: str, tags: list[str], recordings: Sequence[str], store: Path | None, *, quiet: bool
) -> None:
    """Set a mark in the recordings that are meant."""
    from hybridlog.cli.record import tags_of
    from hybridlog.live.control_server import choose, request
    from hybridlog.store import store_path

    if not text.strip():
        raise UsageError("A mark needs a text: say what happened.")
    pairs = tags_of(tags)
    path = store_path(store)
    for name in choose(path, recordings):
        answer = request(path, name, "mark", text=text, tags=pairs)
        if not quiet:
            output.note(f"Marked in {answer['recording']}.")


def fire(name: str, recorders: Sequence[str], store: Path | None, *, quiet: bool) -> None:
    """Let the recorders that are meant write a snapshot."""
    from hybridlog.live.control_server import choose, request
    from hybridlog.store import store_path

    if not name.strip():
        raise UsageError("A trigger needs a name: say why, in a word.")
    path = store_path(store)
    for recorder in choose(path, recorders):
        answer = request(path, recorder, "trigger", reason=name)
        if not quiet:
            output.note(f"{answer['recording']} writes a snapshot.")
