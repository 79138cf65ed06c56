"""`hybridlog top`: watches a running recorder; the state of a recorder as a table."""

from __future__ import annotations

import shutil
import sys
import textwrap
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from hybridlog.cli import output
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.options import AsJson, InStore
from hybridlog.cli.render import Column, numbers, table_lines
from hybridlog.cli.signals import Stopped
from hybridlog.record.losses import Cause
from hybridlog_storage.errors import UsageError
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.live.state import RecorderState
    from hybridlog.store import Store

_EVERY_S = 1.0
_SHORT = 60  # characters of a reason


@dataclass(frozen=True, kw_only=True)
class _Given(InStore, AsJson):
    recording: str | None = argument(
        "One of several recorders: id or name of its recording, or the beginning of the id.",
        "[RECORDING]",
    )
    field: tuple[str, ...] = option(
        "Least, mean and greatest of a field in the last seconds, such as scan:ranges.min.",
        "TOPIC:FIELD",
    )
    window: str = option(
        "The time that --field covers, up to now.", "TIME", name="--last", default="5s"
    )
    once: bool = option("Show it once and end.")
    as_json: bool = option("A line of JSON a second, for scripts.", name="--json")


@command(_Given)
def top_command(given: _Given) -> None:
    """Watch a running recorder, until it ends, or Ctrl-C or SIGTERM.

    Without a terminal, and without --json, the state is shown once.
    """
    from hybridlog.live.state import choose, states, summary_of
    from hybridlog.query.times import parse_duration
    from hybridlog.store import store_path
    from hybridlog_storage.remote import directory_of

    fields = [_field(text) for text in given.field]
    span = parse_duration(given.window)
    directory = directory_of(store_path(given.store))
    (recorder,) = choose(directory, [] if given.recording is None else [given.recording])
    name = recorder
    on_screen = not given.as_json and sys.stdout.isatty() and not given.once
    with suppress(Stopped), at_safe_points(), ExitStack() as held:
        opened = held.enter_context(given.opened()) if fields else None
        table = held.enter_context(output.Drawn(error=False)) if on_screen else None
        for state in states(directory, recorder, _EVERY_S):
            name = state.name
            values, width = [], output.screen_width()
            if opened is not None:
                values = _values(opened, recorder, state, fields, span)
            below = table_lines(_FIELDS, values, width) if values else []
            if given.as_json:
                output.print_json({**summary_of(state), "fields": values}, at_once=True)
            elif table is not None:
                draw(state, table, below)
            else:
                for line in _lines_of(state, width=width, below=below):
                    output.say(line)
            if given.once or not (given.as_json or on_screen):
                return
        if not given.as_json:
            output.note(f"{name} has ended.")


def _field(text: str) -> tuple[str, str]:
    """The topic and the field."""
    topic, sign, path = text.rpartition(":")
    if not sign or not topic or not path or path.startswith("$"):
        raise UsageError(f"--field takes TOPIC:FIELD, such as scan:ranges.min, not {text!r}.")
    return topic, path


def _values(
    store: Store,
    recording: str,
    state: RecorderState,
    fields: Sequence[tuple[str, str]],
    span: int,
) -> list[dict[str, Any]]:
    """Least, mean and greatest of each field in the last seconds, of what is flushed."""
    from hybridlog.query.topics import resolve

    since, topics = time.time_ns() - span, [topic.topic for topic in state.topics]
    found = []
    for name, field in fields:
        (topic, *others) = resolve([name], topics)
        if others:
            raise UsageError(f"{name!r} fits several topics: name one.")
        row: dict[str, Any] = {"topic": topic, "field": field, "n": 0}
        row |= dict.fromkeys(("least", "mean", "greatest"))
        with suppress(UsageError):  # nothing has come yet
            (one, *_) = store.query([topic], [recording]).between(since).stats(field)
            row |= {"n": one.count, "least": one.min, "mean": one.mean, "greatest": one.max}
        found.append(row)
    return found


_FIELDS: Final = [Column("topic"), Column("field"), *numbers("n", "least", "mean", "greatest")]


def draw(state: RecorderState, table: output.Drawn, below: Sequence[str] = ()) -> None:
    """Draw a state as a table, with lines below it."""
    width, height = shutil.get_terminal_size()
    table.draw(_lines_of(state, width=width, height=height - 1, below=below))


def _lines_of(
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
        first = sorted(topics, key=lambda t: (-t.lost, -t.bytes_per_s, t.topic))[: rows - 1]
        shown = {topic.topic for topic in first}
        topics = [topic for topic in topics if topic.topic in shown]
    name = Column("topic", lambda topic: _cut(output.printable(topic.topic), width // 2), "whole")
    lines = table_lines(
        [name, *(one for one in _COLUMNS if any(map(one.cell, topics)))], topics, width
    )
    if left := len(state.topics) - len(topics):
        lines.append(f"… and {output.counted(left, 'more topic')}")
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
