"""The messages of a slice: a part of a recording as a file of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from hybridlog.attachments import Extras
    from hybridlog.export.base import LogWriter
    from hybridlog.query.query import Query
    from hybridlog_storage.messages import Batch, Channel


@dataclass(frozen=True, slots=True)
class Front:
    """The choice of latched messages from before the time range, in MCAP and bag files.

    Attributes:
        latched: They are written.
        original_times: They keep their log time.
    """

    latched: bool = True
    original_times: bool = False


IN_FORCE: Final = Front()
"""The latched messages that are in force, at the beginning of the slice."""


def batches_of(query: Query, front: Front) -> Iterator[tuple[Batch, Sequence[Channel]]]:
    """The messages of a slice in the order of the file, many at once.

    Args:
        query: The query; its counters count the messages, those in front as `latched`.
        front: The latched messages in front of the answer.
    """
    before = query.copy()
    if front.latched:
        for batch, channels in before.latched(original_times=front.original_times):
            yield batch, [c.channel for c in channels]
    for batch, channels in query.batches():
        yield batch, [c.channel for c in channels]
    query.counters.add(before.counters)


def profile_of(query: Query) -> str:
    """The MCAP profile of a slice: `ros1` or `ros2`, empty for others and for a mixture."""
    encodings = query.encodings()
    return {"ros1": "ros1", "cdr": "ros2"}.get(encodings.pop(), "") if len(encodings) == 1 else ""


def add_extras(log: LogWriter, extras: Extras) -> Iterator[str]:
    """Write what a log has beside its messages.

    Yields:
        A sentence about each record or attachment that is left out because it is damaged.
    """
    log.declare(extras.channels)
    for metadata in extras.metadata:
        log.add_metadata(metadata.name, metadata.values)
    for problem in extras.problems:
        yield f"A metadata record is left out: {problem}"
    for attachment in extras.attachments:
        try:
            checked = attachment.open()
        except SegmentError as error:
            yield f"The attachment {attachment.name!r} is left out: {error}"
            continue
        log.add_attachment(checked)


def write_mcap(query: Query, path: Path) -> None:
    """Write a slice as an MCAP file, as `hybridlog export` does; all of it or nothing."""
    from hybridlog.export.mcap import McapWriter

    with McapWriter(path, profile=profile_of(query)) as log:
        for _ in add_extras(log, query.extras()):
            pass  # the ledger has what is damaged
        for batch, channels in batches_of(query, IN_FORCE):
            log.write(batch, channels)
