from __future__ import annotations

import signal
import threading
import time

import pytest

from hybridlog_storage.cache import lazy
from hybridlog_storage.threads import Threads
from tests.waiting import at_once


class Interrupted(BaseException):
    pass


def test_what_runs_is_waited_for_again_after_an_interruption() -> None:
    go, done = threading.Event(), []

    def work() -> None:
        go.wait(30)
        time.sleep(0.1)
        done.append(True)

    def interrupt(*_: object) -> None:
        raise Interrupted

    before = signal.signal(signal.SIGALRM, interrupt)
    threads = Threads(1, "test")
    try:
        threads.submit(work)
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(Interrupted):
            threads.shutdown(wait=True)
        go.set()
        threads.shutdown(wait=True, cancel_futures=True)
        assert done == [True]
    finally:
        go.set()
        signal.signal(signal.SIGALRM, before)


def test_threads_get_one_value_of_a_lazy_attribute() -> None:
    both = threading.Barrier(2)

    class Made:
        @lazy
        def value(self) -> object:
            """Another object each time."""
            both.wait(60)
            return object()

    made, found = Made(), []
    at_once(*[lambda: found.append(made.value)] * 2)
    assert found == [made.value] * 2
    assert Made.value.__doc__ == "Another object each time."
