"""The ROS 2 source: starts and supervises a child in the ROS environment.

A child that dies is restarted with growing pauses. The outage is reported for each topic. Frames of
the child become calls of the sink.
"""

from __future__ import annotations

import io
import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import suppress
from json import dumps, loads
from pathlib import Path
from threading import Thread
from typing import IO, TYPE_CHECKING, Any

from hybridlog.live.sources.base import Cause, Sink, ThreadedSource, one_line
from hybridlog.live.sources.ros2.child.child import ENTRY, EVENT, HEADER
from hybridlog_storage.errors import MissingDependencyError, SourceError, UsageError
from hybridlog_storage.manifest import Loss
from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


MAX_DOMAIN = 232

_PAUSE_S = 1.0
_HAND_OVER_S = 3.0


class Ros2Source(ThreadedSource):
    """Records the topics of a ROS 2 domain.

    Args:
        python: An interpreter with rclpy. None for the one in the environment variable
            `HYBRIDLOG_ROS2_PYTHON`; else `python3` if a ROS environment is sourced; else
            the current one.
    """

    kind = "ROS 2"

    def __init__(self, python: str | None = None) -> None:
        super().__init__()
        self.address = f"domain {os.environ.get('ROS_DOMAIN_ID') or '0'}"
        self._python = python
        self._child: Process | None = None
        self._outages: dict[str, int] = {}

    def check(self) -> None:
        """Start the child; messages are read after `start`."""
        if self._child is not None:
            return
        domain = self.address.partition(" ")[2]
        if not (domain.isascii() and domain.isdigit() and int(domain) <= MAX_DOMAIN):
            raise UsageError(f"ROS 2 has domains from 0 to {MAX_DOMAIN}, not {domain[:40]!r}")
        try:
            child = self._launch()
        except ChildError as error:
            raise SourceError(
                f"ROS 2 does not start: {one_line(str(error))}; does `ros2 topic list` work?"
            ) from error
        self.address = f"domain {domain}, {one_line(str(child.hello.get('middleware')))}"

    def start(self, sink: Sink) -> None:
        """Begin to listen."""
        self.check()
        child = self._child
        self._begin(sink, lambda: self._supervise(child, sink))

    def _launch(self) -> Process:
        """A child under the first Python that has rclpy."""
        tried = []
        for name in [self._python] if self._python else candidates(os.environ):
            try:
                child = Process(name)
                with self._lock:
                    self._child = child
                    if self._stopping.is_set():
                        child.kill()
                try:
                    child.greet()
                except BaseException:
                    child.end()
                    raise
            except ChildMissingError as error:
                tried.append(str(error))
            else:
                self._python = name
                return child
        raise MissingDependencyError(
            f"recording ROS 2 needs a Python that has rclpy ({'; '.join(tried)}): {_REMEDY}"
        )

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
        while child is not None:
            reason = self._listen(child, sink)
            if self._stopping.is_set():
                break
            sink.say(f"ROS 2: the child ended ({reason}); restarting it")
            child = self._start_again(sink)
        for topic, since in self._outages.items():
            report_outage(sink, topic, since)
        self._outages.clear()

    def _listen(self, child: Process, sink: Sink) -> str:
        """Reads from a child until it ends; returns the reason of its end."""
        reasons = []
        try:
            child.listen(sink, self._outages)
        except (EOFError, OSError) as error:
            reasons.append(str(error))
        except MemoryError:
            reasons.append("not enough memory for a message")
            child.kill()
        finally:
            reasons.append(child.exit_report())
            child.end()
        if not (self._stopping.is_set() and child.said_bye):
            for topic in child.subscribed:
                self._outages.setdefault(topic, child.last_received)
        if not self._stopping.is_set():
            for topic in sorted(child.present):
                sink.topic_gone(topic)
        return one_line("; ".join(reasons))

    def _start_again(self, sink: Sink) -> Process | None:
        """A new child after a pause; None if the source is stopped meanwhile."""
        while not self._stopping.wait(_PAUSE_S):
            try:
                return self._launch()
            except (ChildError, MissingDependencyError) as error:
                if not self._stopping.is_set():
                    sink.say(one_line(f"ROS 2 does not restart, trying again: {error}"))
        return None


