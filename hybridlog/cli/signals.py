"""Ctrl-C, `kill` and a closed terminal stop a command with an exception.

The exception is raised in the main thread, and unfinished files are removed on its way out.
It is no `KeyboardInterrupt`, because libraries catch that.
"""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final

SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that stop a command, as far as this system has them."""


class Stopped(BaseException):
    """A signal stopped the command.

    Attributes:
        number: The signal.
        consequence: What became of the unfinished work, for people.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
        self.consequence = ""

    @property
    def exit_code(self) -> int:
        """128 plus the signal, as in shells."""
        return 128 + self.number


@contextlib.contextmanager
def if_stopped(consequence: str | Callable[[], str]) -> Iterator[None]:
    """Say what it means when the block is stopped.

    Args:
        consequence: What becomes of the unfinished work, or a function that says so then.
    """
    try:
        yield
    except Stopped as stopped:
        stopped.consequence = consequence if isinstance(consequence, str) else consequence()
        raise


def install() -> None:
    """Turn the signals into `Stopped`. Call it in the main thread of the command's process.

    The second signal is answered with a note that cleaning up is under way; the third stops
    that as well. An ignored signal stays ignored (`nohup`, background jobs of simple shells).
    """
    received = 0

    def stop(number: int, _frame: FrameType | None) -> None:
        nonlocal received
        received += 1
        if received == 2:
            with contextlib.suppress(OSError, RuntimeError):
                print("\nhybridlog: cleaning up; press again to stop that, too", file=sys.stderr)  # noqa: T201
            return
        raise Stopped(number)

    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)
