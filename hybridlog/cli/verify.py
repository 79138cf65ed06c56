"""`hybridlog verify`."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.query_options import recordings_of
from hybridlog.wording import listed
from hybridlog_storage.errors import DatabaseError, WithoutMongoError

if TYPE_CHECKING:
    from hybridlog.maintenance.verify import Verification
    from hybridlog.query.choice import Choice


@click.command()
@options.only_recordings
@options.choice
@options.store
@options.mongo
@options.as_json
@options.quiet
def verify_command(
    *,
    choice: Choice,
    store: Path | None,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Read everything, check checksums and references.

    Exits with 1 when it finds a problem, and prints a cure for each.
    """
    started = time.monotonic()
    with opened_store(store, mongo, quiet=quiet) as opened:
        chosen = recordings_of(opened, choice)
        total = sum(entry.stored_bytes for entry in chosen.summaries)
        with progress_bar("verify", total, quiet=quiet) as bar:
            result = opened.verify(None if choice.is_everything else chosen, Stages(bar))
        why = opened.without_database
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json({**asdict(result), "seconds": round(elapsed, 3)})
    else:
        _print(result, elapsed, quiet=quiet)
        running = [one.label for one in chosen.summaries if one.status == "open"]
        if running and not quiet:
            output.note(f"Still being recorded, and checked as far as sealed: {listed(running)}.")
    is_wanted = not isinstance(why, WithoutMongoError)
    if not result.index and is_wanted and (result.findings or why is None):
        output.note(f"The index was not compared: {why}")
    if result.findings:
        raise click.exceptions.Exit(1)
    if not result.index and is_wanted and why is not None:
        raise DatabaseError(f"The index was not compared: {why}")


def _print(result: Verification, elapsed: float, *, quiet: bool) -> None:
    for finding in result.findings:
        of = f"{finding.recording}: " if finding.recording else ""
        output.say(f"{of}{finding.place}: {finding.problem}; {finding.cure}")
    if quiet:
        return
    verdict = "all is well" if result.index else "all is well in the files"
    if result.findings:
        verdict = output.counted(len(result.findings), "problem")
    output.say(
        f"{output.counted(result.recordings, 'recording')}, "
        f"{output.counted(result.chunks, 'chunk')}, "
        f"{output.counted(result.messages, 'message')}, "
        f"{output.size(result.bytes_read)} read in {elapsed:.2f} s: {verdict}"
        f"{output.without_documents(result.without_documents)}"
    )
