"""`hybridlog mark`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hybridlog.cli import output


def run(
    text: str, tags: list[str], recordings: Sequence[str], store: Path | None, *, quiet: bool
) -> None:
    """Set a mark in the recordings that are meant."""
    from hybridlog.cli.record import tags_of
    from hybridlog.live.door import choose, visit
    from hybridlog.store import store_path
    from hybridlog_storage.directory import StoreDirectory

    pairs = tags_of(tags)
    directory = StoreDirectory(store_path(store))
    for recording in choose(directory, recordings):
        answer = visit(recording, "mark", text=text, tags=pairs)
        if not quiet:
            output.note(f"Marked in {answer['recording']}.")
