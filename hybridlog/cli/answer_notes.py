"""Notes on standard error about an answer: its cost and what it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from hybridlog.cli import output
from hybridlog.cli.options import VERBOSE

if TYPE_CHECKING:
    from hybridlog.query.counters import Counters
    from hybridlog.query.query import Query


def print_cost(counters: Counters, elapsed: float, *, count: bool) -> None:
    """Print what an answer cost, with `--verbose`; without, the latched messages in front.

    Args:
        counters: Of the query.
        elapsed: Seconds, including the opening of the store.
        count: The answer was a number, not messages.
    """
    if not click.get_current_context().meta.get(VERBOSE):
        if counters.latched and not count:
            output.note(f"{output.counted(counters.latched, 'latched message')} in front")
        return
    used = []
    if not count:
        given = counters.messages - counters.reduced
        used.append(f"{output.counted(given, 'message')}{latched(counters)}")
    if counters.payload_bytes:
        used.append(f"{output.size(counters.payload_bytes)} of payload")
    if counters.bytes_read:
        chunks = counters.chunks_read
        where = f" in {output.counted(chunks, 'chunk')}" if chunks else ""
        used.append(f"{output.size(counters.bytes_read)} read from disk{where}")
    if counters.documents_read:
        used.append(output.counted(counters.documents_read, "index document"))
    time = f"{elapsed:.3f} s"
    output.note(f"{', '.join(used)}, {time}" if used else f"answered in {time}")


def latched(counters: Counters) -> str:
    """The end of a number of messages: ` and 2 latched messages in front`, if any."""
    if not counters.latched:
        return ""
    return f" and {output.counted(counters.latched, 'latched message')} in front"


def print_lost(query: Query, count: int) -> None:
    """Print the limits of a count of messages, if any of the range are lost."""
    lost = query.lost()
    if lost:
        output.note(lost.describe(count, query.question.limit))


def print_remarks(query: Query, topics: Sequence[str], *, is_empty: bool | None = None) -> None:
    """Print what is to be known about an answer, a line each.

    Args:
        query: The query that was answered.
        topics: Its topics as typed.
        is_empty: The answer was empty; None to tell by its counters.
    """
    output.notes(query.remarks(*topics, is_empty=is_empty))
