"""`hybridlog top`: watches a running recorder; the state of a recorder as a table."""

from __future__ import annotations

import shutil
import sys
import textwrap
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.options import Place, argument, command, option
from hybridlog.cli.output import Column, table_lines
from hybridlog.cli.signals import Stopped
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.live.state import RecorderState

_EVERY_S = 1.0
_SHORT = 60  # characters of a reason


class _Given(Place):
    recording: str | None = argument(
        "One of several recorders: id or name of its recording.",
        "[RECORDING]",
    )
    once: bool = option("Show it once and end.")
    as_json: bool = option("A line of JSON a second, for scripts.", name="--json")


@command(_Given)
def top_command(given: _Given) -> None:
    """Watch a running recorder, until it ends, or Ctrl-C or SIGTERM.

    Without a terminal, and without --json, the state is shown once.
    """
    from hybridlog.live.state import choose, states
    from hybridlog.store import store_path
    from hybridlog_storage.remote import directory_of

    directory = directory_of(store_path(given.store))
    (name,) = choose(directory, [] if given.recording is None else [given.recording])
    is_once = given.once or not (given.as_json or sys.stdout.isatty())
    with suppress(Stopped), at_safe_points(), output.Drawn(error=False) as table:
        for state in states(directory, name, _EVERY_S):
            name = state.name
            if given.as_json:
                output.print_json(asdict(state), at_once=True)
            elif not is_once:
                draw(state, table)
            else:
                for line in _lines_of(state, output.screen_width()):
                    output.say(line)
            if is_once:
                return
        if not given.as_json:
            output.note(f"{name} has ended.")


def draw(state: RecorderState, table: output.Drawn) -> None:
    """Draw a state as a table."""
    width, height = shutil.get_terminal_size()
    table.draw(_lines_of(state, width, height - 1))


def _lines_of(state: RecorderState, width: int, height: int | None = None) -> list[str]:
    """A state as the lines of a table of topics, with others below it."""
    silent = (output.printable(f"{topic} is silent") for topic in state.silent)
    ends = [line for text in (summary(state), *silent) for line in textwrap.wrap(text, width)]
    topics = state.topics
    rows = len(topics) if height is None else max(height - 1 - len(ends), 4)
    if left := max(len(topics) - rows, 0):
        # Those with losses first, then those with most bytes; a line tells of the others.
        topics = sorted(topics, key=lambda t: (-t.lost, -t.bytes_per_s, t.topic))[: rows - 1]
        ends.insert(0, f"… and {output.counted(left + 1, 'more topic')}")
    shown = [one for one in _COLUMNS if any(map(one.cell, topics))]
    return [*table_lines([_TOPIC, *shown], topics, width), *ends]


_TOPIC: Final = Column("topic", lambda topic: topic.topic, cut=16)
_COLUMNS: Final = [
    Column("Hz", lambda topic: f"{topic.hz:.1f}", "number"),
    Column("MB/s", lambda topic: topic.bytes_per_s / 1e6, "rate", order=1),
    Column("messages", lambda topic: topic.messages, "number"),
    Column("thinned", lambda topic: topic.thinned or "", "number", order=2),
    Column("lost", lambda topic: topic.lost or "", "number"),
]


def summary(state: RecorderState) -> str:
    """One line for the whole recorder."""
    from hybridlog.record.losses import Cause

    reason = state.index_failure.partition("\n")[0].partition(". ")[0].rstrip(".")
    why = f": {output.cut(output.printable(reason), _SHORT)}" if reason else ""
    parts = [
        f"{state.elapsed_s:.0f} s",
        f"{state.hz:.0f} messages/s",
        f"{output.size(state.bytes_per_s)}/s",
        f"{output.size(state.stored_bytes)} stored",
        f"memory {100 * state.filled:.0f} %",
        f"index {state.lag} behind{why}" if state.lag or why else "index up to date",
        f"{output.size(state.free_bytes)} free",
    ]
    causes = {cause: count for cause, count in state.lost.items() if cause != Cause.THROTTLE}
    if causes:
        # A cause without a number stands for an unknown number.
        named = [f"{cause} {count or 'unknown'}" for cause, count in sorted(causes.items())]
        parts.append(f"lost {sum(causes.values()) or 'unknown'} ({', '.join(named)})")
    return " · ".join(parts)
