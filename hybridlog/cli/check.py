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
from hybridlog.cli.answers import print_cost, print_remarks
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked

if TYPE_CHECKING:
    from hybridlog.query.answers.regularity import TopicCheck
    from hybridlog.query.choice import Choice


@click.command()
@options.only_recordings
@options.only_topics
@options.store
@options.between
@options.choice
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
    strict: bool,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Show how regularly topics came, the worst first.

    Rate, jitter, longest gap and where it begins, late start, early stop and losses of each
    topic. No message is read.
    """
    started = time.monotonic()
    with opened_store(store, mongo, quiet=quiet or as_json) as opened:
        query = asked(opened, topic, choice, between=between, where=(), strict=strict)
        found = query.check()
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
    output.print_table(columns, rows)


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
