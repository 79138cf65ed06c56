"""`hybridlog reindex`, `verify` and `rm`."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from hybridlog_storage.errors import UsageError

from hybridlog.cli import output

if TYPE_CHECKING:
    from hybridlog.maintenance import Progress


def _report(bar: output.Bar) -> Progress:
    return lambda recording, done, total: bar(done, recording)


def reindex(store: Path | None, mongo: str | None, *, as_json: bool, quiet: bool) -> None:
    """Make the index anew."""
    started = time.monotonic()
    with output.opened(store, mongo, needs_database=True) as opened:
        total = sum(r.stored_bytes for r in opened.recordings())
        with output.progress_bar("reindex", total, quiet=quiet) as bar:
            recordings = opened.reindex(_report(bar))
    messages = sum(r.messages for r in recordings)
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json(
            {"recordings": len(recordings), "messages": messages, "seconds": round(elapsed, 3)}
        )
    elif not quiet:
        print(f"{len(recordings)} recordings, {messages} messages indexed in {elapsed:.2f} s")


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
    with output.opened(store, mongo, needs_database=True) as opened:
        total = max((r.stored_bytes for r in opened.recordings()), default=0)
        with output.progress_bar("verify", total, quiet=quiet) as bar:
            result = opened.verify(recordings or None, _report(bar))
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json({**asdict(result), "seconds": round(elapsed, 3)})
    else:
        for finding in result.findings:
            print(output.printable(f"{finding.recording}: {finding.place}: {finding.problem}"))
        if not quiet:
            print(
                f"{result.recordings} recordings, {result.chunks} chunks, "
                f"{result.messages} messages, {output.size(result.bytes_read)} read in "
                f"{elapsed:.2f} s: "
                + (f"{len(result.findings)} problems" if result.findings else "all is well")
            )
    if result.findings:
        raise typer.Exit(1)


def remove(recordings: list[str], store: Path | None, mongo: str | None, *, yes: bool) -> None:
    """Delete recordings, after asking."""
    with output.opened(store, mongo, needs_database=True) as opened:
        chosen = opened.select(recordings)
        if not yes:
            names = ", ".join(r.id for r in chosen)
            if not sys.stdin.isatty():
                raise UsageError(f"Deleting {names} for good needs --yes.")
            typer.confirm(f"Delete {names} for good?", abort=True)
        for entry in chosen:
            opened.remove(entry.id)
            print(f"deleted {entry.id}")
