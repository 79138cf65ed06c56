"""`hybridlog open`: recordings for viewers."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final

import click

from hybridlog.cli import output
from hybridlog.cli.options import (
    Filtered,
    Served,
    command,
    option,
)
from hybridlog.cli.signals import ended_by_signal
from hybridlog.wording import listed
from hybridlog_storage.errors import extra

if TYPE_CHECKING:
    from hybridlog.query.query import Query


_PORT: Final = 8765
_MAX_SHOWN = 5  # topics


class _Open(Filtered, Served):
    speed: float = option(
        "Times as fast as recorded, 0.01 to 100; viewers can change it.",
        "N",
        type=click.FloatRange(0.01, 100),
        default=1.0,
    )
    origins: tuple[str, ...] = option(
        "Let web pages of this origin connect, such as https://viewer.example; Foxglove's may.",
        "URL",
        name="--allow-origin",
    )


@command(_Open)
def open_command(given: _Open) -> None:
    """Play a slice to Foxglove or Lichtblick, over a WebSocket.

    Also to viewers in the browser: they play, pause, seek and change the speed. Ctrl-C ends it.
    """
    import asyncio

    with extra("foxglove", "open needs websockets"):
        from hybridlog.view.playback import PlaybackServer, PlayedLog

    async def serve() -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        with ended_by_signal(lambda: loop.call_soon_threadsafe(stop.set)):
            await server.run(stop, _print_address)

    with given.opened() as store:
        query = given.query(store)
        server = PlaybackServer(
            PlayedLog(query),
            " ".join(["hybridlog", *given.choice.name]),
            output.note,
            port=_PORT if given.port is None else given.port,
            speed=given.speed,
            origins=given.origins,
        )
        output.remarks([*query.completeness().sentences, *unplayed(query)])
        asyncio.run(serve())


def _print_address(port: int) -> None:
    address = f"ws://127.0.0.1:{port}"
    output.say(address)
    sys.stdout.flush()
    output.remarks([f"Foxglove or Lichtblick: Open connection, {address}. Ctrl-C ends it."])


def unplayed(query: Query) -> list[str]:
    """The topics with messages that are left out, since their payload is gone, in a sentence."""
    from hybridlog.query.query import channels_of

    topics = {each.channel.topic for each in channels_of(query) if each.is_reduced}
    found = listed(sorted(topics), _MAX_SHOWN)
    said = f"Messages without their payload are not played; there are some of {found}."
    return [said] if topics else []
