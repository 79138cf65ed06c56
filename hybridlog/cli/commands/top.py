"""`hybridlog top`: watches a running recorder."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.completion import complete_field, complete_running
from hybridlog.cli.options import AsJson, InStore
from hybridlog.cli.render import Column, numbers, table_lines
from hybridlog.cli.signals import Stopped
from hybridlog_storage.errors import UsageError
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.live.state import RecorderState
    from hybridlog.store import Store

_EVERY_S = 1.0


@dataclass(frozen=True, kw_only=True)
class _Given(InStore, AsJson):
    recording: str | None = argument(
        "One of several recorders: id or name of its recording, or the beginning of the id.",
        "[RECORDING]",
        shell_complete=complete_running,
    )
    field: tuple[str, ...] = option(
        "Least, mean and greatest of a field in the last seconds, such as scan:ranges.min.",
        "TOPIC:FIELD",
        shell_complete=complete_field,
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
    from hybridlog.cli.live_table import LiveTable, drawn
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
        opened = None
        if fields:
            opened = held.enter_context(given.opened())
        table = held.enter_context(LiveTable(error=False)) if on_screen else None
        for state in states(directory, recorder, _EVERY_S):
            name = state.name
            values, width = [], output.screen_width()
            if opened is not None:
                values = _values(opened, recorder, state, fields, span)
            below = table_lines(_FIELDS, values, width) if values else []
            if given.as_json:
                output.print_json({**summary_of(state), "fields": values}, at_once=True)
            elif table is not None:
                table.show(state, below)
            else:
                for line in drawn(state, width=width, below=below):
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
        row = {
            "topic": topic,
            "field": field,
            "n": 0,
            "least": None,
            "mean": None,
            "greatest": None,
        }
        with suppress(UsageError):  # nothing has come yet
            (one, *_) = store.query([topic], [recording]).between(since).stats(field)
            row |= {"n": one.count, "least": one.min, "mean": one.mean, "greatest": one.max}
        found.append(row)
    return found


_FIELDS = [Column("topic"), Column("field"), *numbers("n", "least", "mean", "greatest")]
