"""The child in the ROS environment: polls the graph, subscribes, passes messages on.

It reports each topic and type with publishers; the recorder decides which to subscribe to.
One thread does everything except reading the recorder's commands.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Any

from hybridlog.live.sources.ros2.child.definitions import Definitions, share_folders
from hybridlog.live.sources.ros2.child.middleware import Middleware
from hybridlog.live.sources.ros2.child.outbox import Outbox
from hybridlog.live.sources.ros2.child.topics import Topics

_LOOK_S = 0.5
_FIRST_LOOKS_S = 0.1
_EAGER_S = 3.0
_IDLE_S = 0.5
_PAUSE_S = 0.001
_SMALL_COUNT = 64
_SMALL_BYTES = 1 << 20
_SHORT_WAIT_S = 0.01
_DRAIN_S = 0.5
_LEAVE_S = 4.0


class Child:
    """Moves messages from ROS into the socket."""

    def __init__(self, middleware: Middleware, topics: Topics, outbox: Outbox) -> None:
        self._middleware = middleware
        self._topics = topics
        self._outbox = outbox
        self._commands: deque[dict[str, Any]] = deque()
        self._is_stopping = False

    # From other threads.

    def command(self, command: dict[str, Any]) -> None:
        """Takes a command of the recorder."""
        self._commands.append(command)
        self._middleware.wake()

    def stop(self) -> None:
        """Ends `run` soon, after it has passed on all received messages."""
        self._is_stopping = True
        self._middleware.wake()

    # The main thread.

    def run(self) -> None:
        """Works until it is stopped; OSError if the recorder has ended."""
        began = next_look = time.monotonic()
        while not self._is_stopping:
            while self._commands:
                command = self._commands.popleft()
                self._topics.subscribe(str(command.get("subscribe")), str(command.get("type")))
            now = time.monotonic()
            if now >= next_look:
                self._topics.look()
                # A new recorder needs the existing topics at once.
                next_look = now + (_FIRST_LOOKS_S if now - began < _EAGER_S else _LOOK_S)
            count, size = self._take(max(0.0, min(_IDLE_S, next_look - time.monotonic())))
            if count < _SMALL_COUNT and size < _SMALL_BYTES:
                # A short pause, so that messages come in batches and not one per wake-up.
                time.sleep(_PAUSE_S)
        deadline = time.monotonic() + _DRAIN_S
        while self._take(_SHORT_WAIT_S)[0] >= _SMALL_COUNT and time.monotonic() < deadline:
            pass
        self._topics.account(final=True)
        self._outbox.event("bye")

    def _take(self, wait: float) -> tuple[int, int]:
        """Takes messages, and waits `wait` seconds at most; returns their number and bytes."""
        ready = self._middleware.wait(wait)
        owners = self._topics.owners
        count = size = 0
        for topic in [owners[found] for found in ready]:
            assert topic.stream is not None
            try:
                taken, taken_size = topic.stream.take(self._outbox)
            except Exception as error:
                # rclpy raises errors of many kinds; each costs one message.
                self._outbox.lost(topic.name, "unreadable", 1, detail=str(error))
                self._outbox.say(f"{topic.name}: a message cannot be taken from ROS: {error}")
                continue
            count += taken
            size += taken_size
        self._outbox.flush()
        return count, size


def run(number: int) -> int:
    """The program, with the file descriptor of its socket; returns the exit code."""
    peer = socket.socket(fileno=number)
    peer.set_inheritable(False)
    outbox = Outbox(peer)
    try:
        middleware = Middleware()
    except Exception as error:
        # The recorder reports any error of ROS.
        why = f"{type(error).__name__}: {error}"
        outbox.event("failed", missing=isinstance(error, ImportError), why=why)
        return 1
    topics = Topics(middleware, outbox, Definitions(share_folders()))
    child = Child(middleware, topics, outbox)
    outbox.event("hello", middleware=middleware.implementation)
    signal.signal(signal.SIGTERM, lambda _number, _frame: child.stop())
    threading.Thread(target=_listen, args=(peer, child), daemon=True).start()
    try:
        child.run()
    except (BrokenPipeError, ConnectionResetError):
        # The recorder has died.
        return 1
    finally:
        middleware.close()
    return 0


def _listen(peer: socket.socket, child: Child) -> None:
    """Reads the recorder's commands until the end of input."""
    with suppress(OSError), peer.makefile("rb") as lines:
        for line in lines:
            child.command(json.loads(line))
    child.stop()
    # Even if the middleware hangs, the child must not outlive the recorder.
    time.sleep(_LEAVE_S)
    os._exit(1)
