"""What cannot be had from publishers, told once a node and not once a topic."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from hybridlog.live.sources.ros1.network import UnreachedError, reason_of
from hybridlog.live.sources.text import one_line

if TYPE_CHECKING:
    from collections.abc import Callable

_QUIET_S = 1.5  # without more news it is told; a busy master delays some topics by a second
_MAX_S: Final = 5.0
_NAMED: Final = 3
_MOST: Final = 10_000

_Key = tuple[str, bool]  # a node's address, and whether it cannot be reached at all


class ErrorAggregator:
    """Gathers what fails about the topics of a node for a moment, and says it in one line.

    What fails again is not told again, however its reason is worded by then.

    Args:
        say: Takes the lines.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._known: dict[_Key, set[str]] = {}
        self._size = 0
        self._new: dict[_Key, tuple[str, list[str]]] = {}
        self._since = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def add(self, uri: str, topic: str, error: Exception) -> None:
        """A topic cannot be had from a node. Within the event loop."""
        key = uri, isinstance(error, UnreachedError)
        topics = self._known.setdefault(key, set())
        if topic in topics or self._size >= _MOST:
            return
        is_told = bool(topics) and key[1] and key not in self._new
        topics.add(topic)
        self._size += 1
        if is_told:
            return  # a node that is away is so for all of its topics
        self._flush_soon()
        self._new.setdefault(key, (reason_of(error), []))[1].append(topic)

    def resolve(self, uri: str, topic: str) -> None:
        """A topic was had from a node for a while: what fails from now on is news."""
        away = self._known.pop((uri, True), set())
        self._size -= len(away)
        rest = self._known.get((uri, False), set())
        if topic in rest:
            rest.remove(topic)
            self._size -= 1

    def _flush_soon(self) -> None:
        loop = asyncio.get_running_loop()
        if self._timer is not None:
            self._timer.cancel()
        if not self._new:
            self._since = loop.time()
        self._timer = loop.call_at(min(loop.time() + _QUIET_S, self._since + _MAX_S), self.flush)

    def flush(self) -> None:
        """Say what has been gathered."""
        new, self._new = self._new, {}
        for (uri, is_away), (reason, topics) in new.items():
            self._say(_line(one_line(uri), reason, sorted(topics), is_away=is_away))


def _line(uri: str, reason: str, topics: list[str], *, is_away: bool) -> str:
    named = ", ".join(map(one_line, topics[:_NAMED])) + (", …" if len(topics) > _NAMED else "")
    its = "its"
    if len(topics) > 1:
        named, its = f"{len(topics)} topics ({named})", "their"
    if not is_away:
        return f"{named}: nothing can be had from {its} publisher at {uri}: {reason}; trying on"
    return (
        f"{named}: {its} publisher at {uri} cannot be reached: {reason}; trying on. Is it dead "
        "(`rosnode cleanup`), or on a computer whose name is not known here (set ROS_IP there)?"
    )
