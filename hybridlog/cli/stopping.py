"""Being told to stop: Ctrl-C, `kill`, a terminal that closes.

All three take the same way out, an exception in the main thread, so that whatever is
half-made is removed. It is no `KeyboardInterrupt`, which libraries catch.
"""

from __future__ import annotations

import contextlib
import signal
import sys
from types import FrameType
from typing import Final

SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""What tells a command to stop, as far as this system has it."""


class Stopped(BaseException):
    """The command was told to stop.

    Attributes:
        number: The signal.
        consequence: What that means for what was being done, for people.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
        self.consequence = ""

    @property
    def exit_code(self) -> int:
        """128 and the signal, as shells have it."""
        return 128 + self.number


def install() -> None:
    """Turn the signals into `Stopped`. For the main thread of a process of our own.

    The second one says that tidying up is under way; the third interrupts that, too. A
    signal that is ignored stays so (`nohup`, background jobs of simple shells).
    """
    received = 0

    def stop(number: int, _frame: FrameType | None) -> None:
        nonlocal received
        received += 1
        if received == 2:
            with contextlib.suppress(OSError, RuntimeError):
                print("\nhybridlog: tidying up; once more to leave it", file=sys.stderr)  # noqa: T201
            return
        raise Stopped(number)

    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)
