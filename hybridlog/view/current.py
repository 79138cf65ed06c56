"""The message that is current at the cursor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog.view.context import start_of
from hybridlog_storage.errors import TimeError, TopicError

if TYPE_CHECKING:
    from hybridlog.message import Message
    from hybridlog.query.query import Query
    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context


@dataclass(frozen=True, slots=True)
class Current:
    """What is current at a time.

    Attributes:
        message: The last message not after that time; None if there is none.
        time: Its log time, ns since the start of the recording; None without a message.
        until: Log time of the next message; None if no later one is known.
    """

    message: Message | None
    time: int | None
    until: int | None

    @property
    def tag(self) -> str:
        """An entity tag: equal for the same message."""
        message = self.message
        return '"none"' if message is None else f'"{message.recording}-{message.seq}"'

    @property
    def headers(self) -> dict[str, str]:
        """Headers of an answer about the message."""
        times = {"Hybridlog-Time": self.time, "Hybridlog-Until": self.until}
        known = {name: str(time) for name, time in times.items() if time is not None}
        return {"ETag": self.tag, "Cache-Control": "private, no-cache", **known}


def current(context: Context, asked: Asked) -> Current:
    """The message of the parameters `recording`, `topic` and `at`.

    Raises:
        TopicError: No such recording or topic exists.
        UsageError: A parameter is missing or out of bounds.
    """
    entry = context.recording(asked)
    query = context.query(entry, asked.text("topic"))
    start = start_of(entry)
    moment = start + asked.offset("at")
    try:
        message = query.at(max(moment, 0))
    except TopicError:
        return Current(None, None, _next(query, moment, start))
    # Of messages with the same time, the last one is current: the next one is later.
    time = message.log_time_ns
    return Current(message, time - start, _next(query, time + 1, start))


def _next(query: Query, moment: int, start: int) -> int | None:
    try:
        found = query.between(max(moment, 0)).first()
    except TimeError:  # behind the end of the recording
        return None
    return None if found is None else found.log_time_ns - start
