"""The state of a recorder as a table that updates in place."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Self

from hybridlog.cli import output
from hybridlog.cli.render import Column, table_lines
from hybridlog.record.losses import Cause

if TYPE_CHECKING:
    from hybridlog.live.state import RecorderState

_SHORT = 60  # characters of a reason


class LiveTable:
    """The table; a context manager that removes it at the end."""

    def __init__(self, *, error: bool = True) -> None:
        from rich.live import Live

        self._live = Live(
            console=output.console(error=error), auto_refresh=False, transient=True, screen=False
        )

    def __enter__(self) -> Self:
        """Begin to draw."""
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the table."""
        self._live.stop()

    def show(self, state: RecorderState, below: Sequence[str] = ()) -> None:
        """Draw a state, with lines below it."""
        from rich.text import Text

        size = self._live.console.size
        lines = drawn(state, width=size.width, height=size.height - 1, below=below)
        self._live.update(Text("\n".join(lines), overflow="crop", no_wrap=True), refresh=True)


def drawn(
    state: RecorderState, *, width: int, height: int | None = None, below: Sequence[str] = ()
) -> list[str]:
    """A state as the lines of a table of topics, with others below it."""
    # Broken between its parts only.
    whole = summary(state).replace(" ", "\N{NO-BREAK SPACE}").replace("·\N{NO-BREAK SPACE}", "· ")
    ends = [line.replace("\N{NO-BREAK SPACE}", " ") for line in textwrap.wrap(whole, width)]
    below = [*(f"{topic} is silent" for topic in state.silent), *below]
    below = [line for each in below for line in textwrap.wrap(output.printable(each), width)]
    topics = state.topics
    rows = len(topics) if height is None else max(height - 1 - len(ends) - len(below), 4)
    if len(topics) > rows:
        # Those with losses first, then those with most bytes; a line tells of the others.
        topics = sorted(topics, key=lambda t: (-t.lost, -t.bytes_per_s, t.topic))[: rows - 1]
    shown = {topic.topic for topic in topics}
    topics = [topic for topic in state.topics if topic.topic in shown]
    name = Column("topic", lambda topic: _cut(output.printable(topic.topic), width // 2), "whole")
    lines = table_lines(
        [name, *(one for one in _COLUMNS if any(map(one.cell, topics)))], topics, width
    )
    if len(topics) < len(state.topics):
        lines.append(f"… and {output.counted(len(state.topics) - len(topics), 'more topic')}")
    return [*lines, *ends, *below]


def _optional(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


_COLUMNS: Final = [
    Column("Hz", lambda topic: f"{topic.hz:.1f}", "right"),
    Column("usual", lambda topic: _optional(topic.expected_hz), "right", order=2),
    Column("MB/s", lambda topic: f"{topic.bytes_per_s / 1e6:.2f}", "right", order=3),
    Column("jitter ms", lambda topic: _optional(topic.jitter_ms), "right", order=1),
    Column("messages", lambda topic: topic.messages, "right"),
    Column("thinned", lambda topic: topic.thinned or "", "right", order=4),
    Column("lost", lambda topic: topic.lost or "", "right"),
]


def _cut(name: str, room: int) -> str:
    """A name without its middle if it is too long: both ends tell topics apart."""
    if len(name) <= room:
        return name
    end = room // 2
    return f"{name[: max(room - end - 1, 0)]}…{name[-end:]}"


def summary(state: RecorderState) -> str:
    """One line for the whole recorder."""
    parts = [
        f"{state.elapsed_s:.0f} s",
        f"{state.hz:.0f} messages/s",
        f"{output.size(state.bytes_per_s)}/s",
        f"{output.size(state.stored_bytes)} stored",
        f"memory {100 * state.filled:.0f} %",
        _index(state),
        f"{output.size(state.free_bytes)} free",
    ]
    causes = {cause: count for cause, count in state.lost.items() if cause != Cause.THROTTLE}
    lost = sum(causes.values())
    if causes:
        # A cause without a number stands for an unknown number.
        named = ", ".join(
            f"{cause} {count or 'unknown'}" for cause, count in sorted(causes.items())
        )
        parts.append(f"lost {lost or 'unknown'} ({named})")
    return " · ".join(parts)


def _index(state: RecorderState) -> str:
    sentence = state.index_failure.partition("\n")[0].partition(". ")[0].rstrip(".")
    why = f": {output.cut(output.printable(sentence), _SHORT)}" if sentence else ""
    return f"index {state.lag} behind{why}" if state.lag or why else "index up to date"
