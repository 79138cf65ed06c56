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
from contextvars import ContextVar
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
    handler, block = signal.getsignal(signal.SIGINT), _Block()
    if handler is signal.default_int_handler:
        signal.signal(signal.SIGINT, _delay_interrupt)
    _block = block
    try:
        yield
    finally:
        _block = None
        if handler is signal.default_int_handler:
            signal.signal(signal.SIGINT, handler)
        if block.action is not None:
            block.action()


class GivenUpError(BaseException):
    """Nobody waits for the answer. It is no `Exception`, so that nothing takes it for damage."""


_given_up: ContextVar[threading.Event | None] = ContextVar("given_up", default=None)
"""Set once nobody waits for the answer that this thread works out."""


@contextmanager
def until_given_up(given_up: threading.Event) -> Iterator[None]:
    """Work out an answer in this thread until the event is set: then `GivenUpError` is raised."""
    before = _given_up.set(given_up)
    try:
        yield
    finally:
        _given_up.reset(before)


def check_wanted() -> None:
    """Raise `GivenUpError` if nobody waits for the answer of this thread."""
    given_up = _given_up.get()
    if given_up is not None and given_up.is_set():
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


def _delay_interrupt(number: int, frame: FrameType | None) -> None:
    """In the place of Python's own answer to Ctrl-C."""
    if not postpone(_interrupt):
        signal.default_int_handler(number, frame)


def _interrupt() -> NoReturn:
    raise KeyboardInterrupt
