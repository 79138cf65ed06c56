"""Answers the queries of `intervals` and `changes`, and prints the intervals."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.answer_notes import print_cost, print_remarks
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from hybridlog.query.choice import Choice
    from hybridlog.query.intervals import Interval, Intervals
    from hybridlog.query.query import Query


@dataclass(frozen=True, slots=True, kw_only=True)
class IntervalChoices:
    """The parameters that both commands have."""

    store: Path | None
    topic: str
    between: tuple[str, str] | None
    where: tuple[str, ...]
    choice: Choice
    strict: bool
    count: bool
    mongo: str | None
    as_json: bool
    quiet: bool


def print_intervals(
    choices: IntervalChoices, answer: Callable[[Query], Intervals], noun: str = "interval"
) -> None:
    """Open the store, answer the query, and print the intervals.

    Args:
        choices: Parameters of the command.
        answer: Gives the intervals of the query.
        noun: What one of them is called.
    """
    started = time.monotonic()
    quiet = choices.quiet or choices.as_json
    with opened_store(choices.store, choices.mongo, quiet=quiet) as store:
        query = asked(
            store,
            [choices.topic],
            choices.choice,
            between=choices.between,
            where=choices.where,
            strict=choices.strict,
        )
        found = answer(query)
        labels = {recording.id: recording.label for recording in store.summaries()}
        if choices.count:
            output.say(str(len(found)))
        elif choices.as_json:
            output.print_json_list(_as_dict(row, labels) for row in found)
        elif len(found):
            _print(found, labels)
        sys.stdout.flush()
        if choices.quiet:
            return
        if not len(found) and not choices.count:
            output.note(f"No {noun}.")
        print_cost(query.counters, time.monotonic() - started, count=True)
        print_remarks(query, [choices.topic], is_empty=not len(found))


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

    def cells(row: Interval) -> list[str]:
        shown = [
            labels[row.recording],
            format_time(row.begin_ns),
            format_time(row.end_ns),
            format_duration(row.duration_ns),
            str(row.messages),
        ]
        if len(columns) < len(shown):
            del shown[2]
        return shown

    output.print_table(columns, map(cells, found))
