"""`hybridlog intervals`: when a predicate held, fields changed, or nothing came."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import click

from hybridlog.cli import output
from hybridlog.cli.answers import Answering, Listing, answering, print_cost
from hybridlog.cli.binder import command, option
from hybridlog.cli.options import Asking, parse_fields, recordings_of
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hybridlog.live.rehearsal import Rehearsal
    from hybridlog.query.intervals import Interval, Intervals
    from hybridlog.query.query import Query


@dataclass(frozen=True, kw_only=True)
class _Given(Asking, Listing):
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
    rehearse: str | None = option(
        "Instead: what this trigger of `record --ring` would have kept of what is stored.",
        "TOPIC: PREDICATE",
    )
    before: str | None = option(
        "With --rehearse: time before the trigger; without, 10s.", "DURATION"
    )
    after: str | None = option("With --rehearse: time after the trigger; without, 0.", "DURATION")
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

    @property
    def needs_topic(self) -> bool:  # type: ignore[override]
        """True if a topic has to be named."""
        return self.rehearse is None


_ONLY_WITH = {
    "pause": "changes",
    "tolerance": "changes",
    "longer_than": "gaps",
    "periods": "gaps",
    "before": "rehearse",
    "after": "rehearse",
}
"""Options that belong to another one."""
_OF_A_PREDICATE = ("length", "max_gap", "state")


@command(_Given)
def intervals_command(given: _Given) -> None:
    """Show when a predicate held, fields changed, or no message came.

    A message is valid until the next one, or until the end of the recording. A step of
    --changes is a message that differs from the one before it; steps that follow each other
    within --pause are one change. --rehearse says how often a trigger would have fired.
    """
    noun = _noun(given)
    if given.rehearse is not None:
        _rehearse(given, given.rehearse)
        return
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
    kinds = [name for name in ("changes", "gaps", "rehearse") if getattr(given, name)]
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

    labels = {recording.id: recording.label for recording in asked.store.summaries()}
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

    given.answer((_as_dict(row, labels) for row in found), columns, cells)


def _as_dict(row: Interval, labels: Mapping[str, str]) -> dict[str, object]:
    return {
        "recording": labels[row.recording],
        "begin_ns": row.begin_ns,
        "end_ns": row.end_ns,
        "messages": row.messages,
    }


def _rehearse(given: _Given, trigger: str) -> None:
    """Print what a trigger would have kept.

    Raises:
        UsageError: Options that do not fit are given.
    """
    if given.words or given.topic or given.where or given.between or given.form or given.output:
        raise UsageError(
            "--rehearse is about whole snapshots: leave out topics, --where, --between, --format "
            "and --output."
        )
    with given.opened() as store:
        choice = given.choice if given.last is None else replace(given.choice, during=None)
        chosen = [one.id for one in recordings_of(store, choice).summaries]
        found = store.rehearse(
            trigger,
            since=None if given.last is None else given.since,
            before=given.before or "10s",
            after=given.after or 0,
            recordings=None if choice.is_everything else chosen,
        )
        labels = {summary.id: summary.label for summary in store.summaries()}
    if given.count:
        output.say(str(len(found.snapshots)))
    elif given.as_json:
        output.print_json(_rehearsal_as_dict(found, labels))
    else:
        _print_rehearsal(found)
    if not given.quiet:
        output.notes(found.remarks)
        if not found.recordings:
            output.note("No recording is from that time.")
        print_cost(found.counters, found.counters.elapsed_s, count=True)


def _rehearsal_as_dict(found: Rehearsal, labels: Mapping[str, str]) -> dict[str, object]:
    return {
        "trigger": found.trigger,
        "recordings": found.recordings,
        "fired": found.fired,
        "messages": found.messages,
        "payload_bytes": found.payload_bytes,
        "stored_bytes": found.stored_bytes,
        "snapshots": [_as_dict(one, labels) for one in found.snapshots],
    }


def _print_rehearsal(found: Rehearsal) -> None:
    share = 100 * found.payload_bytes / found.stored_bytes if found.stored_bytes else 0.0
    kept = f"{output.counted(found.messages, 'message')}, {output.size(found.payload_bytes)}"
    rows = [
        ("trigger", found.trigger),
        ("recordings", str(found.recordings)),
        ("fired", output.counted(found.fired, "time")),
        ("snapshots", str(len(found.snapshots))),
        ("kept", f"{kept} of {output.size(found.stored_bytes)} of payload ({share:.3g} %)"),
    ]
    width = max(len(heading) for heading, _ in rows)
    for heading, text in rows:
        output.say(f"{heading:<{width}}  {text}")
