"""Notes on standard error about an answer: its cost and what it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.coverage import gaps
from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.query.counters import Counters
    from hybridlog.query.query import Query


def print_cost(counters: Counters, elapsed: float, *, count: bool) -> None:
    """Print what an answer cost, as far as it cost anything.

    Args:
        counters: Of the query.
        elapsed: Seconds, including the opening of the store.
        count: The answer was a number, not messages.
    """
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


def print_gaps(query: Query, between: tuple[str, str] | None) -> None:
    """Print what an answer may lack, a line a recording.

    Args:
        query: The query that was answered.
        between: Its time range as typed, by the log clock; None for all times.
    """
    doubtful = query.doubtful()
    for line in gaps(doubtful, query.topics, between):
        output.note(line)
    for label in (entry.label for entry in doubtful if entry.status == "open"):
        messages = _not_indexed(query.directory, label)
        if messages:
            are = "is" if messages == 1 else "are"
            output.note(
                f"{label}: {output.counted(messages, 'recorded message')} {are} not indexed yet."
            )


def _not_indexed(store: Path, recording: str) -> int:
    """Number of messages of a running recorder that no answer has yet; 0 if it does not say."""
    from hybridlog.live.control_server import request

    try:
        messages = request(store, recording, "state").get("lag")
    except HybridlogError:  # it has just ended, or belongs to another user
        return 0
    return messages if isinstance(messages, int) else 0


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
    for line in query.remarks(*topics, is_empty=is_empty):
        output.note(line)


def print_left_out(query: Query, counters: Counters) -> None:
    """Print how many messages are left out of a summary because they are unreadable.

    Args:
        query: The query; messages of which its predicate could not be asked are remarked.
        counters: Of the answer.
    """
    predicate = query.question.predicate
    if predicate is None or not predicate.asks_fields:
        print_unreadable(counters.unreadable)


def print_unreadable(missing: int) -> None:
    """Print how many messages are missing because they do not fit their definition."""
    if missing > 0:
        are = "is" if missing == 1 else "are"
        output.note(
            f"{output.unfit(missing)} and {are} not in this answer; --format raw, mcap or bag "
            "gives the payloads."
        )


def print_reduced(reduced: int) -> None:
    """Print how many messages have no payload because the recorder dropped it."""
    if reduced:
        have = "has" if reduced == 1 else "have"
        output.note(
            f"{output.counted(reduced, 'message')} {have} no payload, which was dropped under "
            "pressure: not in this answer; --where and --fields find the fields."
        )
