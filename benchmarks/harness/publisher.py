"""The publisher: a process of its own that follows the schedule and nothing else.

A message travels as its row, eight bytes through a pipe; the payload lies in a file
that the logger has mapped. The publisher never waits for the logger: a message that
finds its queue full is dropped and counted, and the next one is due when it is due.

Started by the logger as `python -m benchmarks.harness.publisher ARGUMENTS`, with JSON
for arguments. Writes a line when it is ready, starts on a line, and ends with one line
of JSON.
"""

from __future__ import annotations

import json
import mmap
import os
import sys
import time
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loads.base import Load

READY = "ready"
TOKEN = 8
"""Bytes of a row on its way through a pipe, little-endian."""

_HEAD_START_NS = 5_000_000
_BLOCK = 4096
"""Rows made Python numbers at once: a tenth of a millisecond, also in a log of millions."""
_BATCH = 512
"""Messages after which the clock is looked at again by a publisher that is late."""


class Counters:
    """The numbers of one run.

    Attributes:
        sent: Messages of each channel that entered its queue; the publisher writes.
        dropped: Messages of each channel that found their queue full; the publisher writes.
        taken: Messages of each channel that left their queue; the channel's subscriber writes.
        errors: Messages of each channel whose insert raised; the channel's subscriber writes.
    """

    def __init__(self, path: Path, topics: int | None = None) -> None:
        if topics is not None:
            path.write_bytes(bytes(8 * 4 * topics))
        with path.open("r+b") as stream:
            whole = memoryview(mmap.mmap(stream.fileno(), 0)).cast("q")
        count = len(whole) // 4
        self.sent, self.dropped, self.taken, self.errors = (
            whole[n * count : (n + 1) * count] for n in range(4)
        )

    def published(self) -> list[int]:
        """Messages that were due, of each channel: those sent and those dropped."""
        sums: list[int] = (np.array(self.sent) + np.array(self.dropped)).tolist()
        return sums


def publish_to_queues(
    load: Load, counters: Counters, *, start: int, speed: float, pipes: Sequence[int], limit: int
) -> int:
    """Publish into a queue a topic; returns when the last message was published."""
    all_sent, all_dropped, taken = counters.sent, counters.dropped, counters.taken
    sent, dropped = [0] * len(pipes), [0] * len(pipes)
    write = os.write
    for first, channels in _batches(load, start, speed):
        for row, channel in enumerate(channels, first):
            if sent[channel] - taken[channel] < limit:
                sent[channel] += 1
                # First: whoever takes a message has been counted as a waiting one.
                all_sent[channel] = sent[channel]
                write(pipes[channel], row.to_bytes(TOKEN, "little"))
            else:
                dropped[channel] += 1
                all_dropped[channel] = dropped[channel]
    return time.monotonic_ns()


def _batches(load: Load, start: int, speed: float) -> Iterator[tuple[int, list[int]]]:
    """Sleep until messages are due; give the first row and the channels."""
    clock = time.monotonic_ns
    for block in range(0, len(load), _BLOCK):
        rows = slice(block, block + _BLOCK)
        due = (start + np.rint(load.due[rows] / speed).astype(np.int64)).tolist()
        channels = load.channel[rows].tolist()
        at = 0
        while at < len(due):
            now = clock()
            if due[at] > now:
                time.sleep((due[at] - now) / 1e9)
                continue
            stop = bisect_right(due, now, at, min(at + _BATCH, len(due)))
            yield block + at, channels[at:stop]
            at = stop


def main(*, load: str, counters: str, pipes: list[int], limit: int, speed: float) -> dict[str, Any]:
    """Publish a load once."""
    opened = Load.open(Path(load))
    shared = Counters(Path(counters))
    print(READY, flush=True)
    sys.stdin.readline()
    start = time.monotonic_ns() + _HEAD_START_NS
    end = publish_to_queues(opened, shared, start=start, speed=speed, pipes=pipes, limit=limit)
    for pipe in pipes:
        os.close(pipe)
    return {"start_ns": start, "end_ns": end}


if __name__ == "__main__":
    try:
        print(json.dumps(main(**json.loads(sys.argv[1]))))
    except (BrokenPipeError, KeyboardInterrupt):
        sys.exit(1)
