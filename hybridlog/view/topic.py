"""A topic of a recording, also of one that goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING

from hybridlog.drawing.flushed import END
from hybridlog.query.answers.next_time import next_time
from hybridlog.query.question import field_types
from hybridlog.view.context import start_of
from hybridlog_storage.errors import TimeError, TopicError

if TYPE_CHECKING:
    from hybridlog.drawing.flushed import Flushed
    from hybridlog.message import Message
    from hybridlog.query.query import Query
    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context


class Topic:
    """The topic of the parameters `recording` and `topic`.

    Args:
        context: The store.
        asked: The parameters.

    Attributes:
        start: The time that offsets count from, ns.
        query: What queries see of it; None if that is nothing.
        flushed: What the running recording has flushed besides; None if it does not go on.

    Raises:
        TopicError: No such recording or topic exists.
        UsageError: A parameter is missing or out of bounds.
    """

    def __init__(self, context: Context, asked: Asked) -> None:
        entry = context.recording(asked)
        name = asked.text("topic")
        self._session, self._entry, self._name = context.store.session, entry, name
        self.start = start_of(entry)
        self.flushed: Flushed | None = None
        self.query: Query | None = None
        if entry.status == "open":
            self.flushed = context.flushed.of(entry, name)
        try:
            self.query = context.query(entry, name)
        except TopicError:
            if self.flushed is None or not self.flushed.channels:
                raise

    @property
    def type(self) -> str:
        """Name of the type of its messages; empty if unknown."""
        channels = [] if self.query is None else self.query.channels()
        if self.flushed is not None:
            channels += self.flushed.channels
        schemas = (channel.channel.schema for channel in channels)
        return next((schema.name for schema in schemas if schema is not None), "")

    def field_types(self) -> dict[str, str] | None:
        """Types of its fields by path; None where no definition fixes them."""
        if self.query is not None:
            return self.query.field_types()
        return field_types(tuple(self.flushed.channels)) if self.flushed is not None else {}

    def messages(self, begin: int, most: int) -> Iterator[Message]:
        """Its first messages from a log time on, ns: at most so many."""
        rest = most
        with suppress(TimeError):  # the query has none from there on
            if self.query is not None:
                for message in self.query.between(begin).limit(most):
                    rest -= 1
                    yield message
        if self.flushed is not None:
            yield from islice(self.flushed.messages((begin, END)), rest)

    def next_time(self, moment: int) -> int | None:
        """The least log time of its messages that is not before a time, ns."""
        found = next_time(self._session, self._entry, self._name, moment)
        if self.flushed is not None:
            later = next(self.flushed.messages((moment, END)), None)
            if later is not None and (found is None or later.log_time_ns < found):
                return later.log_time_ns
        return found

    def at(self, moment: int) -> Message | None:
        """The last message not after a log time, ns."""
        found: list[Message] = []
        with suppress(TopicError):
            if self.query is not None:
                found.append(self.query.at(max(moment, 0)))
        if self.flushed is not None:
            latest = self.flushed.messages((0, moment + 1), reverse=True)
            found += [message for message in (next(latest, None),) if message is not None]
        return max(found, key=lambda message: (message.log_time_ns, message.seq), default=None)
