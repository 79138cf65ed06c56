from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import pytest

from hybridlog_storage.stopping import (
    Flag,
    at_safe_points,
    pause,
    postpone,
    safe_point,
)

LONG_S = 30.0


class Stop(BaseException):
    pass


def stop() -> NoReturn:
    raise Stop


@pytest.fixture(autouse=True)
def handled() -> Iterator[None]:
    """SIGTERM raises where that is safe; SIGINT is Python's."""
    before = signal.signal(signal.SIGTERM, lambda *_: postpone(stop))
    interrupt = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGINT, interrupt)


@contextmanager
def stopped(
    number: signal.Signals = signal.SIGTERM, error: type[BaseException] = Stop
) -> Iterator[list[str]]:
    """What is done in a block that gets a signal, until that stops it."""
    done: list[str] = []
    try:
        with at_safe_points():
            safe_point()
            signal.raise_signal(number)
            yield done
    except error:
        return
    pytest.fail("Nothing stopped it.")


def test_a_signal_waits_for_a_safe_point() -> None:
    with stopped() as done:
        done.append("more")
        safe_point()
        done.append("too much")
    assert done == ["more"]
    assert not postpone(stop)


def test_the_end_of_the_outermost_block_is_a_safe_point() -> None:
    with stopped() as done:
        with at_safe_points():
            signal.raise_signal(signal.SIGTERM)
        done.append("after the inner one")
    assert done == ["after the inner one"]


def test_what_stops_is_raised_even_if_the_block_fails() -> None:
    def work() -> None:
        with at_safe_points():
            signal.raise_signal(signal.SIGTERM)
            raise ValueError

    with pytest.raises(Stop) as found:
        work()
    assert isinstance(found.value.__context__, ValueError)


def test_cleaning_up_is_not_stopped_by_the_same_signal() -> None:
    with stopped() as done:
        try:
            safe_point()
        finally:
            safe_point()
            done.append("clean")
    assert done == ["clean"]


def test_ctrl_c_waits_in_a_block_and_not_beside_it() -> None:
    with stopped(signal.SIGINT, KeyboardInterrupt) as done:
        done.append("more")
        safe_point()
    assert done == ["more"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_of_the_program_stays() -> None:
    seen = []
    signal.signal(signal.SIGINT, lambda number, _: seen.append(number))
    with at_safe_points():
        signal.raise_signal(signal.SIGINT)
    assert seen == [signal.SIGINT]


def test_other_threads_are_not_stopped() -> None:
    done = []

    def elsewhere() -> None:
        with at_safe_points():
            pause(0)
            safe_point()
            done.append("all")

    with stopped():
        thread = threading.Thread(target=elsewhere)
        thread.start()
        thread.join()
        safe_point()
    assert done == ["all"]


def test_a_signal_ends_a_pause() -> None:
    timer = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGTERM))
    started = time.monotonic()

    def work() -> None:
        with at_safe_points():
            timer.start()
            pause(LONG_S)

    with pytest.raises(Stop):
        work()
    assert time.monotonic() - started < LONG_S
    timer.join()


def test_a_flag_wakes_whoever_waits() -> None:
    flag = Flag()
    assert not flag.wait(0)
    flag.set()
    flag.set()
    assert flag.wait(LONG_S)
    assert flag.wait(LONG_S)
    assert flag.is_set
