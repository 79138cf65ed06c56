"""The logger: the process of one run, with the backend in it; and the one that counts.

Both are sides: `python -m benchmarks.side benchmarks.harness.logger:log`. A run whose
backend fails ends like any other and says so in its values; only a crash leaves none.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from benchmarks import usage
from benchmarks.backends.base import Backend, BackendFailedError, BackendMissingError
from benchmarks.harness.publisher import READY, Counters
from benchmarks.harness.subscribers import Subscribers
from benchmarks.loads.base import Load
from benchmarks.side import Values, named

Publishing = dict[str, Any]
"""What the publisher needs besides: `counters`, a file that is made; `speed`; `limit`, the
messages that a queue holds."""

_LOOK_S = 0.1
_END_S = 5.0


class StoppedError(Exception):
    """Whoever started this process wants its end."""


def log(*, load: str, backend: str, directory: str, publishing: Publishing) -> Values:
    """Publish a load into a backend."""
    opened = Load.open(Path(load))
    values: Values = {"status": "ok", "reason": ""}
    with ended_by_signals():
        system = named(backend)(Path(directory))
        try:
            system.check()
            system.open(opened.channels)
            _run(system, opened, publishing, values)
        except BackendMissingError as error:
            values |= {"status": "missing", "reason": str(error)}
        except (BackendFailedError, StoppedError) as error:
            values |= {"status": "failed", "reason": str(error)}
        finally:
            _close(system, values)
    return values


def count(*, load: str, backend: str, directory: str) -> Values:
    """What a backend holds that another process has filled."""
    opened = Load.open(Path(load))
    values: Values = {"status": "ok", "reason": ""}
    with ended_by_signals():
        system = named(backend)(Path(directory))
        try:
            system.open(opened.channels)
            values["counts"] = {topic: int(n) for topic, n in system.counts().items()}
        except (BackendMissingError, BackendFailedError, StoppedError) as error:
            values |= {"status": "failed", "reason": str(error)}
        finally:
            _close(system, values)
    return values


def _close(system: Backend, values: Values) -> None:
    try:
        system.close()
    except BackendFailedError as error:
        if values["status"] == "ok":
            values |= {"status": "failed", "reason": str(error)}


def _run(system: Backend, load: Load, publishing: Publishing, values: Values) -> None:
    """Everything between opening and closing; `values` is filled as things become known."""
    counters = Counters(Path(publishing["counters"]), len(load.channels))
    subscribers = Subscribers(load, system, counters)
    pipes = [os.pipe() for _ in load.channels]
    arguments = {
        **publishing,
        "load": str(load.payloads.parent),
        "pipes": [write for _, write in pipes],
    }
    publisher = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.harness.publisher", json.dumps(arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        pass_fds=[write for _, write in pipes],
    )
    try:
        for _, write in pipes:
            os.close(write)
        assert publisher.stdin is not None
        assert publisher.stdout is not None
        if publisher.stdout.readline().strip() != READY:
            raise RuntimeError("the publisher did not start")
        values["spin_ms"] = usage.spin_ms()
        subscribers.start([read for read, _ in pipes])
        # A look of the collector at all that was imported would stop every subscriber for
        # tens of milliseconds, and be counted against whatever backend runs then.
        gc.collect()
        gc.freeze()
        meter = _Meter(system)
        publisher.stdin.write("go\n")
        publisher.stdin.flush()
        _watch(publisher, subscribers)
        failure = subscribers.failure
        if not subscribers.failed.is_set():
            try:
                system.finish()
            except BackendFailedError as error:
                failure = str(error) or "finish failed"
        meter.stop()
        said = publisher.stdout.read()
    finally:
        _end(publisher)
        if subscribers.first_error:
            values["insert_error"] = subscribers.first_error
    if not said and not failure:
        raise RuntimeError("the publisher did not come to its end")
    meter.note(values, json.loads(said) if said else {})
    values["peak_rss_payloads"] = subscribers.payload_rss()
    if failure:
        raise BackendFailedError(failure)


def _watch(publisher: subprocess.Popen[str], subscribers: Subscribers) -> None:
    """Wait until all that is published has been taken, or the backend has failed."""
    while not subscribers.join(_LOOK_S):
        if subscribers.failed.is_set():
            publisher.kill()  # waited for when all was measured: its time is not the backend's
            # Those that hang in the backend end with the process.
            subscribers.join(_END_S)
            return


def _end(publisher: subprocess.Popen[str]) -> None:
    if publisher.poll() is None:
        publisher.kill()
    publisher.wait()


class _Meter:
    """What a run uses, from its making until it is stopped."""

    def __init__(self, system: Backend) -> None:
        self._system = system
        self._servers = usage.cpu_s(self._pids())
        self._own = self._own_cpu()
        self._started = self._stopped = time.monotonic_ns()

    def stop(self) -> None:
        """Read all clocks."""
        self._stopped = time.monotonic_ns()
        self._own = self._own_cpu() - self._own
        pids = self._pids()
        self._servers = max(usage.cpu_s(pids) - self._servers, 0.0)
        self._server_peak = usage.peak_rss(pids)

    def note(self, values: Values, published: dict[str, Any]) -> None:
        """Note what was used."""
        values |= published
        start = values.pop("start_ns", self._started)
        values |= {
            "publish_s": (values.pop("end_ns", self._stopped) - start) / 1e9,
            "wall_s": (self._stopped - start) / 1e9,
            "cpu_s": self._own,
            "server_cpu_s": self._servers,
            "server_peak_rss": self._server_peak,
        }

    def _pids(self) -> set[int]:
        pids = self._system.processes()
        return usage.with_children(pids) if pids else set()

    @staticmethod
    def _own_cpu() -> float:
        # Children that were waited for count, such as hybridlog's follower; servers go on.
        both = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        return sum(used.ru_utime + used.ru_stime for used in both)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """SIGTERM ends the block from within, so that what it has started is ended, too."""

    def stop(number: int, frame: FrameType | None) -> None:
        # Once: the second one must not disturb the end.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise StoppedError("the run was ended from outside")

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
