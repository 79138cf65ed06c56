"""`hybridlog trigger`."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlog.cli import output
from hybridlog.cli.binder import argument, command
from hybridlog.cli.options import Running
from hybridlog_storage.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class _Given(Running):
    name: str = argument("The reason, in a word.", "NAME")


@command(_Given)
def trigger_command(given: _Given) -> None:
    """Make a recorder write its ring.

    `hybridlog intervals --rehearse` says how often a trigger would have fired.
    """
    from hybridlog.live.control_server import choose, request
    from hybridlog.store import store_path

    if not given.name.strip():
        raise UsageError("A trigger needs a name: give the reason in a word.")
    path = store_path(given.store)
    for recorder in choose(path, given.recording):
        answer = request(path, recorder, "trigger", reason=given.name)
        if not given.quiet:
            output.note(f"{answer['recording']} writes a snapshot.")
