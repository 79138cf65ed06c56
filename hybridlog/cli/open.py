"""`hybridlog open`."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import click

from hybridlog.cli import output
from hybridlog.cli.answers import check_room, not_written, print_remarks, write_answer
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.options import Filtered, Forced, Served
from hybridlog.cli.serve import check_installed, play
from hybridlog.cli.signals import if_stopped
from hybridlog.formats.slices import SliceCache
from hybridlog_storage.errors import HybridlogError, MissingDependencyError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.store import Store

_WEBSOCKET: Final = "websocket"
_PORT: Final = 8765
_PLAY: Final = "`hybridlog open websocket` plays to the one in the browser"


class _Viewer(NamedTuple):
    """A viewer: its programs, one of which is enough, their options, and where to get one."""

    programs: Sequence[str]
    options: Sequence[str]
    cure: str


_VIEWERS: Final = {
    "foxglove": _Viewer(
        ("foxglove-studio", "lichtblick"), (), f"get it from https://foxglove.dev/download; {_PLAY}"
    ),
    "lichtblick": _Viewer(
        ("lichtblick",),
        (),
        "get it from https://github.com/lichtblick-suite/lichtblick/releases",
    ),
    # It would listen on all interfaces for other programs.
    "rerun": _Viewer(("rerun",), ("--bind", "127.0.0.1"), "pip install rerun-sdk"),
}


@dataclass(frozen=True, kw_only=True)
class _Given(Filtered, Forced, Served):
    viewer: str = argument(
        "foxglove, lichtblick or rerun, which is started; websocket plays to those that "
        "connect. Where only Lichtblick is installed, foxglove is that.",
        "VIEWER",
        type=click.Choice([*sorted(_VIEWERS), _WEBSOCKET]),
    )
    path: Path | None = option(
        "Write the slice to this MCAP file; without, into the user's cache.",
        "FILE",
        name="--output",
        short="-o",
    )
    speed: float | None = option(
        "With websocket: times as fast as recorded, 0.01 to 100; viewers can change it.",
        "N",
        type=click.FloatRange(0.01, 100),
    )
    loop: bool = option("With websocket: begin again at the end.")
    paused: bool = option("With websocket: wait until a viewer plays.")


@command(_Given)
def open_command(given: _Given) -> None:
    """Open a slice in Foxglove, Lichtblick or Rerun, or play it.

    A viewer has to be installed. The slice is written as an MCAP file first, and the command
    ends when the program does. `open websocket` plays recordings over a WebSocket, also to
    viewers in the browser: they play, pause, seek and change the speed. Ctrl-C ends it.
    """
    _check(given)
    if given.viewer == _WEBSOCKET:
        check_installed()
        with given.opened(is_lasting=True) as store:
            play(
                given.query(store),
                given.choice.name,
                given.topics,
                quiet=given.quiet,
                port=_PORT if given.port is None else given.port,
                speed=given.speed or 1.0,
                loops=given.loop,
                is_paused=given.paused,
                origins=given.origins,
            )
        return
    program = _find(given.viewer)
    with given.opened() as store:
        query = given.query(store)
        path = _written(store, query, given)
        if not given.quiet:
            print_remarks(query, given.topics, is_empty=False)
            output.note(f"{path}: {output.size(path.stat().st_size)}, opened with {program}")
    ended = subprocess.run(  # noqa: S603
        [program, *_VIEWERS[given.viewer].options, path.absolute()], check=False
    )
    if ended.returncode:
        raise HybridlogError(f"{program} ended with exit code {ended.returncode}.")


def _check(given: _Given) -> None:
    """Refuse options of the other way to show a slice.

    Raises:
        UsageError: There are some, or the output exists.
    """
    if given.viewer == _WEBSOCKET:
        if given.path is not None:
            raise UsageError("--output is the file for a viewer; websocket writes none.")
        return
    if given.port is not None or given.speed or given.loop or given.paused or given.origins:
        raise UsageError(
            "--port, --speed, --loop, --paused and --allow-origin are for `open websocket`."
        )
    if given.path is not None:
        check_room(given.path, force=given.force)


def _written(store: Store, query: Query, given: _Given) -> Path:
    """The slice as an MCAP file."""

    def write(query: Query, path: Path) -> None:
        write_answer(query, "mcap", path, extras=query.extras(), quiet=given.quiet)

    if given.path is None:
        ids = query.recordings
        name = store.entry(ids[0]).label if len(ids) == 1 else "slice"
        return SliceCache().get(query, name, write)
    with if_stopped(partial(not_written, given.path)):
        write(query, given.path)
    return given.path


def _find(viewer: str) -> str:
    """The path of the program.

    Raises:
        MissingDependencyError: It is not installed.
    """
    import shutil

    programs, _, cure = _VIEWERS[viewer]
    for name in programs:
        found = shutil.which(name)
        if found is not None:
            return found
    names = " or ".join(programs)
    raise MissingDependencyError(f"There is no program {names} on the PATH: {cure}.")
