"""`hybridlog intervals`: when a predicate held, fields changed, or nothing came."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import click

from hybridlog.cli import output
from hybridlog.cli.answers import Answering, Listing, answering
from hybridlog.cli.binder import command, option
from hybridlog.cli.options import Asking, parse_fields
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hybridlog.query.intervals import Interval, Intervals
    from hybridlog.query.query import Query


@dataclass(frozen=True, kw_only=True)
class _Given(Asking, Listing):
    needs_topic: ClassVar[bool] = True
    changes: str | None = option("Instead: when these fields changed.", "A,B.C")
    pause: str | None = option(
        "With --changes: longest time between steps of one change; without, 1s.", "DURATION"
    )
    tolerance: float | None = option(
        "With --changes: numbers that differ by at most this are equal.", "X"
    )
    gaps: bool = option("Instead: when no message came for long.")
    longer_than: str | None = option("With --gaps: only longer ones: 500ms.", "DURATION")
    periods: float | None = option(
        "With --gaps: only those longer than so many usual periods of the topic; without both, 5.",
        "K",
    )
    at_least: str | None = option("Only those of at least this length, such as 60s.", "DURATION")
    length: str | None = option(
        "Cut each into as many of exactly this length as fit, one after the other.", "DURATION"
    )
    max_gap: str | None = option(
        "A message is valid for at most this long; without, until the next one.", "DURATION"
    )
    state: str | None = option(
        "When it certainly held, certainly did not, or when lost messages leave it open; "
        "without, what the stored messages say.",
        type=click.Choice(["held", "not-held", "unknown"]),
    )
    count: bool = option("Only print how many.")


_ONLY_WITH = {
    "pause": "changes",
    "tolerance": "changes",
    "longer_than": "gaps",
    "periods": "gaps",
}
"""Options that belong to another one."""
_OF_A_PREDICATE = ("length", "max_gap", "state")


@command(_Given)
def intervals_command(given: _Given) -> None:
    """Show when a predicate held, fields changed, or no message came.

    A message is valid until the next one, or until the end of the recording. A step of
    --changes is a message that differs from the one before it; steps that follow each other
    within --pause are one change.
    """
    noun = _noun(given)
    with answering(given) as asked:
        found = _intervals(given, asked.query)
        if given.strict:
            asked.query.completeness().check()
        asked.is_empty = not len(found)
        if given.count:
            output.say(str(len(found)))
        else:
            _show(given, found, asked)
            if asked.is_empty and not given.quiet:
                output.note(f"No {noun}.")


def _noun(given: _Given) -> str:
    """The name of what is asked for, if the options fit each other.

    Raises:
        UsageError: They do not.
    """
    kinds = [name for name in ("changes", "gaps") if getattr(given, name)]
    if len(kinds) > 1:
        raise UsageError(f"--{kinds[0]} and --{kinds[1]} exclude each other.")
    for name, kind in _ONLY_WITH.items():
        if getattr(given, name) is not None and kind not in kinds:
            raise UsageError(f"--{name.replace('_', '-')} is for --{kind}.")
    for name in _OF_A_PREDICATE:
        if getattr(given, name) is not None and kinds:
            raise UsageError(f"--{name.replace('_', '-')} is not for --{kinds[0]}.")
    return {"changes": "change", "gaps": "gap"}.get(kinds[0] if kinds else "", "interval")


def _intervals(given: _Given, query: Query) -> Intervals:
    if given.changes is not None:
        names = parse_fields(given.changes, "--changes")
        found = query.changes(*names, pause=given.pause or "1s", tolerance=given.tolerance or 0.0)
    elif given.gaps:
        found = query.gaps(given.longer_than, given.periods)
    else:
        state = given.state and given.state.replace("-", " ")
        return query.intervals(given.at_least, given.length, given.max_gap, state)
    return found if given.at_least is None else found.at_least(given.at_least)


def _show(given: _Given, found: Intervals, asked: Answering) -> None:
    from hybridlog.query.times import format_duration

    names = {recording.id: recording.name for recording in asked.store.summaries()}
    columns: list[output.Column] = [
        ("recording", "left"),
        ("begin", "whole"),
        ("end", "whole"),
        ("duration", "right"),
        ("messages", "right"),
    ]

    def cells(row: Mapping[str, int]) -> list[str]:
        begin, end = row["begin_ns"], row["end_ns"]
        return [
            str(row["recording"]),
            *output.begin_and_end(begin, end),
            format_duration(end - begin),
            str(row["messages"]),
        ]

    given.answer((_as_dict(row, names) for row in found), columns, cells)


def _as_dict(row: Interval, names: Mapping[str, str]) -> dict[str, object]:
    return {
        "recording": names[row.recording],
        "begin_ns": row.begin_ns,
        "end_ns": row.end_ns,
        "messages": row.messages,
    }
