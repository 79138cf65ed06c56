"""Counts the cost of an answer."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlog.schema.states import State
    from hybridlog_storage.messages import Batch
    from hybridlog_storage.segments.chunk import StoredChunk


@dataclass(slots=True)
class Counters:
    """The cost of an answer, and what is missing from it.

    Attributes:
        messages: Messages in the answer.
        latched: Latched messages in front of it, which are not in `messages`.
        frames: Frames of video in front of it, from the key frame on; not in `messages`.
        payload_bytes: Bytes of their payloads.
        bytes_read: Bytes read from segments and tables.
        chunks_read: Chunks read and decompressed.
        documents_read: Index documents received from MongoDB.
        reduced: Messages left out because only their fields are there.
        expired: Those of them whose payloads were deleted to make room.
        not_copied: Those of them whose payloads were not copied yet.
        lacking: Messages in the answer whose arrays are null, since only summaries are left.
        unreadable: Messages of the predicate's topics that do not fit their definition, or lack
            arrays that it asks for.
        without_arrays: Those of them that lack arrays, since their payloads are gone.
        not_indexed: Names of recordings with the number of messages that the index lacks, if it
            has answered; several.
        no_transform: The frame asked for with a reason why points or poses are not in it, and
            the number of messages; several.
        of_frames: Sentences about the transforms that were used.
        elapsed_s: Wall time, seconds.
    """

    messages: int = 0
    latched: int = 0
    frames: int = 0
    payload_bytes: int = 0
    bytes_read: int = 0
    chunks_read: int = 0
    documents_read: int = 0
    reduced: int = 0
    expired: int = 0
    not_copied: int = 0
    lacking: int = 0
    unreadable: int = 0
    without_arrays: int = 0
    not_indexed: tuple[tuple[str, int], ...] = ()
    no_transform: tuple[tuple[str, int], ...] = ()
    of_frames: tuple[str, ...] = ()
    elapsed_s: float = 0.0

    @property
    def unindexed(self) -> int:
        """Messages that the index lacks, if it has answered."""
        return sum(number for _, number in self.not_indexed)

    def reset(self) -> None:
        """Set every counter to zero."""
        for each in fields(self):
            setattr(self, each.name, each.default)

    def copy(self) -> Counters:
        """The same counts."""
        return replace(self)

    def add(self, other: Counters) -> None:
        """Add the counts of a part of the answer; the wall time is unchanged."""
        for each in fields(self):
            if each.name != "elapsed_s":
                total = getattr(self, each.name) + getattr(other, each.name)
                setattr(self, each.name, total)

    def add_chunk(self, chunk: StoredChunk) -> None:
        """Count a chunk that was read."""
        self.chunks_read += 1
        self.bytes_read += chunk.length + chunk.trailer

    def add_messages(self, batch: Batch) -> None:
        """Count messages of the answer."""
        self.messages += len(batch)
        self.payload_bytes += batch.payload_bytes

    def leave_out(self, messages: int, state: State) -> None:
        """Count messages that are left out since their payloads are gone."""
        self.reduced += messages
        self.expired += messages * (state == "expired")
        self.not_copied += messages * (state == "not_copied")

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Set every counter to zero and measure the wall time of the block."""
        self.reset()
        started = time.monotonic()
        try:
            yield
        finally:
            self.elapsed_s = time.monotonic() - started
