"""Ctrl-C, `kill` and a closed terminal stop a command.

A command that only reads, or whose work the next change of the store completes or takes back,
ends at once, without unwinding: unfinished output files are removed, and the process leaves.
Work in `stopping.at_safe_points` takes itself back: there `Stopped` is raised, at a safe
point. It is no `KeyboardInterrupt`, because libraries catch that.
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

_SHOW_CURSOR: Final = "\r\x1b[K\x1b[?25h"
"""Clears the line of a progress bar."""

_AWAY: Final = (BucketError, DatabaseError, ResourceError, StoreError)
"""Errors that may have gone at a later look."""
_LONGER: Final = 5
"""Pause after such an error, as a multiple of the usual one."""

_consequences: list[str | Callable[[], str]] = []


class Stopped(BaseException):
    """A signal stopped the command."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
        self.consequence = _consequence()

    @property
    def exit_code(self) -> int:
        """128 plus the signal, as in shells."""
        return 128 + self.number


@contextlib.contextmanager
def if_stopped(consequence: str | Callable[[], str]) -> Iterator[None]:
    """Say what it means when the block is stopped."""
    _consequences.append(consequence)
    try:
        yield
    finally:
        _consequences.pop()


def install() -> None:
    """Let the signals stop the command. Call it in the main thread of the command's process.

    Where work takes itself back, the second signal is answered with a note; the third ends the
    process at once. SIGINT counts even if it was ignored, which shells without job control do
    to background jobs; an ignored SIGHUP (`nohup`) or SIGTERM stays ignored.
    """
    received = 0

    def stop(number: int, _frame: FrameType | None) -> None:
        nonlocal received
        received += 1
        if received == 1:
            if not stopping.postpone(partial(_stop, number)):
                _leave(number, _consequence())
        elif received == 2 and stopping.is_delayed():
            write_note("\nhybridlog: cleaning up; press again to leave at once")
        else:
            _leave(number, "The next command that opens the store cleans up.")

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

    A problem is reported once, as long as it lasts. While a place or a database is away, the pause
    is longer.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # a file and a pipe show each line at once
        sys.stdout.reconfigure(line_buffering=True)
    told: set[str] = set()  # problems that last
    try:
        with stopping.at_safe_points():
            output.remarks([f"Watching {place}. Ctrl-C ends it."])
            while True:
                met, wait_s = set[str](), pause_s
                try:
                    for problem in look():
                        met.add(str(problem))
                        if str(problem) not in told:
                            report(problem)
                except _AWAY as error:
                    # Ctrl-C may have ended a program that the other side needs.
                    stopping.safe_point()
                    wait_s = _LONGER * pause_s
                    if str(error) not in told:
                        report(error)
                        output.note(f"The next try is in {wait_s:g} s.")
                    met |= {*told, str(error)}
                told = met
                stopping.pause(wait_s)
    except Stopped as stopped:
        output.notes(filter(None, [stopped.consequence]))


def undo_unfinished() -> None:
    """Take back what a command has not completed when it is stopped, such as files."""
    unfinished = sys.modules.get("hybridlog_storage.disk.unfinished")
    if unfinished is not None:
        unfinished.undo_unfinished()


def write_note(text: str) -> None:
    """Write a line to standard error from a signal handler, which may interrupt a `print`."""
    with contextlib.suppress(OSError, ValueError):
        encoding = sys.stderr.encoding or "utf-8"
        os.write(sys.stderr.fileno(), f"{text}\n".encode(encoding, "backslashreplace"))


def _stop(number: int) -> NoReturn:
    raise Stopped(number)


def _consequence() -> str:
    if not _consequences:
        return ""
    last = _consequences[-1]
    return last if isinstance(last, str) else last()


def _leave(number: int, consequence: str) -> NoReturn:
    """End the process in the handler: no other code of the main thread runs any more."""
    undo_unfinished()
    with contextlib.suppress(OSError, ValueError):
        clear = _SHOW_CURSOR if os.isatty(sys.stderr.fileno()) else ""
        write_note(clear + output.printable(f"hybridlog: interrupted. {consequence}".rstrip()))
    os._exit(128 + number)
