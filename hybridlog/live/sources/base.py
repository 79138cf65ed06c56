"""The seam between a robot's middleware and the recorder: one source, one sink.

A source runs threads of its own. It tells its sink of the topics that come and go, and
hands over every message as it was on the wire, at once: who waits with a socket unread
makes somebody else drop in silence. A sink may be called from any thread, and takes what
it is given without waiting for a disk or a database.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Protocol, Self

from hybridlog.losses import Cause

if TYPE_CHECKING:
    from types import TracebackType

    from hybridlog_storage.messages import Channel


__all__ = ["Cause", "LiveSource", "Sink"]


class Sink(Protocol):
    """What a source speaks to. Thread safe; no method waits for disk or database."""

    def wants(self, topic: str, type_name: str) -> bool:
        """Whether messages of a topic are to be taken at all. Costs microseconds.

        Asked when a topic comes; a source subscribes to nothing else.

        Args:
            topic: Name as the source spells it.
            type_name: Type as the source spells it, empty when not known yet.
        """
        ...

    def expect(self, channel: Channel) -> None:
        """Messages of a channel may come from now on: told before the first of them.

        What that would have to wait for is done at once, and takes some milliseconds.

        Args:
            channel: As `take` will get it.
        """
        ...

    def take(
        self,
        channel: Channel,
        payload: bytes,
        *,
        received: int,
        sent: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """Take a message. Those of one channel come from one thread at a time.

        Args:
            channel: Topic, encoding and definition: the same object for all messages of
                a connection. `has_publish_time` says whether `sent` is given.
            payload: The serialized message; it must not change afterwards.
            received: When it was received, ns since the epoch.
            sent: When it was sent, by the sender's clock, ns since the epoch, if known.
            sequence: The sender's number, if it has one.
        """
        ...

    def lost(
        self,
        topic: str,
        cause: Cause,
        count: int | None,
        *,
        first: int,
        last: int,
        detail: str = "",
    ) -> None:
        """Note messages that will never come.

        Args:
            topic: Whose; empty when nobody knows.
            cause: Why.
            count: How many, None when that cannot be known.
            first: From when on, ns since the epoch, as the recorder's clock was.
            last: Until when, likewise.
            detail: For people: a publisher's name, a reason.
        """
        ...

    def topic_came(self, topic: str, type_name: str, publishers: int) -> None:
        """A topic that is wanted has publishers now, or another number of them."""
        ...

    def topic_gone(self, topic: str) -> None:
        """A topic has no publishers any more."""
        ...

    def say(self, text: str) -> None:
        """Tell the user what is wrong, where, and what to do; recording goes on.

        Args:
            text: One line. The same text is shown once.
        """
        ...

    def ended(self, reason: str = "") -> None:
        """The source has come to its end by itself.

        Args:
            reason: Why, when that is no good end; empty when all has been said.
        """
        ...


class LiveSource(ABC):
    """Something that speaks. Start it once; as a context manager it is stopped at the end.

    Attributes:
        kind: `ROS 1`, `ROS 2`, `Foxglove`, `replay`.
        address: What was connected to, as the catalog shows it.
        was_reached: Whether somebody has answered there so far; always, where nobody has to.
    """

    kind: str
    address: str
    was_reached: bool = True

    def check(self) -> None:  # noqa: B027 - most can say nothing before they start
        """Refuse what `start` would refuse, before anything is made for a recording.

        Raises:
            UsageError: An address or another setting that is none.
            SourceError: It can never work.
            MissingDependencyError: What it needs is not installed.
        """

    @abstractmethod
    def start(self, sink: Sink) -> None:
        """Begin to listen.

        What can mend itself (a master that is not there yet, a publisher that dies) does
        not raise: the source says so, and tries again with growing pauses.

        Raises:
            UsageError: An address or another setting that is none.
            SourceError: It can never work: a file that is no log.
            MissingDependencyError: What it needs is not installed.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stop listening. May be called more than once.

        What has been received by now is handed over first; the sink is not called after
        this returned. Takes at most a few seconds, whatever the peers do.
        """

    def __enter__(self) -> Self:
        """The source itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop."""
        self.stop()
