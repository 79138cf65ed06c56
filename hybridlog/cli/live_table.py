"""The state of a recorder as a table that updates in place."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from hybridlog.cli import output
from hybridlog.cli.signals import restore_echo, stop_echo
from hybridlog.record.losses import Cause

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

    from hybridlog.live.state import RecorderState
    from hybridlog.live.statistics import TopicState

_HEADINGS = ("Hz", "usual", "MB/s", "jitter ms", "messages", "thinned", "lost")
_SPARE = ("jitter ms", "usual", "MB/s", "thinned")  # left out first where there is little room
_SHORT = 60  # characters of a reason
_SLOW = 0.8  # of the expected rate: below it the rate is shown as a warning


class LiveTable:
    """The table; a context manager that removes it at the end."""

    def __init__(self, *, error: bool = True) -> None:
        from rich.live import Live

        self._live = Live(
            console=output.console(error=error), auto_refresh=False, transient=True, screen=False
        )

    def __enter__(self) -> Self:
        """Begin to draw."""
        stop_echo(self._live.console.file.fileno())
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the table."""
        self._live.stop()
        restore_echo()

    def note(self, text: str) -> None:
        """Print a line above the table."""
        from rich.text import Text

        self._live.console.print(Text(f"hybridlog: {output.printable(text)}"))

    def show(self, state: RecorderState, below: Sequence[str] = ()) -> None:
        """Draw a state, with lines below it."""
        size = self._live.console.size
        found = drawn(state, width=size.width, height=size.height - 1, below=below)
        self._live.update(found, refresh=True)


def drawn(
    state: RecorderState, *, width: int, height: int | None = None, below: Sequence[str] = ()
) -> Group:
    """A state as a table of topics, with lines below it.

    Args:
        state: The state.
        width: Columns of the terminal; the less important columns are left out if it is narrow.
        height: Lines of the terminal; None for all topics.
        below: The lines.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

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
    columns, room = _columns(topics, width)
    table = Table(box=None, pad_edge=False, header_style="")  # few bytes, over a slow line
    table.add_column("topic", no_wrap=True)
    for heading in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    for topic, *cells in zip(topics, *columns.values(), strict=True):
        table.add_row(Text(_cut(output.printable(topic.topic), room)), *cells)
    lines: list[Table | Text] = [table]
    if len(topics) < len(state.topics):
        more = output.counted(len(state.topics) - len(topics), "more topic")
        lines.append(Text(f"… and {more}"))
    lines.extend(Text(line, style="bold") for line in ends)
    lines.extend(map(Text, below))
    return Group(*lines)


def _columns(topics: Sequence[TopicState], width: int) -> tuple[dict[str, list[Text]], int]:
    """Cells by heading, as many as leave room for the names of the topics, and that room."""
    rows = [_cells(topic) for topic in topics]
    columns = {heading: [row[n] for row in rows] for n, heading in enumerate(_HEADINGS)}
    longest = max((len(output.printable(topic.topic)) for topic in topics), default=0)
    # Without any value first.
    for spare in (*sorted(_SPARE, key=lambda name: any(map(len, columns[name]))), None):
        taken = (2 + max(len(name), 0, *map(len, cells)) for name, cells in columns.items())
        room = max(width - sum(taken), 4)
        if spare is None or room >= min(longest, width // 2):
            break
        del columns[spare]
    return columns, room


def _cut(name: str, room: int) -> str:
    """A name without its middle if it is too long: both ends tell topics apart."""
    if len(name) <= room:
        return name
    end = 2 * room // 3
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
    why = f": {_in_short(state.index_failure)}" if state.index_failure else ""
    return f"index {state.lag} behind{why}" if state.lag or why else "index up to date"


def _in_short(reason: str) -> str:
    """The beginning of a reason, for a place with little room."""
    line = output.printable(reason.partition("\n")[0])
    sentence = line.partition(". ")[0].rstrip(".")
    return sentence if len(sentence) <= _SHORT else f"{sentence[: _SHORT - 1]}…"


def _cells(topic: TopicState) -> list[Text]:
    from rich.text import Text

    slow = topic.expected_hz is not None and topic.hz < _SLOW * topic.expected_hz
    return [
        Text(f"{topic.hz:.1f}", style="yellow" if slow else ""),
        Text("" if topic.expected_hz is None else f"{topic.expected_hz:.1f}"),
        Text(f"{topic.bytes_per_s / 1e6:.2f}"),
        Text("" if topic.jitter_ms is None else f"{topic.jitter_ms:.1f}"),
        Text(str(topic.messages)),
        Text(str(topic.thinned), style="dim") if topic.thinned else Text(),
        Text(str(topic.lost), style="red") if topic.lost else Text(),
    ]
