"""`hybridlog mark`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

from hybridlog.cli import options, output
from hybridlog.cli.options import (
    InStore,
    Quiet,
    argument,
    command,
    option,
)
from hybridlog.query.times import parse_duration
from hybridlog_storage.errors import StoreError, UsageError

if TYPE_CHECKING:
    pass


class _Mark(InStore, Quiet):
    recording: tuple[str, ...] = option(
        "Only this recorder (id or name of its recording).",
        "RECORDING",
        short="-r",
    )
    text: str = argument("What happened.", "TEXT")
    tags: tuple[str, ...] = option("Add KEY=VALUE to it.", "K=V", name="--set-tag")
    at: str | None = option(
        "Mark a recording, also a running one, at this time, written as for --between.", "T"
    )
    until: str | None = option("The mark lasts from --at to this time.", "T2", needs=("at",))
    pin: tuple[str, str] | None = option(
        "Mark and pin so much before and after the present moment; `keep --pin` pins other times.",
        "BEFORE AFTER",
        nargs=2,
        excludes=("at", "remove"),
    )
    remove: bool = option(
        "Remove the marks with this text; with --at only what begins at this time.",
        needs=("recording",),
        excludes=("tags", "until"),
    )


@command(_Mark)
def mark_command(given: _Mark) -> None:
    """Set a mark that queries can use, now or at a past time.

    A mark answers as a message on /hybridlog/marks: `hybridlog fetch scan --where
    "/hybridlog/marks: text = 'gripper slipped'" --within 5s`.
    """
    tags, at = options.parse_tags(given.tags), given.at
    if not given.text.strip():
        raise UsageError("A mark needs a text: say what happened.")
    if (given.remove or at is not None) and len(given.recording) != 1:
        raise UsageError("A mark at a time needs one recording: name it with --recording.")
    if given.remove:
        with given.opened() as store:
            store.unmark(given.recording[0], given.text, at)
        return
    if at is None:
        marked = _mark_running(given, tags)
    else:
        with given.opened() as store:
            entry = store.mark(given.recording[0], at, given.text, tags, until=given.until)
        marked = iter([entry.name])
    for name in marked:
        output.remarks([f"Marked in {name}."])


def _mark_running(given: _Mark, tags: dict[str, str]) -> Iterator[str]:
    """Mark what recorders write at this moment, and pin the time around it; yields their names."""
    from hybridlog.live.clocks import CLOCK
    from hybridlog.live.state import choose, read
    from hybridlog.maintenance.edit import mark_now
    from hybridlog.store import store_path
    from hybridlog_storage.remote import directory_of

    around = given.pin and (parse_duration(given.pin[0]), parse_duration(given.pin[1]))
    now, directory = time.time_ns(), directory_of(store_path(given.store))
    for recording in choose(directory, given.recording):
        at = now
        with suppress(StoreError):  # it has just begun
            simulated = read(directory.path, recording).sim_time
            at = now if simulated is None else simulated
        if at == 0:
            raise UsageError(f"There is no time of {CLOCK} yet: mark again when it has come.")
        yield mark_now(directory, recording, at, given.text, tags, around=around)
