"""Sends the child's events to the recorder, one method per kind of event."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlog.live.sources.ros2.child.definitions import Definition
    from hybridlog.live.sources.ros2.child.outbox import Outbox

MAX_REPORTS = 10_000
"""Maximum number of different problem reports."""


class EventSender:
    """Puts events into the outbox, after earlier messages."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._channels: list[str] = []
        self._said: set[str] = set()

    def hello(self, middleware: str) -> None:
        """Greets the recorder: ROS is up."""
        self._outbox.event({"event": "hello", "middleware": middleware})

    def failed(self, error: Exception) -> None:
        """Reports that ROS does not start."""
        why = f"{type(error).__name__}: {error}"
        missing = isinstance(error, ImportError)
        self._outbox.event({"event": "failed", "missing": missing, "why": why})

    def candidate(self, topic: str, kind: str) -> None:
        """Reports a topic that the recorder may want."""
        self._outbox.event({"event": "candidate", "topic": topic, "type": kind})

    def publishers(self, topic: str, kind: str, count: int) -> None:
        """Reports the number of publishers of a wanted topic."""
        self._outbox.event({"event": "topic", "topic": topic, "type": kind, "publishers": count})

    def gone(self, topic: str) -> None:
        """Reports that a wanted topic has no publishers left."""
        self._outbox.event({"event": "gone", "topic": topic})

    def channel(
        self, topic: str, kind: str, definition: Definition, offered: str, type_hash: str
    ) -> int:
        """Announces a channel for the messages of a topic; returns its number."""
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
        """Reports lost messages.

        Args:
            topic: Their topic.
            cause: Value of `base.Cause`.
            count: Number of messages, None if unknown.
            times: Begin and end of the loss, ns since the epoch; None for now.
            detail: Text for the user.
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
        """Reports messages that the outbox refused."""
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
        """Reports a problem to the user, each text once."""
        if text not in self._said and len(self._said) < MAX_REPORTS:
            self._said.add(text)
            self._outbox.event({"event": "say", "text": text})

    def bye(self) -> None:
        """Reports that all messages were passed on."""
        self._outbox.event({"event": "bye"})
