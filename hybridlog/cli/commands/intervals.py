"""`hybridlog intervals`: when a predicate held, fields changed, or nothing came."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import click
from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.answers import Listing, answering
from hybridlog.cli.options import (
    Filtered,
    command,
    option,
    parse_fields,
)
from hybridlog.cli.output import Column

if TYPE_CHECKING:
    from hybridlog.query.intervals import Intervals
    from hybridlog.query.query import Query


_OF_A_PREDICATE = ("max_gap", "state")


class _Intervals(Filtered, Listing):
    needs_topic: ClassVar[bool] = True
    changes: str | None = option(
        "Instead: when these fields changed.", "A,B.C", excludes=("gaps", *_OF_A_PREDICATE)
    )
    pause: str | None = option(
        "With --changes: longest time between steps of one change; without, 1s.",
        "DURATION",
        needs=("changes",),
    )
    tolerance: float | None = option(
        "With --changes: numbers that differ by at most this are equal.", "X", needs=("changes",)
    )
    gaps: bool = option("Instead: when no message came for long.", excludes=_OF_A_PREDICATE)
    longer_than: str | None = option(
        "With --gaps: only longer ones: 500ms; without, than five usual periods of the topic.",
        "DURATION",
        needs=("gaps",),
    )
    at_least: str | None = option("Only those of at least this length, such as 60s.", "DURATION")
    max_gap: str | None = option(
        "A message is valid for at most this long; without, until the next one.", "DURATION"
    )
    state: str | None = option(
        "When it certainly held, certainly did not, or when lost messages leave it open; "
        "without, what the stored messages say.",
        type=click.Choice(["held", "not-held", "unknown"]),
    )
    count: bool = option("Only print how many.")


@command(_Intervals)
def intervals_command(given: _Intervals) -> None:
    """Show when a predicate held, fields changed, or no message came.

    A message is valid until the next one, or until the end of the recording. A step of
    --changes is a message that differs from the one before it; steps that follow each other
    within --pause are one change.
    """
    noun = "change" if given.changes else "gap" if given.gaps else "interval"
    with answering(given) as query:
        found = _asked(given, query)
        if given.strict:
            query.completeness().check()
        if given.count:
            output.say(str(len(found)))
        else:
            summaries = query.source.now().summaries_of(query.question)
            names = {one.id: one.name for one in summaries}
            rows = (asdict(one) | {"recording": names[one.recording]} for one in found)
            given.show(rows, _SPANS, f"No {noun}.")


def _asked(given: _Intervals, query: Query) -> Intervals:
    if given.changes is not None:
        names = parse_fields(given.changes, "--changes")
        found = query.changes(*names, pause=given.pause or "1s", tolerance=given.tolerance or 0.0)
    elif given.gaps:
        found = query.gaps(given.longer_than)
    else:
        state = given.state and given.state.replace("-", " ")
        found = query.intervals(given.max_gap, state)
    return found if given.at_least is None else found.at_least(given.at_least)


_SPANS = [
    Column("recording"),
    Column("begin", "begin_ns", "time"),
    Column("end", "end_ns", "time", order=1),
    Column("duration", lambda row: row["end_ns"] - row["begin_ns"], "duration"),
    Column("messages", kind="number"),
]
