"""`hybridlog open`: recordings for viewers."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from hybridlog.cli import output
from hybridlog.cli.answers import check_room, write_answer
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.options import Filtered, Forced, Served
from hybridlog.cli.signals import ended_by_signal
from hybridlog.wording import listed
from hybridlog_storage.disk.unfinished import scratch_directory
from hybridlog_storage.errors import HybridlogError, MissingDependencyError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.view.playback.server import PlaybackServer

_WEBSOCKET: Final = "websocket"
_PLAYED: Final = (f"viewer={_WEBSOCKET}",)
_PORT: Final = 8765
_NAME_LENGTH: Final = 50  # characters; a file name has 255 bytes at most
_PLAY: Final = "`hybridlog open websocket` plays to the one in the browser"


_VIEWERS: Final[dict[str, tuple[Sequence[str], Sequence[str], str]]] = {
    "foxglove": (
        ["foxglove-studio", "lichtblick"],
        [],
        f"get it from https://foxglove.dev/download; {_PLAY}",
    ),
    "lichtblick": (
        ["lichtblick"],
        [],
        "get it from https://github.com/lichtblick-suite/lichtblick/releases",
    ),
    # It would listen on all interfaces for other programs.
    "rerun": (["rerun"], ["--bind", "127.0.0.1"], "pip install rerun-sdk"),
}
"""The programs of each viewer, one of which is enough, their options, and where to get one."""


@dataclass(frozen=True, kw_only=True)
class _Given(Filtered, Forced, Served):
    viewer: str = argument(
        "foxglove, lichtblick or rerun, which is started; websocket plays to those that "
        "connect. Where only Lichtblick is installed, foxglove is that.",
        "VIEWER",
        type=click.Choice([*sorted(_VIEWERS), _WEBSOCKET]),
    )
    path: Path | None = option(
        "Write the slice to this MCAP file, which stays; without, to one that does not.",
        "FILE",
        name="--output",
        short="-o",
        needs=("viewer=foxglove", "viewer=lichtblick", "viewer=rerun"),
    )
    origins: tuple[str, ...] = option(
        "With websocket: let web pages of this origin connect, such as https://viewer.example; "
        "Foxglove's may.",
        "URL",
        name="--allow-origin",
        needs=_PLAYED,
    )
    speed: float | None = option(
        "With websocket: times as fast as recorded, 0.01 to 100; viewers can change it.",
        "N",
        type=click.FloatRange(0.01, 100),
        needs=_PLAYED,
    )


@command(_Given)
def open_command(given: _Given) -> None:
    """Open a slice in Foxglove, Lichtblick or Rerun, or play it.

    A viewer has to be installed. The slice is written as an MCAP file first, and the command
    ends when the program does. `open websocket` plays recordings over a WebSocket, also to
    viewers in the browser: they play, pause, seek and change the speed. Ctrl-C ends it.
    """
    if given.path is not None:
        check_room(given.path, force=given.force)
    if given.viewer == _WEBSOCKET:
        _play(given)
        return
    from hybridlog.attachments import extras_of

    program = _find(given.viewer)
    folder = None if given.path is not None else scratch_directory()
    with given.opened(snapshot=True) as store:
        query = given.query(store)
        path = given.path
        if folder is not None:
            ids = query.recordings
            name = store.entry(ids[0]).name if len(ids) == 1 else "slice"
            path = folder.path / f"{name[:_NAME_LENGTH]}.mcap"
        assert path is not None
        write_answer(query, "mcap", path, extras=extras_of(query.source.now(), query.question))
        opened = f"{path}: {output.size(path.stat().st_size)}, opened with {program}"
        output.remarks([*query.completeness(is_empty=False).sentences, opened])
    ended = subprocess.run(  # noqa: S603
        [program, *_VIEWERS[given.viewer][1], path.absolute()], check=False
    )
    if folder is not None:
        folder.remove()
    if ended.returncode:
        raise HybridlogError(f"{program} ended with exit code {ended.returncode}.")


def _find(viewer: str) -> str:
    """The path of the program."""
    import shutil

    programs, _, cure = _VIEWERS[viewer]
    found = next(filter(None, map(shutil.which, programs)), None)
    if found is None:
        names = " or ".join(programs)
        raise MissingDependencyError(f"There is no program {names} on the PATH: {cure}.")
    return found


_MAX_SHOWN = 5  # topics


def _play(given: _Given) -> None:
    """Play to viewers, until a signal ends it."""
    import asyncio

    try:
        from hybridlog.view.playback.server import PlaybackOptions, PlaybackServer
    except ImportError as error:
        raise MissingDependencyError(
            "open websocket needs websockets: pip install 'hybridlog[foxglove]'"
        ) from error
    from hybridlog.view.playback.played import PlayedLog

    options = PlaybackOptions(
        port=_PORT if given.port is None else given.port,
        speed=given.speed or 1.0,
        origins=given.origins,
    )
    with given.opened() as store:
        query = given.query(store)
        log = PlayedLog(query)
        name = " ".join(["hybridlog", *given.choice.name])
        server = PlaybackServer(log, name, options, output.note)
        output.remarks([*query.completeness(is_empty=False).sentences, *unplayed(query)])
        asyncio.run(_until_signal(server))


async def _until_signal(server: PlaybackServer) -> None:
    """Serve until a signal comes."""
    import asyncio

    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    with ended_by_signal(lambda: loop.call_soon_threadsafe(stop.set)):
        await server.run(stop, _print_address)


def _print_address(port: int) -> None:
    from urllib.parse import quote

    address = f"ws://127.0.0.1:{port}"
    output.say(address)
    sys.stdout.flush()
    output.remarks(
        [
            f"In Foxglove or Lichtblick: Open connection, Foxglove WebSocket, {address}",
            "In a browser: https://app.foxglove.dev/?ds=foxglove-websocket&ds.url="
            f"{quote(address, safe='')}",
            "Ctrl-C ends it.",
        ]
    )


def unplayed(query: Query) -> list[str]:
    """The topics with messages that are left out, since their payload is gone, in a sentence."""
    from hybridlog.query.query import channels_of

    topics = {each.channel.topic for each in channels_of(query) if each.is_reduced}
    found = listed(sorted(topics), _MAX_SHOWN)
    said = f"Messages without their payload are not played; there are some of {found}."
    return [said] if topics else []
