"""Interface between a robot's middleware and the recorder: `LiveSource` and `Sink`.

A source runs its own threads. It reports topics that appear and disappear to its sink, and
passes on every message at once, as it was on the wire. A source that leaves a socket unread
makes a publisher drop messages silently. So a sink may be called from any thread, and never
waits for a disk or a database.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol, Self

from hybridlog.record.losses import Cause
from hybridlog_storage.manifest import Loss

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel


__all__ = ["Cause", "LiveSource", "Loss", "Sink"]


class Sink(Protocol):
    """Receiver of a source's messages and events.

    Thread safe; no method waits for disk or database.
    """

    def wants(self, topic: str, type_name: str) -> bool:
        """Tells whether a topic is to be recorded. Costs microseconds.

        A source asks for each new topic, and subscribes to nothing else. Names are as it spells
        them; the type is empty if not known yet.
        """

    def expect(self, channel: Channel) -> None:
        """Prepare for a channel, before its first message. Takes some milliseconds."""

    def take(
        self,
        channel: Channel,
        payload: bytes,
        *,
        received: int,
        sent: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """Take a message. Messages of one channel come from one thread at a time.

        Args:
            channel: Topic, encoding and definition: the same object for all messages of
                a connection. `has_publish_time` says whether `sent` is given.
            payload: The serialized message; it must not change afterwards.
            received: Receive time, ns since the epoch.
            sent: Send time by the sender's clock, ns since the epoch, if known.
            sequence: Sequence number of the sender, if known.
        """

    def lost(self, loss: Loss) -> None:
        """Note messages that are lost."""

    def topic_came(self, topic: str, type_name: str) -> None:
        """Note that a wanted topic has publishers."""

    def topic_gone(self, topic: str) -> None:
        """Note that a topic has no publishers left."""

    def say(self, text: str) -> None:
        """Show the user a problem and its remedy in a line, each once; recording goes on."""

    def ended(self, reason: str = "") -> None:
        """Note that the source has ended by itself; `reason` is empty after a regular end."""


class PeerError(Exception):
    """A peer is unreachable or violates the protocol; the message names the problem."""


class LiveSource(ABC):
    """A source of messages. Start it once; as a context manager it stops at the end.

    Attributes:
        kind: `ROS 1`, `ROS 2`, `Foxglove`, `replay`.
        address: Address of the peer, as the catalog shows it.
        was_reached: The peer has answered at least once; always True without a peer.
    """

    kind: str
    address: str
    was_reached: bool = True

    def check(self) -> None:  # noqa: B027 - most sources cannot check anything
        """Raise the errors of `start` before a recording is created."""

    @abstractmethod
    def start(self, sink: Sink) -> None:
        """Begin to listen.

        Temporary problems (a master that is not up yet, a publisher that dies) do not raise: the
        source reports them, and tries again. An invalid setting raises UsageError,
        a source that can never work SourceError.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stop listening. May be called more than once.

        Passes on the messages received so far, and does not call the sink after it has
        returned. Takes at most a few seconds, whatever the peers do.
        """

    def __enter__(self) -> Self:
        """The source itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self.stop()


_JOIN_S: Final = 5.0


class ThreadedSource(LiveSource):
    """A source with a thread of its own, which ends soon after `_stopping` is set."""

    def __init__(self) -> None:
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def _begin(self, sink: Sink, run: Callable[[], None]) -> None:
        """Call a function in the thread; the recorder does not wait for it after an error."""

        def guarded() -> None:
            try:
                run()
            except BaseException as error:
                if not self._stopping.is_set():
                    sink.ended(f"the {self.kind} source failed: {one_line(repr(error))}")
                raise

        name = f"hybridlog-{self.kind}"
        self._thread = threading.Thread(target=guarded, name=name, daemon=True)
        self._thread.start()

    def _reached(self) -> None:
        self.was_reached = True

    def stop(self) -> None:
        """Stop, after the messages that are under way, and wait some seconds at most."""
        self._stopping.set()
        self._join(_JOIN_S)

    def _join(self, seconds: float | None = None) -> None:
        """Wait for the end of the thread."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(seconds)


_MAX_LENGTH = 400


def one_line(text: str | bytes, limit: int = _MAX_LENGTH) -> str:
    """Text from a peer as one line: bounded, and without control characters."""
    if isinstance(text, bytes):
        text = text[: limit * 4].decode(errors="replace")
    # The end of a far longer text is not read.
    words = " ".join(text[: limit * 4].split())
    line = words if len(words) <= limit else f"{words[:limit]}..."
    return "".join(char if char.isprintable() else "?" for char in line)
