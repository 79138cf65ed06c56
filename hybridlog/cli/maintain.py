"""`hybridlog reindex`, `index`, `verify`, `repair` and `rm`."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from pathlib import Path

import typer

from hybridlog.cli import output
from hybridlog.cli.opening import opened
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.stopping import Stopped
from hybridlog_storage.errors import DatabaseError, UsageError


def reindex(
    recordings: list[str] | None,
    store: Path | None,
    mongo: str | None,
    *,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make the index again, recording by recording."""
    started = time.monotonic()
    with opened(store, mongo, needs_database=True, quiet=quiet) as view:
        chosen = view.select(recordings) if recordings else view.recordings()
        total = sum(r.stored_bytes for r in chosen)
        try:
            with progress_bar("reindex", total, quiet=quiet) as bar:
                done = view.reindex(recordings or None, Stages(bar))
        except Stopped as stopped:
            stopped.consequence = (
                "What was done is done; the next command that needs the index finishes the "
                "recording at which it was stopped."
            )
            raise
    left = [entry.label for entry in chosen if entry.id not in {r.id for r in done}]
    for label in left:
        output.note(f"Recording {label} is being written, and was left as it is.")
    for entry in done:
        if entry.status == "damaged":
            output.note(f"{entry.label} is damaged: `hybridlog losses {entry.label}` says where.")
    messages = sum(r.messages for r in done)
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json(
            {
                "recordings": len(done),
                "messages": messages,
                "left": left,
                "seconds": round(elapsed, 3),
            }
        )
    elif not quiet:
        output.say(
            f"{output.counted(len(done), 'recording')}, "
            f"{output.counted(messages, 'message')} indexed in {elapsed:.2f} s"
        )


def index(
    topic: str | None,
    fields: list[str],
    store: Path | None,
    mongo: str | None,
    *,
    drop: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make, drop or list indexes on fields."""
    if drop and not fields:
        raise UsageError("Which index? Name the topic and the fields after --remove.")
    with opened(store, mongo, needs_database=True, quiet=quiet) as view:
        if topic is None:
            found = view.indexes()
        elif drop:
            if not view.remove_index(topic, *fields):
                known = ", ".join(" ".join(one.fields) for one in view.indexes(topic)) or "none"
                raise UsageError(
                    f"{topic} has no index on {' '.join(fields)}. Its indexes: {known}."
                )
            found = view.indexes(topic)
        elif fields:
            found = view.add_index(topic, *fields)
        else:
            found = view.indexes(topic)
    if as_json:
        output.print_json([{"topic": one.topic, "fields": list(one.fields)} for one in found])
    elif found:
        output.print_table(
            (("topic", "whole"), ("fields", "left")),
            [(one.topic, " ".join(one.fields)) for one in found],
        )
    elif not quiet:
        output.say("no index on a field")


def verify(
    recordings: list[str] | None,
    store: Path | None,
    mongo: str | None,
    *,
    as_json: bool,
    quiet: bool,
) -> None:
    """Read and compare everything; exit 1 when something is off."""
    started = time.monotonic()
    with opened(store, mongo, quiet=quiet) as view:
        chosen = view.select(recordings) if recordings else view.recordings()
        total = sum(r.stored_bytes for r in chosen)
        with progress_bar("verify", total, quiet=quiet) as bar:
            result = view.verify(recordings or None, Stages(bar))
        why = view.without_database
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json({**asdict(result), "seconds": round(elapsed, 3)})
    else:
        for finding in result.findings:
            of = f"{finding.recording}: " if finding.recording else ""
            output.say(f"{of}{finding.place}: {finding.problem}; {finding.cure}")
        if not quiet:
            problems = output.counted(len(result.findings), "problem")
            where = "" if result.index else " in the files"
            output.say(
                f"{output.counted(result.recordings, 'recording')}, "
                f"{output.counted(result.chunks, 'chunk')}, "
                f"{output.counted(result.messages, 'message')}, "
                f"{output.size(result.bytes_read)} read in {elapsed:.2f} s: "
                f"{problems if result.findings else 'all is well' + where}"
            )
    if not result.index and (result.findings or why is None):
        output.note(f"The index was not compared: {why}")
    if result.findings:
        raise typer.Exit(1)
    if not result.index and why is not None:
        raise DatabaseError(f"The index was not compared: {why}")


def repair(
    recordings: list[str] | None,
    store: Path | None,
    mongo: str | None,
    *,
    moved: bool,
    new_id: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Apply the cures that lose nothing; exit 1 when something is left."""
    if moved and new_id:
        raise UsageError("A store was moved, or it is a copy: --moved or --new-id, not both.")
    if new_id:
        from hybridlog.maintenance.lease import become_another
        from hybridlog.store import store_path

        become_another(store_path(store), mongo)
        output.say("the store has an id of its own now")
    with opened(store, mongo, quiet=quiet) as view:
        if moved:
            view.take_over()
            output.say("the index belongs to the store at this place now")
        with progress_bar("repair", 0, quiet=quiet) as bar:
            done = view.repair(recordings or None, Stages(bar))
    left = [one for one in done if not one.is_cured]
    if as_json:
        output.print_json([asdict(one) for one in done])
    else:
        for one in done:
            mark = "left" if not one.is_cured else "mended"
            of = f"{one.recording}: " if one.recording else ""
            output.say(f"{of}{one.place}: {mark}: {one.done}")
        if not done and not quiet:
            output.say("nothing to mend")
    if left:
        raise typer.Exit(1)


def remove(recordings: list[str], store: Path | None, mongo: str | None, *, yes: bool) -> None:
    """Delete recordings, after asking."""
    with opened(store, mongo) as view:
        copies = [name for name in recordings if name in view.repairs.copies]
        chosen = view.select([name for name in recordings if name not in copies])
        labels = copies + [entry.label for entry in chosen]
        names = ", ".join(labels)
        if not yes:
            if not sys.stdin.isatty():
                raise UsageError(f"Deleting {names} for good needs --yes.")
            if not typer.confirm(f"Delete {names} for good?", err=True):
                output.note("Nothing is deleted.")
                raise typer.Exit(1)
        for label in labels:
            try:
                view.remove(label)
            except Stopped as stopped:
                stopped.consequence = (
                    "A recording whose removal began is gone; the next command that opens the "
                    "store removes the rest of it."
                )
                raise
            output.say(f"deleted {label}")
