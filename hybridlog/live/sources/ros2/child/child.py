"""The child in the ROS environment: looks at the graph, subscribes, hands messages over.

It decides nothing. It tells of each topic and type that has publishers; the recorder says
which of them to subscribe to. One thread does all but listening to the recorder.

Runs under Python 3.10 as well, with nothing but the standard library and rclpy.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import threading
import time
from collections import deque
from typing import Any

from hybridlog.live.sources.ros2.child.definitions import Definitions, share_folders
from hybridlog.live.sources.ros2.child.event_sender import EventSender
from hybridlog.live.sources.ros2.child.middleware import Middleware
from hybridlog.live.sources.ros2.child.outbox import Outbox
from hybridlog.live.sources.ros2.child.topics import Topics
from hybridlog.live.sources.ros2.child.wire import MAX_BATCH, WireError, parse_object

_LOOK_S = 0.5
_FIRST_LOOKS_S = 0.1
_EAGER_S = 3.0
_IDLE_S = 0.5
_BREATH_S = 0.001
_FEW = 64
_FEW_BYTES = 1 << 20
_MUCH_BYTES = 1 << 20
_GLANCE_S = 0.01
_CATCH_UP_S = 0.5
_LAST_WORDS_S = 2.0


class Child:
    """Moves messages from ROS into the outbox, and the outbox into the socket.

    Args:
        middleware: ROS.
        topics: What we listen to.
        outbox: Where messages and events go.
        events: Who puts events there.
    """

    def __init__(
        self, middleware: Middleware, topics: Topics, outbox: Outbox, events: EventSender
    ) -> None:
        self._middleware = middleware
        self._topics = topics
        self._outbox = outbox
        self._events = events
        self._orders: deque[dict[str, Any]] = deque()
        self._is_stopping = False

    # From other threads.

    def order(self, order: dict[str, Any]) -> None:
        """Takes an order of the recorder's."""
        self._orders.append(order)
        self._middleware.wake()

    def stop(self) -> None:
        """Ends `run` soon, with all that has been received handed over."""
        self._is_stopping = True
        self._middleware.wake()

    # The one thread.

    def run(self, peer: socket.socket) -> None:
        """Works until it is told to stop.

        Args:
            peer: The socket that the outbox writes to.

        Raises:
            OSError: The recorder is gone.
        """
        writable = select.poll()
        writable.register(peer, select.POLLOUT)
        began = next_look = time.monotonic()
        while not self._is_stopping:
            while self._orders:
                order = self._orders.popleft()
                self._topics.subscribe(str(order.get("subscribe")), str(order.get("type")))
            now = time.monotonic()
            if now >= next_look:
                self._topics.look()
                # Whoever starts a recorder wants the topics that there are at once.
                next_look = now + (_FIRST_LOOKS_S if now - began < _EAGER_S else _LOOK_S)
            wait = 0.0
            if self._outbox.send() and not self._topics.doubled:
                wait = max(0.0, min(_IDLE_S, next_look - time.monotonic()))
            count, size = self._take(wait)
            if not self._outbox.send():
                writable.poll(2)
            elif count < _FEW and size < _FEW_BYTES:
                # A breath, so that messages come by the dozen and not one a wake-up.
                time.sleep(_BREATH_S)
        self._finish(writable)

    def _take(self, wait: float) -> tuple[int, int]:
        """Takes what the subscriptions have; messages and bytes.

        Args:
            wait: Seconds to wait at most while there is nothing.
        """
        ready = self._middleware.wait(wait)
        owners = self._topics.owners
        count = size = 0
        # What has two subscriptions goes on even when nothing comes, to close one in time.
        for topic in dict.fromkeys([*(owners[found] for found in ready), *self._topics.doubled]):
            assert topic.stream is not None
            try:
                taken, taken_size = topic.stream.take(self._outbox)
            except Exception as error:
                # rclpy has errors of many kinds; each of them costs a message.
                self._events.lost(topic.name, "unreadable", 1, detail=str(error))
                self._events.say(f"{topic.name}: a message cannot be taken from ROS: {error}")
                continue
            count += taken
            size += taken_size
            if taken_size >= _MUCH_BYTES:
                # The recorder goes on meanwhile, and the next topic finds room.
                self._outbox.send()
        self._outbox.close_batch()
        return count, size

    def _finish(self, writable: select.poll) -> None:
        """Hands over what has come by now, as long as that takes no more than a moment."""
        self._topics.end()
        deadline = time.monotonic() + _CATCH_UP_S
        while self._take(_GLANCE_S)[0] >= _FEW or not self._topics.has_caught_up():
            if time.monotonic() >= deadline:
                break
            if not self._outbox.send():
                writable.poll(2)
        self._topics.account(final=True)
        self._events.bye()
        deadline = time.monotonic() + _LAST_WORDS_S
        while not self._outbox.send() and time.monotonic() < deadline:
            writable.poll(100)


def run(number: int) -> int:
    """The program.

    Args:
        number: File descriptor of the socket.

    Returns:
        The exit code.
    """
    peer = socket.socket(fileno=number)
    peer.set_inheritable(False)
    # The recorder gives no other order before it has been greeted.
    with peer.makefile("rb") as file:
        settings = parse_object(file.readline(MAX_BATCH))
    outbox = Outbox(peer)
    events = EventSender(outbox)
    try:
        middleware = Middleware()
    except Exception as error:
        # Whatever ROS has against coming up, the recorder is to say it.
        events.failed(error)
        outbox.send()
        return 1
    overrides = settings.get("overrides", {})
    topics = Topics(middleware, events, Definitions(share_folders()), overrides)
    child = Child(middleware, topics, outbox, events)
    events.hello(middleware.implementation)
    signal.signal(signal.SIGTERM, lambda _number, _frame: child.stop())
    threading.Thread(target=_listen, args=(peer, child), daemon=True).start()
    try:
        child.run(peer)
    except (BrokenPipeError, ConnectionResetError):
        # The recorder has died; there is nobody left to tell.
        return 1
    finally:
        middleware.close()
    return 0


def _listen(peer: socket.socket, child: Child) -> None:
    """Passes the recorder's orders on until it has no more."""
    readable = select.poll()
    readable.register(peer, select.POLLIN)
    rest = b""
    while True:
        readable.poll()
        try:
            data = peer.recv(1 << 16)
        except BlockingIOError:
            continue
        except OSError:
            data = b""
        if not data:
            break
        *lines, rest = (rest + data).split(b"\n")
        try:
            for line in lines:
                child.order(parse_object(line))
        except WireError as error:
            print(f"an order that is none: {error}", file=sys.stderr)  # noqa: T201
            break
    child.stop()
    # Whatever the middleware is stuck in, nothing outlives the recorder.
    time.sleep(2 * _LAST_WORDS_S)
    os._exit(1)
