"""Points at which a signal may stop the process, and an answer that nobody waits for ends.

Python runs a signal handler between any two instructions of the main thread. An exception
raised there can leave a lock of the standard library held for ever, such as that of a
`Condition`, a `Future` or a pool. Threads that need it then never end, and cleanup waits for
them. So work that shares locks with threads, or that must be taken back when it is stopped,
runs in `at_safe_points`: handlers only note the signal, and `safe_point` raises.

An answer that is worked out in a thread for a client runs in `until_given_up`. It ends where
something is read next, by `check_wanted`, or while it waits for a lock, by `held`.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from types import FrameType
from typing import NoReturn

Action = Callable[[], NoReturn]
"""Raises the exception that stops the work."""
_POLL_S = 0.05


class Flag:
    """An event for signal handlers: they may interrupt its own methods, unlike an `Event`'s.

    Only one thread may wait for it.
    """

    def __init__(self) -> None:
        self.is_set = False
        self._calls: SimpleQueue[None] = SimpleQueue()

    def set(self) -> None:
        """Set it, and wake the waiting thread."""
        self.is_set = True
        self._calls.put(None)

    def wait(self, seconds: float | None) -> bool:
        """Wait until it is set, for at most so long unless that is None; return whether it is."""
        if not self.is_set:
            with suppress(Empty):
                self._calls.get(timeout=None if seconds is None else max(seconds, 0))
        return self.is_set


class _Block:
    """The outermost block that is stopped at safe points only."""

    def __init__(self) -> None:
        self.flag = Flag()
        self.thread = threading.get_ident()
        self.action: Action | None = None


_block: _Block | None = None


@contextmanager
def at_safe_points() -> Iterator[None]:
    """Stop the block at its safe points only; its end is one, too.

    In the main thread, Ctrl-C raises `KeyboardInterrupt` there, unless the program handles it
    in another way. Blocks may be nested; the outermost counts. Does nothing in other threads.
    """
    global _block  # noqa: PLW0603 - signals belong to the process
    if _block is not None or threading.current_thread() is not threading.main_thread():
        yield
        return
    with _delayed_interrupt():
        block = _block = _Block()
        try:
            yield
        finally:
            _block = None
            if block.action is not None:
                block.action()


class GivenUpError(BaseException):
    """Nobody waits for the answer. It is no `Exception`, so that nothing takes it for damage."""


class _Answer(threading.local):
    """The answer that a thread works out."""

    given_up: threading.Event | None = None


_answer = _Answer()


@contextmanager
def until_given_up(given_up: threading.Event) -> Iterator[None]:
    """Work out an answer in this thread until the event is set: then `GivenUpError` is raised."""
    _answer.given_up = given_up
    try:
        yield
    finally:
        _answer.given_up = None


def check_wanted() -> None:
    """Raise `GivenUpError` if nobody waits for the answer of this thread."""
    if _answer.given_up is not None and _answer.given_up.is_set():
        raise GivenUpError


@contextmanager
def held(lock: threading.Lock | threading.Semaphore) -> Iterator[None]:
    """Hold a lock. While the thread waits for it, its answer may be given up."""
    while not lock.acquire(timeout=_POLL_S):
        check_wanted()
    try:
        yield
    finally:
        lock.release()


def safe_point() -> None:
    """Raise what a signal asked for, if the block of this thread is to stop."""
    check_wanted()
    block = _block
    if block is not None and block.action is not None and block.thread == threading.get_ident():
        action, block.action = block.action, None
        action()


def pause(seconds: float) -> None:
    """Sleep; a safe point at the beginning and at the end, which a signal hastens."""
    safe_point()
    block = _block
    if block is None or block.thread != threading.get_ident():
        time.sleep(seconds)
        return
    block.flag.wait(seconds)
    safe_point()


def postpone(action: Action) -> bool:
    """Have `action` called at the next safe point. For signal handlers.

    False outside of `at_safe_points`: the handler has to stop the process itself.
    """
    block = _block
    if block is None:
        return False
    if block.action is None:
        block.action = action
    block.flag.set()
    return True


@contextmanager
def _delayed_interrupt() -> Iterator[None]:
    """Delay Python's own answer to Ctrl-C."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        if not postpone(_interrupt):
            signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _interrupt() -> NoReturn:
    raise KeyboardInterrupt
