"""`hybridlog intervals`, `stats`, `check`, `diff`, `plot`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click
from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.answers import SCREEN, Listing, answering, check_room, form_of, write_bytes
from hybridlog.cli.app import DIFFERENT
from hybridlog.cli.options import (
    Between,
    Filtered,
    Forced,
    InStore,
    Quiet,
    Strict,
    Topics,
    argument,
    command,
    one_recording,
    option,
    parse_fields,
    topics,
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


_MEASURES = ("count", "nan", "infinite", "min", "max", "mean", "std")


class _Stats(Filtered, Listing):
    needs_topic: ClassVar[bool] = True
    fields: str | None = option(
        "Only these fields, also summaries and arrays; without, all that are numbers.",
        "A,B.C",
    )


@command(_Stats)
def stats_command(given: _Stats) -> None:
    """Show count, extremes, mean of numeric fields.

    Also their standard deviation, and how many values are NaN.
    """
    with answering(given) as query:
        stats = query.stats(*([] if given.fields is None else parse_fields(given.fields)))
        found = [asdict(row) for row in stats]
        if given.strict:
            query.completeness().check()
        shown = [Column(name, kind="number", order=name == "std") for name in _MEASURES]
        columns = [Column("topic", varies=True), Column("field"), *shown]
        given.show(found, columns, "No field is a number.")


class _Check(Strict, Topics, Listing):
    contract: Path | None = option(
        "Judge recordings by the rules in this file; exit code 12 if one is broken.",
        "FILE",
        excludes=("make", "words", "topic", "between"),
    )
    make: Path | None = option(
        "Write a contract that these good recordings keep, to be edited.", "FILE"
    )
    junit: Path | None = option(
        "With --contract: also write the results in JUnit's XML, for CI.",
        "FILE",
        needs=("contract",),
    )


@command(_Check)
def check_command(given: _Check) -> int:
    """Show how regularly topics came, the worst first.

    Rate, jitter, longest gap and where it begins, late start, early stop and losses of each
    topic. No message is read.
    """
    from hybridlog.contract import contract_of

    for path in filter(None, (given.make, given.junit)):
        check_room(path, force=given.force)
    if given.contract is not None:
        return _judge(given, given.contract)
    with answering(given) as query:
        found = query.check()
        if given.make is not None:
            write_bytes(given.make, contract_of(found).encode())
        else:
            given.show(map(asdict, found), _REGULARITY, "No topic.")
    return 0


def _gap_begin(row: Mapping[str, Any]) -> str | None:
    begin = row["gap_begin_ns"]
    return None if begin is None else f"+{(begin - row['begin_ns']) / 1e9:.3f}s"


_REGULARITY = [
    Column("recording", varies=True),
    Column("topic"),
    Column("messages", kind="number"),
    Column("Hz", "rate_hz", "rate", order=3),
    Column("jitter", "jitter_ns", "duration", order=2),
    Column("longest gap", "gap_ns", "duration"),
    Column("from", _gap_begin, "number", order=1),
    Column("late", lambda row: None if row["is_latched"] else row["late_ns"], "duration", order=5),
    Column(
        "early", lambda row: None if row["is_latched"] else row["early_ns"], "duration", order=4
    ),
    Column("lost", lambda row: "?" if row["lost"] is None else row["lost"], "number"),
]


def _judge(given: _Check, contract: Path) -> int:
    from hybridlog.contract import Contract
    from hybridlog.contract.judge import broken, junit_of

    rules = Contract.read(contract)
    with given.opened(snapshot=True) as store:
        ids = given.recordings_in(store).ids
        results = [one for name in ids for one in store.judge(rules, name)]
    if given.junit is not None:
        write_bytes(given.junit, junit_of(results).encode())
    bad = broken(results)
    names = ("recording", "topic", "rule", "wanted", "found")
    given.show(map(asdict, bad if given.to_form == SCREEN else results), [*map(Column, names)])
    many, where = output.counted(len(results), "rule"), output.counted(len(ids), "recording")
    output.remarks([f"{many} in {where}: {len(bad) or 'none'} broken."])
    return DIFFERENT if bad else 0


class _Diff(Between, InStore, Quiet, Listing):
    a: str = one_recording("A recording, as for --recording, or a glob for several together.", "A")
    b: str = one_recording("The same.", "B")
    words: tuple[str, ...] = argument("Topics, as for --topic.", "[TOPIC]...")
    tolerance: str = option(
        "Numbers are equal that differ by at most this, such as 5%.", "SHARE", default="0"
    )
    topic: tuple[str, ...] = topics()
    counters: bool = option("Also counters and stamps in messages, which differ always.")


@command(_Diff)
def diff_command(given: _Diff) -> int:
    """Show what differs between two recordings.

    First what only one has: times and topics. Then types, messages, rates, gaps, losses, and
    statistics of fields of the time that both have. Exit code 12 if anything differs.
    """
    from hybridlog.contract import parse_share

    share = parse_share(given.tolerance)
    with given.opened(snapshot=True) as store:
        found = store.diff(
            given.a,
            given.b,
            topics=(*given.words, *given.topic),
            between=given.between,
            tolerance=share,
            counters=given.counters,
        )
    columns = [*map(Column, ("topic", "what", "a", "b"))]
    given.show(map(asdict, found), columns)
    if not given.as_json:
        total = f"{output.counted(len(found), 'difference')}." if found else "No difference."
        is_cut = given.limit is not None and given.limit < len(found)
        output.remarks([f"The first {given.limit} of {total}" if is_cut else total])
    return DIFFERENT if found else 0


_WIDTH, _HEIGHT = 1200, 400


class _Plot(Filtered, Forced):
    needs_topic: ClassVar[bool] = True
    fields: str | None = option(
        "Fields that are numbers (ranges.min, position[2]), or messages with numbers.",
        "A,B.C",
    )
    output: Path = option(
        "Write this picture: .png, .svg, .pdf.", "FILE", short="-o", required=True
    )


@command(_Plot)
def plot_command(given: _Plot) -> None:
    """Draw fields over time."""
    form = form_of(given.output, {f".{name}": name for name in ("png", "svg", "pdf")})
    check_room(given.output, force=given.force)
    with answering(given) as query:
        from hybridlog.drawing.figure import figure, lines

        names = [] if given.fields is None else parse_fields(given.fields)
        found = lines(query, names, pixels=_WIDTH)
        size = _WIDTH, _HEIGHT * max(1, len({line.topic for line in found}))
        write_bytes(given.output, figure(found, size=size, form=form))
