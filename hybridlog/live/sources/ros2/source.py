"""The ROS 2 source: starts and supervises a child in the ROS environment.

A child that dies is restarted with growing pauses. The outage is reported for each topic.
"""

from __future__ import annotations

import os
import time
from threading import Lock
from typing import TYPE_CHECKING

from hybridlog.live.sources.base import ThreadedSource, one_line
from hybridlog.live.sources.ros2.child.wire import WireError
from hybridlog.live.sources.ros2.overrides import read_overrides
from hybridlog.live.sources.ros2.process import ChildError, Process, launch
from hybridlog.live.sources.ros2.receiver import Receiver, report_outage
from hybridlog_storage.errors import MissingDependencyError, SourceError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.live.sources.base import Sink

MAX_DOMAIN = 232

_PAUSE_S = 0.5
_MAX_PAUSE_S = 30.0
_STABLE_S = 30.0
_HAND_OVER_S = 3.0


class Ros2Source(ThreadedSource):
    """Records the topics of a ROS 2 domain.

    Args:
        python: An interpreter with rclpy. None for the one in the environment variable
            `HYBRIDLOG_ROS2_PYTHON`; else `python3` if a ROS environment is sourced; else
            the current one.
        qos_overrides: YAML file with QoS profiles by topic, in the format of rosbag2.
        domain_id: ROS domain, None for that of the environment.
    """

    kind = "ROS 2"

    def __init__(
        self,
        python: str | None = None,
        qos_overrides: Path | None = None,
        domain_id: int | None = None,
    ) -> None:
        super().__init__()
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        self.address = f"domain {domain if domain_id is None else domain_id}"
        self._python = python
        self._overrides = qos_overrides
        self._domain_id = domain_id
        self._lock = Lock()
        self._child: Process | None = None
        self._settings: dict[str, object] = {}
        self._outages: dict[str, int] = {}

    def check(self) -> None:
        """Start the child; messages are read after `start`."""
        if self._child is None:
            self._child = self._launched()

    def start(self, sink: Sink) -> None:
        """Begin to listen."""
        self.check()
        child = self._child
        self._begin(sink, lambda: self._supervise(child, sink))

    def _launched(self) -> Process:
        """The first child; sets what later ones need."""
        domain = self.address.partition(" ")[2]
        if not (domain.isascii() and domain.isdigit() and int(domain) <= MAX_DOMAIN):
            raise UsageError(f"ROS 2 has domains from 0 to {MAX_DOMAIN}, not {domain[:40]!r}")
        overrides = {} if self._overrides is None else read_overrides(self._overrides)
        settings = self._settings = {"overrides": overrides}
        try:
            child, self._python = launch(self._python, settings, self._domain_id, self._stopping)
        except ChildError as error:
            raise SourceError(
                f"ROS 2 does not start: {one_line(str(error))}; does `ros2 topic list` work?"
            ) from error
        self.address = f"domain {domain}, {one_line(str(child.hello.get('middleware')))}"
        return child

    def stop(self) -> None:
        """Stop listening, after the child has passed on its messages."""
        with self._lock:
            self._stopping.set()
            child, self._child = self._child, None
        if self._thread is None:
            if child is not None:
                child.end()
            return
        if child is not None:
            child.end_input()
            self._join(_HAND_OVER_S)
            if self._thread.is_alive():
                child.kill()
        self._join()

    def _supervise(self, child: Process | None, sink: Sink) -> None:
        """Reads from one child after the other."""
        pause = _PAUSE_S
        while child is not None:
            began = time.monotonic()
            reason = self._listen(child, sink)
            if self._stopping.is_set():
                break
            if time.monotonic() - began > _STABLE_S:
                pause = _PAUSE_S
            sink.say(f"ROS 2: the child ended ({reason}); restarting it")
            child = self._start_again(sink, pause)
            pause = min(2 * pause, _MAX_PAUSE_S)
        for topic, since in self._outages.items():
            report_outage(sink, topic, since)
        self._outages.clear()

    def _listen(self, child: Process, sink: Sink) -> str:
        """Reads from a child until it ends; returns the reason of its end."""
        receiver = Receiver(child.peer, sink, self._outages)
        reason = ""
        exit_report = ""
        try:
            try:
                receiver.run()
            except (WireError, MemoryError) as error:
                reason = str(error) or "not enough memory for a message"
                child.kill()
            except OSError as error:
                reason = error.strerror or str(error)
                exit_report = child.exit_report()
            else:
                exit_report = child.exit_report()
        finally:
            child.end()
        if not (self._stopping.is_set() and receiver.said_bye):
            for topic in receiver.subscribed:
                self._outages.setdefault(topic, receiver.last_received)
        if not self._stopping.is_set():
            for topic in sorted(receiver.present):
                sink.topic_gone(topic)
        return one_line("; ".join(filter(None, (reason, exit_report))))

    def _start_again(self, sink: Sink, pause: float) -> Process | None:
        """A new child after a pause; None if the source is stopped meanwhile."""
        while not self._stopping.wait(pause):
            pause = min(2 * pause, _MAX_PAUSE_S)
            try:
                child, _ = launch(self._python, self._settings, self._domain_id, self._stopping)
            except (ChildError, MissingDependencyError) as error:
                if self._stopping.is_set():
                    break
                sink.say(one_line(f"ROS 2 does not restart, trying again: {error}"))
                continue
            with self._lock:
                if not self._stopping.is_set():
                    self._child = child
                    return child
            child.end()
        return None
