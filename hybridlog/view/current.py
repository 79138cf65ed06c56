"""The message that is current at the cursor."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog.query.answers.next_time import next_time
from hybridlog.view.context import start_of
from hybridlog_storage.errors import TimeError, TopicError
from hybridlog_storage.times import END, span_of

if TYPE_CHECKING:
    from hybridlog.message import Message
    from hybridlog.query.query import Query
    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context


@dataclass(frozen=True, slots=True)
class Current:
    """The message that is current at a time.

    Attributes:
        message: The last message not after that time; None if there is none.
        time: Its log time, ns since the start of the recording; None without a message.
        until: Log time of the next message; None if no later one is known. Both are texts, as
            the page has no integers of 64 bits.
    """

    message: Message | None
    time: str | None
    until: str | None

    @property
    def tag(self) -> str:
        """An entity tag: equal for the same message."""
        message = self.message
        return '"none"' if message is None else f'"{message.recording}-{message.seq}"'

    @property
    def headers(self) -> dict[str, str]:
        """Headers of an answer about the message."""
        times = {"Hybridlog-Time": self.time, "Hybridlog-Until": self.until}
        known = {name: time for name, time in times.items() if time is not None}
        return {"ETag": self.tag, "Cache-Control": "private, no-cache", **known}


def current(context: Context, asked: Asked) -> Current:
    """The message of the parameters `recording`, `topic`, `at` and `seq`.

    Of several messages at that time, it is the last one whose arrival number is at most `seq`.

    Raises:
        TopicError: No such recording or topic exists.
        UsageError: A parameter is missing or out of bounds.
    """
    recording, query = context.topic(asked)
    start = start_of(recording)
    moment = asked.moment(start)
    message = _message(query, moment, asked.integer("seq", 0, END, END))
    # Of messages with the same time, the last one is current: the next one is later.
    later = moment if message is None else message.log_time_ns + 1
    until = next_time(context.store.session, recording, query.topics[0], later)
    return Current(
        message,
        None if message is None else str(message.log_time_ns - start),
        None if until is None else str(until - start),
    )


def _message(query: Query, moment: int, seq: int) -> Message | None:
    if seq < END:
        with suppress(TimeError):
            beside = query.between(*span_of(moment, moment)).where(f"_meta.seq <= {seq}")
            found = beside.reverse().first()
            if found is not None:
                return found
        moment -= 1
    with suppress(TopicError):  # there is none yet
        return query.at(moment)
    return None
