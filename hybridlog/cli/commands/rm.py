"""`hybridlog rm`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from hybridlog.cli import output
from hybridlog.cli.commands.ls import RECORDINGS
from hybridlog.cli.options import (
    Choosing,
    InStore,
    Quiet,
    command,
    names_argument,
    option,
    recordings_of,
)
from hybridlog.cli.output import print_table
from hybridlog.wording import listed
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingSummary
    from hybridlog_storage.manifest import Pin


class _Remove(Choosing, InStore, Quiet):
    names: tuple[str, ...] = names_argument(  # type: ignore[misc]
        what="These recordings", without="those that the options choose"
    )
    yes: bool = option("Do not ask.", short="-y")


@command(_Remove)
def rm_command(given: _Remove) -> None:
    """Delete recordings, payloads and index."""
    choice = given.choice
    if choice.is_everything:
        raise UsageError(
            "Name the recordings to delete, or choose them: -r 'monday*', --tag robot=7. "
            "`hybridlog ls` lists all; -r '*' is all of them."
        )
    with given.opened() as store:
        chosen = recordings_of(store, choice).summaries
        if not given.yes:
            pins = [pin for one in chosen for pin in store.entry(one.id).manifest.pins]
            _confirm(chosen, pins)
        for one in chosen:
            store.remove(one.id)
            output.tell(None, [f"deleted {one.name}"])


def _confirm(chosen: Sequence[RecordingSummary], pins: Sequence[Pin]) -> None:
    """Ask for consent, with what would be lost."""
    what = f"{listed(one.name for one in chosen)} for good"
    if pins:
        reasons = listed(filter(None, dict.fromkeys(pin.reason for pin in pins)))
        what += f", with {output.counted(len(pins), 'pin')} ({reasons})"
    if not sys.stdin.isatty():
        raise UsageError(f"Deleting {what} needs --yes.")
    print_table(RECORDINGS, chosen)
    if not click.confirm(f"Delete {what}?", err=True):
        output.note("Nothing is deleted.")
        raise click.exceptions.Exit(1)
