"""The subscribers: a thread a topic, which hands messages to the backend."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks import usage
from benchmarks.backends.base import Backend, BackendFailedError
from benchmarks.harness.publisher import TOKEN

if TYPE_CHECKING:
    from benchmarks.harness.publisher import Counters
    from benchmarks.loads.base import Load

_HELD = 128 << 20  # bytes of payloads up to which they are held in memory
_QUEUE_READ = 16 * TOKEN


class Subscribers:
    """Threads that take messages from pipes until these end or the backend fails.

    A message whose insert raises anything but `BackendFailedError` is lost and counted,
    as in a logger that must go on.

    Attributes:
        failed: Set when the backend cannot go on.
        failure: Why.
        first_error: What the first insert that raised has said.
    """

    def __init__(self, load: Load, backend: Backend, counters: Counters) -> None:
        self.failed = threading.Event()
        self.failure = ""
        self.first_error = ""
        self._load = load
        self._backend = backend
        self._counters = counters
        self._payloads = _at_hand(load)
        self._threads: list[threading.Thread] = []

    def start(self, pipes: Sequence[int]) -> None:
        """Start taking messages."""
        for channel, pipe in enumerate(pipes):
            self._add(self._take_one, pipe, channel)
        for thread in self._threads:
            thread.start()

    def payload_rss(self) -> int:
        """Bytes of memory that the payloads take, of which no backend can know."""
        size = len(self._payloads)
        return size if size <= _HELD else usage.mapped_rss(self._load.payloads.resolve())

    def join(self, timeout_s: float) -> bool:
        """Wait until all is taken."""
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(deadline - time.monotonic(), 0))
        return not any(thread.is_alive() for thread in self._threads)

    def _add(self, take: Callable[..., None], *arguments: int) -> None:
        # A daemon: one that hangs in a dead backend does not keep the process.
        self._threads.append(
            threading.Thread(target=self._guard, args=(take, *arguments), daemon=True)
        )

    def _guard(self, take: Callable[..., None], pipe: int, *arguments: int) -> None:
        try:
            take(pipe, *arguments)
        except BackendFailedError as error:
            self._fail(str(error) or "the backend failed")
        except Exception as error:
            self._fail(f"a subscriber failed: {error!r}")
            raise
        finally:
            os.close(pipe)

    def _fail(self, reason: str) -> None:
        if not self.failed.is_set():
            self.failure = reason
            self.failed.set()

    def _take_one(self, pipe: int, channel: int) -> None:
        """Take the messages of one channel."""
        offset, length, payloads = self._load.offset, self._load.length, self._payloads
        insert, taken = self._backend.insert, self._counters.taken
        stop, now = self.failed.is_set, time.time_ns
        count = 0
        while data := os.read(pipe, _QUEUE_READ):
            for row in memoryview(data).cast("q"):
                if stop():
                    return
                # Out of the queue one by one: those read with it still wait.
                count += 1
                taken[channel] = count
                start = offset.item(row)
                payload = bytes(payloads[start : start + length.item(row)])
                try:
                    insert(channel, now(), payload)
                except BackendFailedError:
                    raise
                except Exception as error:
                    self._count_error(channel, error)

    def _count_error(self, channel: int, error: Exception) -> None:
        self._counters.errors[channel] += 1
        if not self.first_error:
            self.first_error = f"{type(error).__name__}: {error}"[:500]


def _at_hand(load: Load) -> memoryview:
    """The payloads, in memory unless they are too many.

    To take a message shall cost a copy, as when it came from a socket a moment ago. The small
    pages of a mapped file cost more on a virtual machine whose host lost sight of them: 20 to
    40 microseconds each, 1 to 14 ms a message of 640 kB, while nobody else has the interpreter.
    """
    size = load.payloads.stat().st_size
    if not 0 < size <= _HELD:
        mapped = load.map()
        # Every page is looked at once, so that no subscriber waits for it to be mapped.
        np.frombuffer(mapped, np.uint8)[::4096].max(initial=0)
        return mapped
    memory = np.empty(size, np.uint8)  # in huge pages
    with load.payloads.open("rb") as stream:
        if stream.readinto(memory.data) != size:
            raise OSError(f"{load.payloads} was cut short.")
    return memory.data.toreadonly()
