"""Starts, hears and ends the process beside a live recorder that makes all that is derived."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from msgspec import Struct

from hybridlog.entries import put_entry
from hybridlog.maintenance.report import Followed
from hybridlog.query.predicate.parser import parse
from hybridlog.query.topics import TopicMatcher, matcher, split_topic
from hybridlog_storage.errors import (
    DiskFullError,
    HybridlogError,
    StoreError,
    UsageError,
    WhereError,
)

if TYPE_CHECKING:
    from hybridlog.query.predicate.tree import Predicate
    from hybridlog.shared import Shared
    from hybridlog_storage.catalog import RecordingEntry

_START: Final = (
    "import sys; sys.path[:] = {!r}; from hybridlog.follow.beside import serve; serve({})"
)
_POLL_S: Final = 0.1
_TRIES: Final = 5
"""So often in a row it may end without being farther."""
_PAUSE_S: Final = 1.0
LOOK_S: Final = 0.5  # between two looks at the recording of a log
SHORT_S: Final = 2.0
"""Seconds; a shorter recording gets no process of its own, which takes half a second to start."""
_OF_SERVICE: Final = {"NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC"}


class Task(NamedTuple):
    """What the process is to do.

    `interval_s` lies between two looks of the follower; with None it does everything at the end.
    With `had_mongo` the recorder reached MongoDB: if the process does not, that is a failure.
    After an earlier process has died (`is_again`), `seen` tells what the triggers have seen.
    """

    store: str
    mongo: str | None
    recording: str
    triggers: Sequence[str]
    interval_s: float | None
    had_mongo: bool = False
    is_again: bool = False
    seen: Any = None


class FollowerProcess:
    """Evaluates triggers, then makes rows, tables and documents, by a process that ends with this.

    When it ends before the recording, as for want of memory, it is started again, and goes on
    where it was. With a `purpose`, which errors of the index name, a recording that has ended
    before `SHORT_S` is followed in this process, at its end.
    `judged` has the numbers of the sealed files that triggers have read; it is None without
    triggers, or when the process is given up. At the end it is waited for `wait_s`.
    """

    def __init__(
        self,
        shared: Shared,
        task: Task,
        state: Followed,
        *,
        purpose: str = "",
        triggers: Sequence[Trigger] = (),
        hit: Callable[[str, int], object] = lambda *_: None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.state = state
        self.said: list[str] = []
        self.judged: Collection[int] | None = () if triggers else None
        self.wait_s = math.inf
        self._shared = shared
        self._triggers = triggers
        self._task = task
        self._why = "their process ends again and again"
        self._purpose = purpose
        self._hit = hit
        self._say = say or self.said.append
        self._is_ended = False  # and sealed: the process is to end
        self._process: subprocess.Popen[bytes] | None = None
        self._begun = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hybridlog-follow", daemon=True)

    @classmethod
    def of_short(
        cls, shared: Shared, purpose: str, interval_s: float | None
    ) -> Callable[[RecordingEntry], FollowerProcess]:
        """A function that starts the follower of a recording, which may be a short one.

        Errors of the index name the `purpose`.
        """
        target = shared.index.index_to_record(purpose)
        state = Followed(target.is_wanted, failure=target.failure)

        def start(entry: RecordingEntry) -> FollowerProcess:
            place, wanted = shared.directory.address, shared.index.wanted
            task = Task(place, wanted, entry.id, (), interval_s, target.is_wanted)
            followed = cls(shared, task, state, purpose=purpose)
            followed.start()
            return followed

        return start

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def finish(self, entry: RecordingEntry) -> RecordingEntry:
        """Wait until it has done everything, but no longer than wanted."""
        if self._purpose and time.monotonic() - self._begun < SHORT_S:
            return self._finish_here(entry)
        self._is_ended = True
        begun = time.monotonic()
        while self._thread.is_alive() and time.monotonic() - begun < self.wait_s:
            self._thread.join(_POLL_S)
        if self._thread.is_alive():
            what = "triggers may not have seen the last messages; " if self._triggers else ""
            self._say(f"{what}tables and index are not complete: the next command makes the rest")
        self.abandon()
        return put_entry(self._shared.directory, self._shared.catalog, entry.id)

    def _finish_here(self, entry: RecordingEntry) -> RecordingEntry:
        from hybridlog.follow.follower import Follower, make_rows_ahead

        self.abandon()
        directory, index = self._shared.directory, self._shared.index
        with suppress(StoreError, DiskFullError):  # or else they are written when logs go
            make_rows_ahead(directory, entry.id, lambda: True)
        if self.state.is_wanted:
            with suppress(HybridlogError):  # the server may have come, or may have gone
                index.connect(brings=False)
        target = index.index_to_record(self._purpose, brings=False)
        follower = Follower(directory, self._shared.catalog, entry, target)
        entry = follower.finish(entry)
        self.state = follower.state
        return entry

    def leave(self) -> bool:
        """Let `finish` wait no longer; False if it does not wait."""
        was_waiting = self._is_ended and self.wait_s > 0
        self.wait_s = 0.0 if self._is_ended else self.wait_s
        return was_waiting

    def abandon(self) -> None:
        """End it at once."""
        self._over.set()
        if self._process is not None:
            self._process.kill()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        if self._purpose and self._over.wait(SHORT_S):
            return
        failed = 0
        while failed < _TRIES and not self._over.is_set():
            before = self._task.seen, self.state
            with suppress(EOFError, OSError):
                if self._follow():
                    return
            failed = 0 if (self._task.seen, self.state) != before else failed + 1
            self._task = self._task._replace(is_again=True)
            self._over.wait(_PAUSE_S * 2**failed)
        self.judged = None
        if not self._over.is_set():
            what = "triggers are evaluated no more" if self._triggers else "tables are made later"
            self._say(f"{what}: {self._why}")

    def _follow(self) -> bool:
        """Start it, and hear it to its end; True if it has done everything."""
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
        control.send(self._task)
        is_told = False
        while not self._over.is_set():
            if self._is_ended and not is_told:
                control.send("sealed")
                is_told = True
            if not control.poll(_POLL_S):
                continue
            match control.recv():
                case ("hit", text, times):
                    for at in times:
                        self._hit(text, at)
                case ("read", seen):
                    self.judged = seen[1]
                    self._task = self._task._replace(seen=seen)
                case ("state", state):
                    self.state = state
                case ("say", text):
                    self._say(text)
                case ("failed", why):
                    self._why = why
                    return False
                case _:
                    return True
        return False


def _started(control: Connection[Any, Any]) -> subprocess.Popen[bytes]:
    places = [str(Path(place).absolute()) for place in sys.path]
    return subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-c", _START.format(places, control.fileno())],
        cwd="/",
        env={key: value for key, value in os.environ.items() if key not in _OF_SERVICE},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=[control.fileno()],
        start_new_session=True,  # Ctrl-C is for the recorder
    )


class Trigger(Struct, frozen=True):
    """A condition on messages of topics; without a predicate any of them fires it."""

    text: str
    fits: TopicMatcher
    predicate: Predicate | None

    @classmethod
    def of(cls, text: str) -> Trigger:
        """Parse `/diagnostics: status[*].level >= 2`, or a topic alone.

        Raises:
            UsageError: The topic is missing.
            TopicError: The pattern is malformed.
            WhereError: The predicate is malformed, or is not about the fields of one message.
        """
        topic, condition = split_topic(text)
        if not topic or (not condition and " " in topic):
            raise UsageError(f"--trigger wants TOPIC, or TOPIC: PREDICATE, not {text!r}.")
        fits, predicate = matcher([topic]), parse(condition) if condition else None
        if predicate is not None:
            names = {path.split(".", 1)[0] for path in predicate.fields()}
            if names & {"_id", "_meta"} or predicate.is_across:
                raise WhereError(
                    f"A trigger asks for fields of the message alone, not for {condition}."
                )
        return cls(text, fits, predicate)
