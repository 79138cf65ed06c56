"""`hybridlog intervals` and `changes`."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.asking import question
from hybridlog.cli.coverage import gaps
from hybridlog.cli.fetch import closing_line, names_of
from hybridlog.cli.opening import opened

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from hybridlog.query.intervals import Interval, Intervals
    from hybridlog.query.query import Query


@dataclass(frozen=True, slots=True)
class Asked:
    """The options that both commands have, as typed."""

    store: Path | None
    topic: str
    between: tuple[str, str] | None
    where: list[str] | None
    recording: list[str] | None
    at_least: str | None
    mongo: str | None


def show_states(
    asked: Asked,
    *,
    length: str | None,
    max_gap: str | None,
    count: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Print when a predicate held."""

    def answer(query: Query) -> Intervals:
        return query.intervals(asked.at_least, length, max_gap)

    _show(asked, answer, count=count, as_json=as_json, quiet=quiet)


def show_changes(
    asked: Asked,
    fields: str,
    *,
    pause: str,
    tolerance: float,
    count: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Print when fields changed."""
    names = names_of(fields)

    def answer(query: Query) -> Intervals:
        found = query.changes(*names, pause=pause, tolerance=tolerance)
        return found if asked.at_least is None else found.at_least(asked.at_least)

    _show(asked, answer, count=count, as_json=as_json, quiet=quiet)


def _show(
    asked: Asked,
    answer: Callable[[Query], Intervals],
    *,
    count: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    started = time.monotonic()
    with opened(asked.store, asked.mongo, quiet=quiet or as_json) as store:
        query = question(store, [asked.topic], asked.recording)
        if asked.between is not None:
            query = query.between(*asked.between)
        for predicate in asked.where or ():
            query = query.where(predicate)
        found = answer(query)
        labels = {entry.id: entry.label for entry in store.recordings()}
        if count:
            output.say(str(len(found)))
        elif as_json:
            output.print_json([_as_dict(row, labels) for row in found])
        elif len(found):
            _print(found, labels)
        sys.stdout.flush()
        if quiet:
            return
        if not len(found) and not count:
            output.note("No interval.")
        closing_line(query.counters, time.monotonic() - started, count=True)
        recordings = [r for r in store.recordings() if r.id in query.recordings]
        for line in gaps(recordings, query.topics, asked.between):
            output.note(line)


def _as_dict(row: Interval, labels: Mapping[str, str]) -> dict[str, object]:
    return {
        "recording": labels[row.recording],
        "begin_ns": row.begin_ns,
        "end_ns": row.end_ns,
        "messages": row.messages,
    }


def _print(found: Intervals, labels: Mapping[str, str]) -> None:
    from hybridlog.query.times import format_duration, format_time

    columns: list[output.Column] = [
        ("recording", "left"),
        ("begin", "whole"),
        ("end", "whole"),
        ("duration", "right"),
        ("messages", "right"),
    ]
    if output.is_narrow():
        del columns[2]
    rows = []
    for row in found:
        cells = [
            labels[row.recording],
            format_time(row.begin_ns),
            format_time(row.end_ns),
            format_duration(row.duration_ns),
            str(row.messages),
        ]
        if len(columns) < len(cells):
            del cells[2]
        rows.append(cells)
    output.print_table(columns, rows)
