"""`hybridlog open websocket`: plays recordings to viewers that connect."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.answers import print_remarks
from hybridlog.cli.signals import SIGNALS
from hybridlog.wording import listed
from hybridlog_storage.errors import MissingDependencyError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.query.query import Query
    from hybridlog.view.playback.played import PlayedLog
    from hybridlog.view.playback.server import PlaybackServer

_MAX_SHOWN = 5  # topics


def check_installed() -> None:
    """Refuse to play without the package for it.

    Raises:
        MissingDependencyError: It is missing.
    """
    try:
        import hybridlog.view.playback.server  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "open websocket needs websockets: pip install 'hybridlog[foxglove]'"
        ) from error


def play(
    query: Query, names: Sequence[str], topics: Sequence[str], *, quiet: bool, **how: Any
) -> None:
    """Play a query to viewers, until a signal ends it.

    Args:
        query: The messages.
        names: Of the recordings, as typed.
        topics: As typed.
        quiet: Only print the address.
        how: Of `PlaybackOptions`.
    """
    import asyncio

    from hybridlog.view.playback.played import PlayedLog
    from hybridlog.view.playback.server import PlaybackOptions, PlaybackServer

    log = PlayedLog(query)
    name = " ".join(["hybridlog", *names])
    server = PlaybackServer(log, name, PlaybackOptions(**how), output.note)
    if not quiet:
        print_remarks(query, topics, is_empty=False)
        _print_undefined(log)
    asyncio.run(_until_signal(server, quiet=quiet))


async def _until_signal(server: PlaybackServer, *, quiet: bool) -> None:
    """Serve until a signal comes; a second one ends the process at once."""
    import asyncio
    import signal

    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    before = {number: signal.getsignal(number) for number in SIGNALS}

    def end() -> None:
        stop.set()
        for number, handler in before.items():
            loop.remove_signal_handler(number)
            signal.signal(number, handler)

    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            loop.add_signal_handler(number, end)
    await server.run(stop, lambda port: _print_address(port, quiet=quiet))


def _print_address(port: int, *, quiet: bool) -> None:
    from urllib.parse import quote

    address = f"ws://127.0.0.1:{port}"
    output.say(address)
    sys.stdout.flush()
    if not quiet:
        url = f"https://app.foxglove.dev/?ds=foxglove-websocket&ds.url={quote(address, safe='')}"
        output.note(f"In Foxglove or Lichtblick: Open connection, Foxglove WebSocket, {address}")
        output.note(f"In a browser: {url}")
        output.note("Ctrl-C ends it.")


def _print_undefined(log: PlayedLog) -> None:
    """Print the topics that a viewer cannot show, since nothing defines their messages."""
    topics = {
        each.channel.topic
        for each in log.channels
        if each.channel.message_encoding != "json"
        and (each.channel.schema is None or not each.channel.schema.data)
    }
    if topics:
        output.note(
            f"Viewers cannot show {listed(sorted(topics), _MAX_SHOWN)}: there is no definition."
        )
