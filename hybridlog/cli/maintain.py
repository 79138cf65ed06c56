"""`hybridlog reindex`, `verify` and `rm`."""

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
from hybridlog_storage.errors import UsageError


def reindex(store: Path | None, mongo: str | None, *, as_json: bool, quiet: bool) -> None:
    """Make the index anew."""
    started = time.monotonic()
    with opened(store, mongo, needs_database=True, quiet=quiet) as view:
        total = sum(r.stored_bytes for r in view.recordings())
        try:
            with progress_bar("reindex", total, quiet=quiet) as bar:
                recordings = view.reindex(Stages(bar))
        except Stopped as stopped:
            stopped.consequence = "The next command that opens the store finishes the index."
            raise
    messages = sum(r.messages for r in recordings)
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json(
            {"recordings": len(recordings), "messages": messages, "seconds": round(elapsed, 3)}
        )
    elif not quiet:
        output.say(
            f"{output.counted(len(recordings), 'recording')}, "
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
    with opened(store, mongo, needs_database=True, quiet=quiet) as view:
        chosen = view.select(recordings) if recordings else view.recordings()
        total = sum(r.stored_bytes for r in chosen)
        with progress_bar("verify", total, quiet=quiet) as bar:
            result = view.verify(recordings or None, Stages(bar))
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json({**asdict(result), "seconds": round(elapsed, 3)})
    else:
        for finding in result.findings:
            output.say(f"{finding.recording}: {finding.place}: {finding.problem}")
        if not quiet:
            problems = output.counted(len(result.findings), "problem")
            output.say(
                f"{output.counted(result.recordings, 'recording')}, "
                f"{output.counted(result.chunks, 'chunk')}, "
                f"{output.counted(result.messages, 'message')}, "
                f"{output.size(result.bytes_read)} read in {elapsed:.2f} s: "
                f"{problems if result.findings else 'all is well'}"
            )
    if result.findings:
        raise typer.Exit(1)


def remove(recordings: list[str], store: Path | None, mongo: str | None, *, yes: bool) -> None:
    """Delete recordings, after asking."""
    with opened(store, mongo, needs_database=True) as view:
        chosen = view.select(recordings)
        if not yes:
            names = ", ".join(r.id for r in chosen)
            if not sys.stdin.isatty():
                raise UsageError(f"Deleting {names} for good needs --yes.")
            if not typer.confirm(f"Delete {names} for good?", err=True):
                output.note("Nothing is deleted.")
                raise typer.Exit(1)
        for entry in chosen:
            view.remove(entry.id)
            output.say(f"deleted {entry.id}")
