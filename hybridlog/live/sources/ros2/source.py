"""ROS 2 as a live source: a child in the ROS environment, watched over.

A child that dies is started again, with growing pauses; what nobody heard meanwhile is
told topic by topic.
"""

from __future__ import annotations

import os
import time
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING

from hybridlog.live.sources.base import LiveSource
from hybridlog.live.sources.ros2.child.wire import WireError
from hybridlog.live.sources.ros2.overrides import read_overrides
from hybridlog.live.sources.ros2.process import ChildError, Process, launch
from hybridlog.live.sources.ros2.receiver import Receiver, report_outage
from hybridlog.live.sources.text import one_line
from hybridlog_storage.errors import MissingDependencyError, SourceError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.live.sources.base import Sink

MAX_DOMAIN = 232

_PAUSE_S = 0.5
_MAX_PAUSE_S = 30.0
_WELL_S = 30.0
_HAND_OVER_S = 3.0
_TERM_S = 1.0


class Ros2Source(LiveSource):
    """The topics of a ROS 2 domain.

    Args:
        python: The interpreter that has rclpy. None for the one that the environment
            variable `HYBRIDLOG_ROS2_PYTHON` names; else `python3` when a ROS environment
            is sourced; else our own.
        qos_overrides: YAML file with quality of service by topic, as rosbag2 takes it.
        domain_id: ROS domain, None for that of the environment.
    """

    kind = "ROS 2"

    def __init__(
        self,
        python: str | None = None,
        qos_overrides: Path | None = None,
        domain_id: int | None = None,
    ) -> None:
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        self.address = f"domain {domain if domain_id is None else domain_id}"
        self._python = python
        self._overrides = qos_overrides
        self._domain_id = domain_id
        self._stopping = Event()
        self._lock = Lock()
        self._child: Process | None = None
        self._settings: dict[str, object] = {}
        self._thread: Thread | None = None
        self._outages: dict[str, int] = {}

    def check(self) -> None:
        """Start the child, which says nothing of any message before `start`.

        Raises:
            UsageError: A domain that is none, overrides that cannot be read.
            SourceError: ROS that does not come up.
            MissingDependencyError: No Python that has rclpy.
        """
        if self._child is None:
            self._child, self._settings = self._launched()

    def start(self, sink: Sink) -> None:
        """Begin to listen.

        Raises:
            UsageError: As `check`.
            SourceError: As `check`.
            MissingDependencyError: As `check`.
        """
        self.check()
        self._thread = Thread(
            target=self._run, args=(self._child, sink, self._settings), name="ros2", daemon=True
        )
        self._thread.start()

    def _launched(self) -> tuple[Process, dict[str, object]]:
        """A child, and what it was told."""
        domain = self.address.partition(" ")[2]
        if not (domain.isascii() and domain.isdigit() and int(domain) <= MAX_DOMAIN):
            raise UsageError(f"ROS 2 has domains from 0 to {MAX_DOMAIN}, and no {domain[:40]!r}")
        overrides = {} if self._overrides is None else read_overrides(self._overrides)
        settings: dict[str, object] = {"overrides": overrides}
        try:
            child, self._python = launch(self._python, settings, self._domain_id, self._stopping)
        except ChildError as error:
            raise SourceError(
                f"ROS 2 does not come up: {one_line(str(error))}; does `ros2 topic list` work?"
            ) from error
        self.address = f"domain {domain}, {one_line(str(child.hello.get('middleware')))}"
        return child, settings

    def stop(self) -> None:
        """Stop listening; what the child has received is handed over first."""
        with self._lock:
            self._stopping.set()
            child, self._child = self._child, None
        if self._thread is None:
            if child is not None:
                child.end()
            return
        if child is None:
            self._thread.join()
            return
        child.no_more_orders()
        self._thread.join(_HAND_OVER_S)
        if self._thread.is_alive():
            child.terminate()
            self._thread.join(_TERM_S)
        if self._thread.is_alive():
            child.kill()
        self._thread.join()

    def _run(self, child: Process | None, sink: Sink, settings: dict[str, object]) -> None:
        """Listens until the source is stopped."""
        try:
            self._listen_to_all(child, sink, settings)
        except Exception as error:
            # No child can cause it; whoever waits for this source is to know all the same.
            sink.ended(f"ROS 2 cannot be listened to any more: {error!r}")
            raise

    def _listen_to_all(
        self, child: Process | None, sink: Sink, settings: dict[str, object]
    ) -> None:
        """Listens to one child after the other."""
        pause = _PAUSE_S
        while child is not None:
            began = time.monotonic()
            reason = self._listen(child, sink)
            if self._stopping.is_set():
                break
            if time.monotonic() - began > _WELL_S:
                pause = _PAUSE_S
            sink.say(f"ROS 2: the child ended ({reason}); it is started again")
            child = self._start_again(sink, settings, pause)
            pause = min(2 * pause, _MAX_PAUSE_S)
        for topic, since in self._outages.items():
            report_outage(sink, topic, since)
        self._outages.clear()

    def _listen(self, child: Process, sink: Sink) -> str:
        """Listens to a child until it ends; why it did."""
        receiver = Receiver(child.peer, sink, self._outages)
        reason = ""
        last_words = ""
        try:
            try:
                receiver.run()
            except (WireError, MemoryError) as error:
                reason = str(error) or "no memory for a message of the size that it has"
                child.kill()
            except OSError as error:
                reason = error.strerror or str(error)
                last_words = child.last_words()
            else:
                last_words = child.last_words()
        finally:
            child.end()
        if not (self._stopping.is_set() and receiver.said_bye):
            for topic in receiver.heard:
                self._outages.setdefault(topic, receiver.last_heard)
        if not self._stopping.is_set():
            for topic in sorted(receiver.present):
                sink.topic_gone(topic)
        return one_line("; ".join(filter(None, (reason, last_words))))

    def _start_again(self, sink: Sink, settings: dict[str, object], pause: float) -> Process | None:
        """A new child, after a pause; None when the source is stopped meanwhile."""
        while not self._stopping.wait(pause):
            pause = min(2 * pause, _MAX_PAUSE_S)
            try:
                child, _ = launch(self._python, settings, self._domain_id, self._stopping)
            except (ChildError, MissingDependencyError) as error:
                if self._stopping.is_set():
                    break
                sink.say(one_line(f"ROS 2 does not come up again, and is tried again: {error}"))
                continue
            with self._lock:
                if not self._stopping.is_set():
                    self._child = child
                    return child
            child.end()
        return None
