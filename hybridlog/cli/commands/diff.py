"""`hybridlog diff`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.answers import Listing
from hybridlog.cli.app import DIFFERENT
from hybridlog.cli.options import (
    Between,
    InStore,
    Quiet,
    argument,
    command,
    one_recording,
    option,
    topics,
)
from hybridlog.cli.output import Column

if TYPE_CHECKING:
    pass


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
