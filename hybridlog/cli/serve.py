"""`hybridlog serve`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.answers import print_remarks
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked
from hybridlog.cli.signals import SIGNALS
from hybridlog.wording import listed
from hybridlog_storage.errors import MissingDependencyError

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice
    from hybridlog.view.playback.played import PlayedLog
    from hybridlog.view.playback.server import PlaybackServer

_MAX_SHOWN = 5  # topics


@click.command()
@options.only_recordings
@options.only_topics
@options.store
@options.between
@options.where
@options.choice
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8765,
    metavar="N",
    help="TCP port on this computer; 0 for a free one.",
)
@click.option(
    "--speed",
    type=click.FloatRange(0.01, 100),
    default=1.0,
    metavar="N",
    help="Times as fast as recorded, 0.01 to 100; viewers can change it.",
)
@click.option("--loop", is_flag=True, help="Begin again at the end.")
@click.option("--paused", is_flag=True, help="Wait until a viewer plays.")
@click.option(
    "--allow-origin",
    "origins",
    multiple=True,
    metavar="URL",
    help="Let a web page of this origin connect, such as https://viewer.example; Foxglove and "
    "pages of this computer may. Repeatable.",
)
@options.strict
@options.mongo
@options.quiet
def serve_command(
    *,
    choice: Choice,
    topic: tuple[str, ...],
    store: Path | None,
    between: tuple[str, str] | None,
    where: tuple[str, ...],
    port: int,
    speed: float,
    loop: bool,
    paused: bool,
    origins: tuple[str, ...],
    strict: bool,
    mongo: str | None,
    quiet: bool,
) -> None:
    """Play recordings to Foxglove or Lichtblick, over a WebSocket.

    Playback begins when a viewer subscribes. Viewers play, pause, seek and change the speed.
    Ctrl-C ends it.
    """
    try:
        from hybridlog.view.playback.server import PlaybackOptions, PlaybackServer
    except ImportError as error:
        raise MissingDependencyError(
            "serve needs websockets: pip install 'hybridlog[foxglove]'"
        ) from error
    import asyncio

    from hybridlog.view.playback.played import PlayedLog

    with opened_store(store, mongo, quiet=quiet, is_lasting=True) as opened:
        query = asked(opened, topic, choice, between=between, where=where, strict=strict)
        log = PlayedLog(query)
        name = " ".join(["hybridlog", *choice.name])
        how = PlaybackOptions(port=port, speed=speed, loops=loop, is_paused=paused, origins=origins)
        server = PlaybackServer(log, name, how, output.note)
        if not quiet:
            print_remarks(query, topic, is_empty=False)
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
