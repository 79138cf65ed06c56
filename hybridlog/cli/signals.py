"""Ctrl-C, `kill` and a closed terminal stop a command.

A command that only reads, or whose work the next change of the store completes or takes back,
ends at once, without unwinding: unfinished output files are removed, and the process leaves.
Work in `stopping.at_safe_points` takes itself back: there `Stopped` is raised, at a safe
point. It is no `KeyboardInterrupt`, because libraries catch that. A second signal always ends
the process.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from types import FrameType
from typing import Final, NoReturn

from hybridlog.cli import output
from hybridlog_storage import stopping
from hybridlog_storage.disk.files import undo_unfinished
from hybridlog_storage.errors import (
    BucketError,
    DatabaseError,
    HybridlogError,
    ResourceError,
    StoreError,
)

SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that stop a command, as far as this system has them."""

INTERRUPTED: Final = "interrupted: undone, or finished by a later command."
_SHOW_CURSOR: Final = "\r\x1b[K\x1b[?25h"
"""Clears the line of a progress bar."""

_AWAY: Final = (BucketError, DatabaseError, ResourceError, StoreError)
"""Errors that may have gone at a later look."""


class Stopped(BaseException):
    """A signal stopped the command."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.exit_code = 128 + number
        """As in shells."""


def install() -> None:
    """Let the signals stop the command. Call it in the main thread of the command's process.

    SIGINT counts even if it was ignored, which shells without job control do to background jobs;
    an ignored SIGHUP (`nohup`) or SIGTERM stays ignored.
    """
    told: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        told.append(number)
        if len(told) > 1 or not stopping.postpone(partial(_stop, number)):
            _leave(number)

    for number in SIGNALS:
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)


@contextlib.contextmanager
def handled(
    handler: Callable[[int], object], numbers: Sequence[int] = SIGNALS
) -> Iterator[Callable[[], None]]:
    """Handle signals that are not ignored, in a block; gives what ends that before."""
    before = {number: signal.getsignal(number) for number in numbers}

    def restore() -> None:
        for number, old in before.items():
            signal.signal(number, old)

    for number, old in before.items():
        if old is not signal.SIG_IGN:
            signal.signal(number, lambda number, _: handler(number))
    try:
        yield restore
    finally:
        restore()


@contextlib.contextmanager
def ended_by_signal(end: Callable[[], object]) -> Iterator[None]:
    """Let the first signal end a server, with exit code 0; a second one ends the process."""

    def stop(_: int) -> None:
        restore()
        end()

    with handled(stop) as restore:
        yield


def watch(
    place: object,
    look: Callable[[], Iterable[HybridlogError]],
    *,
    pause_s: float = 2.0,
    report: Callable[[HybridlogError], None] = lambda error: output.note(str(error)),
) -> None:
    """Call `look`, which acts and yields problems, again and again; a signal ends this normally.

    A problem is reported once, as long as it lasts.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # a file and a pipe show each line at once
        sys.stdout.reconfigure(line_buffering=True)
    told: set[str] = set()  # problems that last
    with contextlib.suppress(Stopped), stopping.at_safe_points():
        output.remarks([f"Watching {place}. Ctrl-C ends it."])
        while True:
            met = list[HybridlogError]()
            try:
                met.extend(look())
            except _AWAY as error:
                # Ctrl-C may have ended a program that the other side needs.
                stopping.safe_point()
                met.append(error)
            for problem in met:
                if str(problem) not in told:
                    report(problem)
            told = {*map(str, met)}
            stopping.pause(pause_s)


def write_note(text: str) -> None:
    """Write a line to standard error from a signal handler, which may interrupt a `print`."""
    with contextlib.suppress(OSError, ValueError):
        encoding = sys.stderr.encoding or "utf-8"
        os.write(sys.stderr.fileno(), f"{text}\n".encode(encoding, "backslashreplace"))


def _stop(number: int) -> NoReturn:
    raise Stopped(number)


def _leave(number: int) -> NoReturn:
    """End the process in the handler: no other code of the main thread runs any more."""
    undo_unfinished()
    with contextlib.suppress(OSError, ValueError):
        clear = _SHOW_CURSOR if os.isatty(sys.stderr.fileno()) else ""
        write_note(f"{clear}hybridlog: {INTERRUPTED}")
    os._exit(128 + number)
