"""`hybridlog check`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.answers import SCREEN, Listing, answering, check_room, write_bytes
from hybridlog.cli.app import DIFFERENT
from hybridlog.cli.options import (
    Strict,
    Topics,
    command,
    option,
)
from hybridlog.cli.output import Column, duration_of, rate_of

if TYPE_CHECKING:
    from hybridlog.contract.judge import Result


class _Given(Strict, Topics, Listing):
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


@command(_Given)
def check_command(given: _Given) -> int:
    """Show how regularly topics came, the worst first.

    Rate, jitter, longest gap and where it begins, late start, early stop and losses of each
    topic. No message is read.
    """
    from hybridlog.contract import Contract, contract_of

    contract, make = given.contract, given.make
    for path in filter(None, (make, given.junit)):
        check_room(path, force=given.force)
    if contract is not None:
        rules = Contract.read(contract)
        with given.opened(snapshot=True) as store:
            chosen = given.recordings_in(store)
            results = [one for name in chosen.ids for one in store.judge(rules, name)]
        return _show_verdict(results, len(chosen), given)
    with answering(given) as query:
        found = query.check()
        if make is not None:
            write_bytes(make, contract_of(found).encode())
            return 0
        columns = [
            Column("recording", varies=True),
            Column("topic"),
            Column("messages", side="right"),
            rate_of("Hz", "rate_hz", order=3),
            duration_of("jitter", "jitter_ns", order=2),
            duration_of("longest gap", "gap_ns"),
            Column("from", _gap_begin, "right", order=1),
            duration_of("late", lambda row: _edge(row, "late_ns"), order=5),
            duration_of("early", lambda row: _edge(row, "early_ns"), order=4),
            Column("lost", lambda row: "?" if row["lost"] is None else row["lost"], "right"),
        ]
        given.show(map(asdict, found), columns, "No topic.")
    return 0


def _edge(row: Mapping[str, Any], name: str) -> int | None:
    return None if row["is_latched"] else row[name]


def _gap_begin(row: Mapping[str, Any]) -> str:
    begin = row["gap_begin_ns"]
    return "" if begin is None else f"+{(begin - row['begin_ns']) / 1e9:.3f}s"


def _show_verdict(results: Sequence[Result], recordings: int, given: _Given) -> int:
    from hybridlog.contract.judge import broken, junit_of

    if given.junit is not None:
        write_bytes(given.junit, junit_of(results).encode())
    bad = broken(results)
    names = ("recording", "topic", "rule", "wanted", "found")
    given.show(map(asdict, bad if given.to_form == SCREEN else results), [*map(Column, names)])
    rules, where = output.counted(len(results), "rule"), output.counted(recordings, "recording")
    output.remarks([f"{rules} in {where}: {len(bad) or 'none'} broken."])
    return DIFFERENT if bad else 0
