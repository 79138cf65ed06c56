"""`hybridlog edit`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.options import (
    InStore,
    Quiet,
    command,
    one_recording,
    option,
)
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    pass


class _Edit(InStore, Quiet):
    recording: str = one_recording()
    name: str | None = option("Give it this name.", "NAME")
    note: str | None = option("Write a note about it; `info` shows notes.", "TEXT")


@command(_Edit)
def edit_command(given: _Edit) -> None:
    """Give a recording another name, or write a note about it.

    The name is what people call it; nothing else of the recording changes.
    """
    if given.name is None and given.note is None:
        raise UsageError("Say what to change: --name NAME or --note TEXT.")
    with given.opened() as store:
        entry = store.edit(given.recording, name=given.name, note=given.note)
    output.tell(None, [] if given.name is None else [f"renamed to {entry.name}"])
