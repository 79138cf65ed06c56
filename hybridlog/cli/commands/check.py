"""`hybridlog check`."""

from __future__ import annotations

from collections.abc import Mapping
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
from hybridlog.cli.output import Column

if TYPE_CHECKING:
    pass


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
