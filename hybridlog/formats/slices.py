"""Slices: parts of a recording as files of their own."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterator, Sequence
from copy import copy
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from hybridlog.formats.writing import Answer
from hybridlog.query.planner import Planner

if TYPE_CHECKING:
    from hybridlog.attachments import Extras
    from hybridlog.query.query import Query
    from hybridlog_storage.messages import Batch, Channel


class Front(Struct, frozen=True):
    """Latched messages from before the time range, and whether these keep their log time."""

    latched: bool = True
    original_times: bool = False


IN_FORCE: Final = Front()
"""The latched messages that are in force, at the beginning of the slice."""


def batches_of(query: Query, front: Front) -> Iterator[tuple[Batch, Sequence[Channel]]]:
    """The messages of a slice in the order of the file, many at once."""
    before = copy(query)
    if front.latched:
        for batch, channels in before.latched(original_times=front.original_times):
            yield batch, [c.channel for c in channels]
    for batch, channels in query.batches():
        yield batch, [c.channel for c in channels]
    query.counters.add(before.counters)


def fingerprint(query: Query) -> str:
    """A digest of a question and of the state of its recordings, in hexadecimal digits.

    As long as it is the same, so is the answer.
    """
    states = [
        (o.id, o.look, o.status, o.messages, o.extent)
        for o in query.source.now().summaries_of(query.question)
    ]
    return hashlib.sha256(pickle.dumps((query.question, states), protocol=5)).hexdigest()


def profile_of(query: Query) -> str:
    """The MCAP profile of a slice: `ros1` or `ros2`, empty for others and for a mixture."""
    examples = Planner(query.source.now(), query.question).examples
    spoken = [channel for channel in examples if channel.stats.messages] or examples
    encodings = {channel.channel.message_encoding for channel in spoken}
    return {"ros1": "ros1", "cdr": "ros2"}.get(encodings.pop(), "") if len(encodings) == 1 else ""


def log_of(query: Query, front: Front = IN_FORCE, extras: Extras | None = None) -> Answer:
    """A slice as a log."""
    return Answer(batches=batches_of(query, front), extras=extras, profile=profile_of(query))
