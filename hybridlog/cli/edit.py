"""`hybridlog rename`, `tag`, `untag`, `note`, `mark --at` and `import`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from hybridlog.cli import output
from hybridlog.cli.opening import opened
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.stopping import Stopped
from hybridlog_storage.errors import UsageError


def rename(recording: str, name: str, store: Path | None, *, quiet: bool) -> None:
    """Give a recording another name."""
    if not name.strip():
        raise UsageError("A recording needs a name.")
    with opened(store, None, quiet=quiet) as view:
        entry = view.rename(recording, name)
    if not quiet:
        output.say(f"renamed to {entry.label}")


def tag(
    recording: str, pairs: list[str], store: Path | None, *, as_json: bool, quiet: bool
) -> None:
    """Keep tags with a recording, or show those it has."""
    from hybridlog.cli.record import tags_of

    with opened(store, None, quiet=quiet) as view:
        if pairs:
            tags = view.tag(recording, **tags_of(pairs)).tags
        else:
            tags = view.select([recording])[0].tags
    if as_json:
        output.print_json(tags)
    elif not quiet:
        for key, value in sorted(tags.items()):
            output.say(f"{key}={value}")


def untag(recording: str, keys: Sequence[str], store: Path | None, *, quiet: bool) -> None:
    """Remove tags of a recording."""
    with opened(store, None, quiet=quiet) as view:
        view.untag(recording, *keys)


def note(recording: str, text: str, store: Path | None, *, quiet: bool) -> None:
    """Write a note about a recording."""
    if not text.strip():
        raise UsageError("A note needs a text.")
    with opened(store, None, quiet=quiet) as view:
        view.note(recording, text)


def mark(
    text: str,
    tags: list[str],
    recordings: Sequence[str],
    moment: str,
    store: Path | None,
    *,
    quiet: bool,
) -> None:
    """Set a mark at a time of a recording that has ended."""
    from hybridlog.cli.record import tags_of

    if not text.strip():
        raise UsageError("A mark needs a text: say what happened.")
    if len(recordings) != 1:
        raise UsageError("Which recording? A mark at a time needs one --recording.")
    with opened(store, None, quiet=quiet) as view:
        entry = view.mark(recordings[0], moment, text, tags_of(tags))
    if not quiet:
        output.note(f"Marked in {entry.label}.")


def import_store(
    other: Path,
    recordings: list[str] | None,
    store: Path | None,
    *,
    as_json: bool,
    quiet: bool,
) -> None:
    """Copy recordings in from another store."""
    with opened(store, None, create=True, quiet=quiet) as view:
        try:
            with progress_bar("import", 0, quiet=quiet) as bar:
                report = view.import_from(other, recordings or None, Stages(bar))
        except Stopped as stopped:
            stopped.consequence = "Run the command again: what was copied is not copied again."
            raise
    if as_json:
        output.print_json(asdict(report))
    elif not quiet:
        for label in report.imported:
            output.say(f"imported {label}")
        for label in report.known:
            output.say(f"{label} is here already")
