"""What the child tells the recorder besides messages: events of the wire, one method each.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlog.live.sources.ros2.child.definitions import Definition
    from hybridlog.live.sources.ros2.child.outbox import Outbox

MAX_SAID = 10_000
"""Different complaints that are told; what has more to say has one reason for all."""


class EventSender:
    """Puts events into the outbox, behind the messages that came before.

    Args:
        outbox: Where they go.
    """

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._channels: list[str] = []
        self._said: set[str] = set()

    def hello(self, middleware: str) -> None:
        """ROS is up."""
        self._outbox.event({"event": "hello", "middleware": middleware})

    def failed(self, error: Exception) -> None:
        """ROS does not come up."""
        why = f"{type(error).__name__}: {error}"
        missing = isinstance(error, ImportError)
        self._outbox.event({"event": "failed", "missing": missing, "why": why})

    def candidate(self, topic: str, kind: str) -> None:
        """There is a topic that the recorder may want."""
        self._outbox.event({"event": "candidate", "topic": topic, "type": kind})

    def publishers(self, topic: str, kind: str, count: int) -> None:
        """A wanted topic has so many publishers now."""
        self._outbox.event({"event": "topic", "topic": topic, "type": kind, "publishers": count})

    def gone(self, topic: str) -> None:
        """A wanted topic has no publishers any more."""
        self._outbox.event({"event": "gone", "topic": topic})

    def channel(
        self, topic: str, kind: str, definition: Definition, offered: str, type_hash: str
    ) -> int:
        """Messages of a topic will come.

        Returns:
            The number of the channel that they are to have.
        """
        number = len(self._channels)
        self._channels.append(topic)
        self._outbox.event(
            {
                "event": "channel",
                "number": number,
                "topic": topic,
                "type": kind,
                "encoding": definition.encoding,
                "definition": definition.text.decode("utf-8", "surrogateescape"),
                "offered": offered,
                "hash": type_hash,
            }
        )
        return number

    def lost(
        self,
        topic: str,
        cause: str,
        count: int | None,
        *,
        times: tuple[int, int] | None = None,
        detail: str = "",
    ) -> None:
        """Messages will never come.

        Args:
            topic: Whose.
            cause: Value of `base.Cause`.
            count: How many, None when that cannot be known.
            times: From when until when, ns since the epoch; None for now.
            detail: For people.
        """
        now = time.time_ns()
        first, last = times or (now, now)
        self._outbox.event(
            {
                "event": "lost",
                "topic": topic,
                "cause": cause,
                "count": count,
                "first": first,
                "last": last,
                "detail": detail,
            }
        )

    def refusals(self) -> None:
        """Messages found no room in the outbox."""
        for number, refusal in self._outbox.refused.items():
            self.lost(
                self._channels[number],
                "queue",
                refusal.count,
                times=(refusal.first, refusal.last),
                detail="the recorder did not take them from the ROS 2 child in time",
            )
        self._outbox.refused.clear()

    def say(self, text: str) -> None:
        """Something is wrong; the same is said once."""
        if text not in self._said and len(self._said) < MAX_SAID:
            self._said.add(text)
            self._outbox.event({"event": "say", "text": text})

    def bye(self) -> None:
        """All has been handed over."""
        self._outbox.event({"event": "bye"})