# Reads of whole multiples of this size bypass the buffer.
_BUFFER = 32 << 10


def report_outage(sink: Sink, topic: str, since: int) -> None:
    """Reports that a topic was not recorded from some time, ns since the epoch, until now."""
    detail = "the ROS 2 child had ended"
    sink.lost(Loss(Cause.CONNECTION, topic, None, since, max(since, time.time_ns()), detail))


def _read(file: io.BufferedIOBase, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError("it ended in the middle of a frame")
    return data


PYTHON_VARIABLE = "HYBRIDLOG_ROS2_PYTHON"

START = Path(__file__).with_name("child") / "__main__.py"

HELLO_S = 30.0
"""Time limit for a child to load rclpy and send its greeting."""

SOCKET_BYTES = 4 << 20
"""Requested size of the socket buffer; the kernel may give less."""

_MAX_LINE = 300

_REMEDY = (
    "on a robot, source the set-up file of ROS first (source /opt/ros/DISTRO/setup.bash); "
    "elsewhere install the wheels into a virtual environment of their own (python3 -m venv ros2; "
    "ros2/bin/pip install ros-rclpy ros-rmw-fastrtps-cpp ros-std-msgs ros-sensor-msgs "
    f"ros-geometry-msgs) and name its Python: {PYTHON_VARIABLE}=ros2/bin/python"
)


class ChildError(Exception):
    """The child did not start; the message is one line with the reason."""


class ChildMissingError(ChildError):
    """The Python does not exist, or has no rclpy."""


class Process:
    """A running child; a Python that does not exist raises ChildMissingError.

    Attributes:
        subscribed: Topics that it has subscribed to.
        present: Topics with publishers, as reported to the sink.
        last_received: Time of the last frame, ns since the epoch.
        said_bye: It has ended regularly.
    """

    def __init__(self, python: str) -> None:
        self.hello: dict[str, Any] = {}
        self.subscribed: set[str] = set()
        self.present: set[str] = set()
        self.last_received = time.time_ns()
        self.said_bye = False
        self._channels: dict[int, Channel] = {}
        self._sink: Sink
        self._outages: dict[str, int]
        self.peer, theirs = socket.socketpair()
        self._python = python
        self._last_line = ""
        for end, option in ((self.peer, socket.SO_RCVBUF), (theirs, socket.SO_SNDBUF)):
            end.setsockopt(socket.SOL_SOCKET, option, SOCKET_BYTES)
        environment = dict(os.environ)
        if python != sys.executable:
            # The wheels set this once they have found their libraries, and the child has others.
            environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
        try:
            with theirs:
                self._process = subprocess.Popen(  # noqa: S603
                    [python, "-u", str(START), str(theirs.fileno())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    pass_fds=[theirs.fileno()],
                    env=environment,
                    # Ctrl-C must only reach the recorder, which ends its child.
                    start_new_session=True,
                )
        except OSError as error:
            self.peer.close()
            raise ChildMissingError(f"{python} cannot be started: {error.strerror}") from error
        assert self._process.stdout is not None
        self._listener = Thread(target=self._listen, args=(self._process.stdout,), daemon=True)
        self._listener.start()
        self.pid = self._process.pid

    def _listen(self, output: IO[bytes]) -> None:
        """Keeps the last line of output, which may explain a failure."""
        with output:
            while line := output.readline(1 << 12):
                self._last_line = one_line(line, _MAX_LINE) or self._last_line

    def greet(self) -> None:
        """Wait for its greeting, `hello`; ChildMissingError if it has no rclpy."""
        self.peer.settimeout(HELLO_S)
        try:
            _, length = HEADER.unpack(self._receive(HEADER.size))
            self.hello = loads(self._receive(length))
        except TimeoutError as error:
            raise ChildError(f"{self._python} did not load rclpy within {HELLO_S:.0f} s") from error
        except OSError as error:
            raise ChildMissingError(f"{self._python} ended: {self.exit_report()}") from error
        self.peer.settimeout(None)
        if self.hello["event"] != "hello":
            why = f"{self._python}: {one_line(self.hello['why'])}"
            raise ChildMissingError(why) if self.hello["missing"] else ChildError(why)

    def _receive(self, size: int) -> bytes:
        parts = b""
        while len(parts) < size:
            part = self.peer.recv(size - len(parts))
            if not part:
                raise ConnectionResetError
            parts += part
        return parts

    def listen(self, sink: Sink, outages: dict[str, int]) -> None:
        """Reads to the end; EOFError if that is within a frame, OSError of the socket.

        `outages` are topics that an earlier child recorded, with the time of its end, ns since the
        epoch. Topics that are recorded again are removed.
        """
        self._sink, self._outages = sink, outages
        # A large payload is read directly into the bytes object for the sink, without a
        # copy.
        raw = io.FileIO(self.peer.fileno(), closefd=False)
        with io.BufferedReader(raw, _BUFFER) as file:
            while file.peek(1):
                kind, length = HEADER.unpack(_read(file, HEADER.size))
                if kind == EVENT:
                    self._event(loads(_read(file, length)))
                else:
                    number, received, sent, sequence = ENTRY.unpack(_read(file, ENTRY.size))
                    self._sink.take(
                        self._channels[number],
                        _read(file, length - ENTRY.size),
                        received=received,
                        sent=sent or None,
                        sequence=sequence if sequence >= 0 else None,
                    )
                self.last_received = time.time_ns()

    def _event(self, event: dict[str, Any]) -> None:
        match event:
            case {"event": "candidate", "topic": str(topic), "type": str(kind)}:
                if self._sink.wants(topic, kind):
                    command = dumps({"subscribe": topic, "type": kind})
                    self.peer.sendall(command.encode("ascii") + b"\n")
            case {"event": "channel"}:
                self._channel(event)
            case {"event": "topic", "topic": str(topic), "type": str(kind)}:
                self.present.add(topic)
                self._sink.topic_came(topic, kind)
            case {"event": "gone", "topic": str(topic)}:
                self.present.discard(topic)
                self._sink.topic_gone(topic)
            case {"event": "lost", "topic": topic, "cause": cause, "count": count, **rest}:
                detail = one_line(rest["detail"])
                loss = Loss(Cause(cause), topic, count, rest["first"], rest["last"], detail)
                self._sink.lost(loss)
            case {"event": "say", "text": str(text)}:
                self._sink.say(one_line(f"ROS 2: {text}"))
            case {"event": "bye"}:
                self.said_bye = True

    def _channel(self, event: dict[str, Any]) -> None:
        topic = event["topic"]
        definition = event["definition"].encode("utf-8", "surrogateescape")
        metadata = {"offered_qos_profiles": event["offered"]}
        if event["hash"]:
            metadata["topic_type_hash"] = event["hash"]
        self._channels[event["number"]] = Channel(
            topic=topic,
            message_encoding="cdr",
            schema=Schema(event["type"], event["encoding"], definition),
            metadata=metadata,
            has_publish_time=True,
        )
        self.subscribed.add(topic)
        since = self._outages.pop(topic, None)
        if since is not None:
            report_outage(self._sink, topic, since)

    def exit_report(self) -> str:
        """Exit code of the child, negative after a signal, and its last line of output."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        self._listener.join(1.0)
        code = self._process.returncode
        how = "it still runs" if code is None else f"exit code {code}"
        return f"{how}: {self._last_line}" if self._last_line else how

    def end_input(self) -> None:
        """Asks the child to pass on its messages and end."""
        with suppress(OSError):
            self.peer.shutdown(socket.SHUT_WR)

    def kill(self) -> None:
        """Kills the child, and ends reads from it."""
        self._process.kill()
        with suppress(OSError):
            self.peer.shutdown(socket.SHUT_RDWR)

    def end(self) -> None:
        """Ends the child within a second."""
        self.end_input()
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._listener.join(1.0)
        self.peer.close()


def candidates(environment: Mapping[str, str]) -> Sequence[str]:
    """Interpreters that may have rclpy, at least one, the most likely first."""
    named = environment.get(PYTHON_VARIABLE)
    if named:
        return [named]
    found = []
    if environment.get("ROS_DISTRO") or environment.get("AMENT_PREFIX_PATH"):
        # The first on the PATH may be our own; ROS is built for the system's Python.
        on_path = shutil.which("python3", path=environment.get("PATH"))
        found = [path for path in (on_path, "/usr/bin/python3") if path and Path(path).exists()]
    return list(dict.fromkeys([*found, sys.executable]))
