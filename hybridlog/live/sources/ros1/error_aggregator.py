"""Aggregates subscription errors: one report per node instead of one per topic."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from hybridlog.live.sources.ros1.network import UnreachedError, reason_of
from hybridlog.live.sources.text import one_line
from hybridlog.wording import listed

if TYPE_CHECKING:
    from collections.abc import Callable

_QUIET_S = 1.5  # without further errors they are reported; a busy master delays some topics
_MAX_DELAY_S: Final = 5.0
_MAX_NAMED: Final = 3
_MAX_ERRORS: Final = 10_000

_Key = tuple[str, bool]  # a node's address, and True if it is unreachable


class ErrorAggregator:
    """Collects errors of a node's topics for a moment, and reports them in one line.

    A repeated error is not reported again, even with another reason.

    Args:
        say: Reports a line to the user.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._known: dict[_Key, set[str]] = {}
        self._size = 0
        self._new: dict[_Key, tuple[str, list[str]]] = {}
        self._since = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def add(self, uri: str, topic: str, error: Exception) -> None:
        """Adds an error of a topic; call it within the event loop."""
        key = uri, isinstance(error, UnreachedError)
        topics = self._known.setdefault(key, set())
        if topic in topics or self._size >= _MAX_ERRORS:
            return
        is_reported = bool(topics) and key[1] and key not in self._new
        topics.add(topic)
        self._size += 1
        if is_reported:
            return  # an unreachable node is so for all of its topics
        self._flush_soon()
        self._new.setdefault(key, (reason_of(error), []))[1].append(topic)

    def resolve(self, uri: str, topic: str) -> None:
        """Forgets the errors of a topic that works; later ones are reported again."""
        unreachable = self._known.pop((uri, True), set())
        self._size -= len(unreachable)
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
        self._timer = loop.call_at(
            min(loop.time() + _QUIET_S, self._since + _MAX_DELAY_S), self.flush
        )

    def flush(self) -> None:
        """Reports the collected errors."""
        new, self._new = self._new, {}
        for (uri, is_unreachable), (reason, topics) in new.items():
            self._say(_line(one_line(uri), reason, sorted(topics), is_unreachable=is_unreachable))


def _line(uri: str, reason: str, topics: list[str], *, is_unreachable: bool) -> str:
    named = listed(map(one_line, topics), _MAX_NAMED)
    its = "its"
    if len(topics) > 1:
        named, its = f"{len(topics)} topics ({named})", "their"
    if not is_unreachable:
        return f"{named}: cannot subscribe at {its} publisher {uri}: {reason}; trying again"
    return (
        f"{named}: {its} publisher {uri} cannot be reached: {reason}; trying again. Is it dead "
        "(`rosnode cleanup`), or on a computer with an unknown name (set ROS_IP there)?"
    )
