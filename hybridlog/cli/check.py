"""`hybridlog check`."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.answers import check_room, print_cost, print_remarks
from hybridlog.cli.app import DIFFERENT
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked, recordings_of
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.contract.judge import Result
    from hybridlog.query.answers.regularity import TopicCheck
    from hybridlog.query.choice import Choice


@click.command()
@options.only_recordings
@options.only_topics
@options.store
@options.between
@options.choice
@click.option(
    "--contract",
    type=options.PATH,
    metavar="FILE",
    help="Judge recordings by the rules in this file; exit code 12 if one is broken.",
)
@click.option(
    "--make",
    type=options.PATH,
    metavar="FILE",
    help="Write a contract that this good recording keeps, to be edited.",
)
@click.option(
    "--junit",
    type=options.PATH,
    metavar="FILE",
    help="With --contract: also write the results in JUnit's XML, for CI.",
)
@options.force
@options.strict
@options.mongo
@options.as_json
@options.quiet
@options.verbose
def check_command(
    *,
    topic: tuple[str, ...],
    store: Path | None,
    between: tuple[str, str] | None,
    choice: Choice,
    contract: Path | None,
    make: Path | None,
    junit: Path | None,
    force: bool,
    strict: bool,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Show how regularly topics came, the worst first.

    Rate, jitter, longest gap and where it begins, late start, early stop and losses of each
    topic. No message is read.
    """
    from hybridlog.contract.contract import Contract, contract_of

    started = time.monotonic()
    if sum(map(bool, (contract, make))) > 1 or (junit and not contract):
        raise UsageError("--contract and --make exclude each other; --junit is for --contract.")
    if contract and (topic or between):
        raise UsageError("A contract is about whole recordings: leave out -t and --between.")
    rules = None if contract is None else Contract.read(contract)
    for path in filter(None, (make, junit)):
        check_room(path, force=force)
    with opened_store(store, mongo, quiet=quiet or as_json) as opened:
        if rules is not None:
            chosen = recordings_of(opened, choice)
            results = [one for label in chosen.labels for one in opened.judge(rules, label)]
            _show_verdict(results, len(chosen), junit, as_json=as_json, quiet=quiet)
            return
        query = asked(opened, topic, choice, between=between, where=(), strict=strict)
        found = query.check()
        if make is not None:
            if len({one.recording for one in found}) != 1:
                raise UsageError("A contract is made from one good recording: name it with -r.")
            _write(make, contract_of(found))
            return
        if as_json:
            output.print_json([asdict(one) for one in found])
        elif found:
            _print(found)
        sys.stdout.flush()
        if not quiet:
            if not found:
                output.note("No topic.")
            print_cost(query.counters, time.monotonic() - started, count=True)
            print_remarks(query, topic, is_empty=False)


def _show_verdict(
    results: Sequence[Result], recordings: int, junit: Path | None, *, as_json: bool, quiet: bool
) -> None:
    from hybridlog.contract.judge import broken
    from hybridlog.contract.junit import junit_of

    if junit is not None:
        _write(junit, junit_of(results))
    bad = broken(results)
    if as_json:
        output.print_json([asdict(one) for one in results])
    elif bad:
        columns: list[output.Column] = [
            (name, "left") for name in ("recording", "topic", "rule", "wanted", "found")
        ]
        rows = [[one.recording, one.topic, one.rule, one.wanted, one.found] for one in bad]
        output.print_table(columns, rows)
    sys.stdout.flush()
    if not quiet:
        rules = (
            f"{output.counted(len(results), 'rule')} in {output.counted(recordings, 'recording')}"
        )
        output.note(f"{rules}: {len(bad) or 'none'} broken.")
    if bad:
        raise click.exceptions.Exit(DIFFERENT)


def _write(path: Path, text: str) -> None:
    from hybridlog.formats.writing import Sink

    sink = Sink(path)
    sink.write(text.encode())
    sink.commit()


def _print(found: Sequence[TopicCheck]) -> None:
    columns: list[output.Column] = [
        ("recording", "left"),
        ("topic", "left"),
        ("messages", "right"),
        ("Hz", "right"),
        ("jitter", "right"),
        ("longest gap", "right"),
        ("from", "right"),
        ("late", "right"),
        ("early", "right"),
        ("lost", "right"),
    ]
    rows = [_cells(one) for one in found]
    if len({one.recording for one in found}) == 1:
        del columns[0]
        rows = [row[1:] for row in rows]
    output.print_table(*output.fitted(columns, rows, ("early", "late", "from", "jitter", "Hz")))


def _cells(one: TopicCheck) -> list[str]:
    def duration(ns: float | None) -> str:
        return "" if ns is None else output.short_duration(round(ns))

    begin = one.gap_begin_ns
    late, early = (None, None) if one.is_latched else (one.late_ns, one.early_ns)
    return [
        one.recording,
        one.topic,
        str(one.messages),
        "" if one.rate_hz is None else f"{one.rate_hz:.2f}",
        duration(one.jitter_ns),
        duration(one.gap_ns),
        "" if begin is None else f"+{(begin - one.begin_ns) / 1e9:.3f}s",
        duration(late),
        duration(early),
        "?" if one.lost is None else str(one.lost),
    ]
