"""`hybridlog top`: what a running recorder is doing."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.live_table import LiveTable, drawn
from hybridlog.cli.opening import opened
from hybridlog.cli.stopping import Stopped
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.live.recorder import RecorderState
    from hybridlog_storage.database import Database

_EVERY_S = 1.0
_ALL_ROWS = 10_000


@dataclass(frozen=True, slots=True)
class _Field:
    """A field whose values are summed up."""

    topic: str
    path: str


def run(
    recording: str | None,
    fields: Sequence[str],
    last: str,
    store: Path | None,
    mongo: str | None,
    *,
    once: bool,
    as_json: bool,
) -> None:
    """Show a recorder's state until it ends, or Ctrl-C; once, where nobody watches."""
    from hybridlog.live.control_server import choose, states
    from hybridlog.query.times import parse_duration
    from hybridlog.store import store_path

    asked = [_field(text) for text in fields]
    span = parse_duration(last)
    path = store_path(store)
    (name,) = choose(path, [] if recording is None else [recording])
    on_screen = not as_json and sys.stdout.isatty() and not once
    with _left_by_ctrl_c(), ExitStack() as held:
        database = None
        if asked:
            opened_store = held.enter_context(opened(store, mongo, needs_database=True))
            database = opened_store.database_for("top --field")
        table = held.enter_context(LiveTable(error=False)) if on_screen else None
        for raw in states(path, name, _EVERY_S):
            if not raw:
                continue  # it has only just started
            values = []
            if asked and raw.get("snapshots") is not None:
                values = _values_of_ring(path, name, raw, asked, span)
            elif database is not None:
                values = _values(database, name, raw, asked, span)
            if as_json:
                print(json.dumps({**raw, "fields": values}), flush=True)  # noqa: T201
            elif table is not None:
                table.show(_state(raw), _lines(values))
            else:
                output.console().print(drawn(_state(raw), rows=_ALL_ROWS, below=_lines(values)))
            if once or not (as_json or on_screen):
                return
        if not as_json:
            output.note(f"{name} has ended.")


@contextmanager
def _left_by_ctrl_c() -> Iterator[None]:
    """Who has watched long enough presses Ctrl-C: nothing is interrupted by that."""
    try:
        yield
    except Stopped as stopped:
        if stopped.number != signal.SIGINT:
            raise


def _field(text: str) -> _Field:
    topic, sign, path = text.rpartition(":")
    if not sign or not topic or not path or path.startswith("$"):
        raise UsageError(f"--field wants TOPIC:FIELD, such as scan:ranges.min, not {text!r}.")
    return _Field(topic, path)


def _values(
    database: Database,
    recording: str,
    state: Mapping[str, Any],
    fields: Sequence[_Field],
    span: int,
) -> list[dict[str, Any]]:
    """Least, mean and greatest of each field in the last seconds, out of the index."""
    from hybridlog_storage.collection_names import collection_of

    since = time.time_ns() - span
    found = []
    for topic, field in _resolved(state, fields):
        value = f"${field.path}"
        group = {
            "_id": None,
            "n": {"$sum": 1},
            "least": {"$min": value},
            "mean": {"$avg": value},
            "greatest": {"$max": value},
        }
        pipeline: list[Mapping[str, object]] = [
            {"$match": {"_meta.rec": recording, "_meta.t": {"$gte": since}}},
            {"$group": group},
        ]
        row: dict[str, Any] = {"topic": topic, "field": field.path, "n": 0}
        for document in database.aggregate(collection_of(topic), pipeline, max_time_ms=2000):
            row |= {key: document[key] for key in ("n", "least", "mean", "greatest")}
        found.append(row)
    return found


def _values_of_ring(
    store: Path,
    recorder: str,
    state: Mapping[str, Any],
    fields: Sequence[_Field],
    span: int,
) -> list[dict[str, Any]]:
    """The same out of the memory of a recorder that stores nothing until it must."""
    from hybridlog.live.control_server import request

    since = time.time_ns() - span
    return [
        {
            "topic": topic,
            "field": field.path,
            **request(store, recorder, "numbers", topic=topic, path=field.path, begin=since),
        }
        for topic, field in _resolved(state, fields)
    ]


def _resolved(state: Mapping[str, Any], fields: Sequence[_Field]) -> Iterator[tuple[str, _Field]]:
    """Each field with the full name of its topic.

    Raises:
        TopicError: No topic has that name.
        UsageError: Several have.
    """
    from hybridlog.query.topics import resolve

    topics = [topic["topic"] for topic in state["topics"]]
    for field in fields:
        (topic, *others) = resolve([field.topic], topics)
        if others:
            raise UsageError(f"{field.topic!r} fits several topics: name one.")
        yield topic, field


def _lines(values: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = []
    for row in values:
        said = "nothing yet"
        if row["n"]:
            parts = [f"{name} {_number(row[name])}" for name in ("least", "mean", "greatest")]
            said = f"{', '.join(parts)} ({output.counted(row['n'], 'message')})"
        lines.append(f"{row['topic']} {row['field']}: {said}")
    return lines


def _number(value: object) -> str:
    if value is None:
        return "-"  # such as the mean of texts
    return f"{value:.6g}" if isinstance(value, int | float) else str(value)


def _state(raw: Mapping[str, Any]) -> RecorderState:
    from hybridlog.live.recorder import state_of

    return state_of(raw)
