"""The process beside a recorder that evaluates its triggers, as the recorder sees it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from hybridlog.follow.triggers import Trigger
    from hybridlog_storage.messages import Channel

_START: Final = (
    "import sys; sys.path[:] = {!r}; from hybridlog.follow.evaluation import serve; serve({})"
)
_POLL_S: Final = 0.1
_TRIES: Final = 5
"""So often in a row it may end before it has read anything."""
_PAUSE_S: Final = 1.0
_TOLD_TO_MANAGERS: Final = {"NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC"}


class TriggerProcess:
    """Evaluates triggers on what a recording has flushed, by a process that ends with this one.

    Without triggers there is no process. `judged` has the numbers of the sealed files that were
    read; it is None without triggers, or when the process is given up.

    When it ends before the recording, as for want of memory, it is started again, and goes on
    where it was.
    """

    def __init__(
        self,
        store: str,
        recording: str,
        triggers: Sequence[Trigger],
        *,
        hit: Callable[[str, int], object],
        say: Callable[[str], None],
    ) -> None:
        self.judged: Collection[int] | None = () if triggers else None
        self._triggers = triggers
        self._task = store, recording, [one.text for one in triggers]
        self._read: object = None
        self._why = "their process ends again and again"
        self._hit = hit
        self._say = say
        self._channels: list[Channel] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hybridlog-follow", daemon=True)

    def start(self) -> None:
        """Begin."""
        if self._triggers:
            self._thread.start()

    def expect(self, channel: Channel) -> None:
        """Tell the triggers that can never fire on a channel, before its first message."""
        if any(one.fits(channel.topic) for one in self._triggers):
            self._channels.append(channel)

    def finish(self, wait_s: float | None) -> bool:
        """Wait until what the ended recording has is read; False if that takes longer."""
        if self._triggers:
            self._thread.join(wait_s)
        is_late = self._thread.is_alive()
        self.stop()
        return not is_late

    def stop(self) -> None:
        """End it at once."""
        self._over.set()
        if self._process is not None:
            self._process.kill()

    def _run(self) -> None:
        tries = _TRIES
        while tries and not self._over.is_set():
            read, is_done = self._read, False
            with suppress(EOFError, OSError):
                is_done = self._follow()
            if is_done:
                break
            tries = _TRIES if self._read != read else tries - 1
            self._over.wait(_PAUSE_S)
        else:
            self.judged = None
            if not self._over.is_set():
                self._say(f"triggers are evaluated no more: {self._why}")

    def _follow(self) -> bool:
        """Start it, and hear it to its end; True if it has read everything."""
        ours, theirs = Pipe()
        with ours:
            with theirs:
                self._process = _started(theirs)
            try:
                return self._hear(ours)
            finally:
                self._process.kill()
                self._process.wait()

    def _hear(self, control: Connection[Any, Any]) -> bool:
        control.send((*self._task, self._read))
        told = 0
        while True:
            for channel in self._channels[told:]:
                control.send(channel)
                told += 1
            if not control.poll(_POLL_S):
                continue
            kind, *values = control.recv()
            if kind == "hit":
                text, times = values
                for time in times:
                    self._hit(text, time)
            elif kind == "read":
                (self._read,) = values
                self.judged = values[0][1]
            elif kind == "say":
                self._say(*values)
            elif kind == "failed":
                (self._why,) = values
                return False
            else:
                return True


def _started(control: Connection[Any, Any]) -> subprocess.Popen[bytes]:
    places = [str(Path(place).absolute()) for place in sys.path]
    return subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-c", _START.format(places, control.fileno())],
        cwd="/",
        env={key: value for key, value in os.environ.items() if key not in _TOLD_TO_MANAGERS},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=[control.fileno()],
        start_new_session=True,  # Ctrl-C is for the recorder
    )
