"""Triggers: conditions on messages, which are evaluated as the messages come."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.types import check
from hybridlog.query.topics import TopicMatcher, matcher, split_topic
from hybridlog.schema.codec import plain_message
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.errors import DefinitionError, PayloadError, UsageError, WhereError

if TYPE_CHECKING:
    from collections.abc import Callable

    from hybridlog.query.predicate.tree import Predicate
    from hybridlog_storage.messages import Channel

_MAX_WARNINGS = 100  # lines about triggers


@dataclass(frozen=True, slots=True)
class Trigger:
    """A condition on messages.

    Attributes:
        text: As the user wrote it.
        fits: Tells whether a topic matches.
        predicate: Condition for a message; None for any message.
    """

    text: str
    fits: TopicMatcher
    predicate: Predicate | None

    @classmethod
    def of(cls, text: str) -> Trigger:
        """Parse `/diagnostics: status[*].level >= 2`, or a topic alone.

        Raises:
            UsageError: The topic is missing.
            TopicError: The pattern is malformed.
            WhereError: The predicate is malformed.
        """
        topic, predicate = split_topic(text)
        if not topic or (not predicate and " " in topic):
            raise UsageError(f"--trigger wants TOPIC, or TOPIC: PREDICATE, not {text!r}.")
        fits = matcher([topic])
        condition = parse(predicate) if predicate else None
        for path in [] if condition is None else condition.fields():
            if path.split(".", 1)[0] in {"_id", "_meta"}:
                raise WhereError(
                    f"a trigger sees messages before they are stored: {path} does not exist yet"
                )
        return cls(text, fits, condition)


class _Watch(NamedTuple):
    """A trigger, compiled for the messages of one channel.

    Attributes:
        text: The trigger's text.
        test: Condition for a message's fields; None if any message fires it.
        names: Top-level fields that the condition needs.
    """

    text: str
    test: Callable[[Mapping[str, object]], bool] | None
    names: frozenset[str] = frozenset()


class Triggers:
    """Tells which triggers a message fires, and which can never fire.

    Args:
        triggers: The triggers.
        say: Shows a line to the user.
        settle_s: Seconds after the first topic in which others may come, before a trigger is
            told that none matches.
    """

    def __init__(
        self, triggers: Sequence[Trigger], say: Callable[[str], None], *, settle_s: float = 3.0
    ) -> None:
        self._triggers = triggers
        self._say = say
        self._settle_s = settle_s
        self._unmet = dict.fromkeys(trigger.text for trigger in triggers)
        self._complete_at: float | None = None
        self._warned: set[str] = set()
        self._watched: dict[Channel, tuple[_Watch, ...]] = {}

    def expect(self, channel: Channel) -> tuple[_Watch, ...]:
        """Compile the triggers for a channel; tells those that can never fire on it."""
        watches = self._watched[channel] = tuple(self._watches(channel))
        return watches

    def fired(self, channel: Channel, payload: bytes) -> Iterator[str]:
        """Texts of the triggers that a message fires."""
        watches = self._watched.get(channel)
        if watches is None:
            watches = self.expect(channel)
        if watches:
            yield from _fired(watches, channel, payload)

    def look(self, topics: Collection[str]) -> None:
        """Tell the triggers that match no topic after some seconds.

        Args:
            topics: Full names of the topics so far.
        """
        for trigger in self._triggers:
            if any(map(trigger.fits, topics)):
                self._unmet.pop(trigger.text, None)
        if topics and self._complete_at is None:
            self._complete_at = time.monotonic() + self._settle_s
        if self._complete_at is not None and time.monotonic() >= self._complete_at:
            for text in [*self._unmet]:
                self._warn_once(f"no topic matches the trigger {text!r} so far")

    def close(self) -> None:
        """Tell the triggers that have matched no topic."""
        for text in self._unmet:
            self._say(f"no topic matched the trigger {text!r}")

    def _watches(self, channel: Channel) -> Iterator[_Watch]:
        """The triggers for a channel that may fire on it."""
        for trigger in self._triggers:
            if not trigger.fits(channel.topic):
                continue
            self._unmet.pop(trigger.text, None)
            if trigger.predicate is None:
                yield _Watch(trigger.text, None)
                continue
            types = {path.path: path.type for path in codec_for(channel).paths()} or None
            try:
                check(trigger.predicate, types)
            except WhereError as error:
                self._warn_once(
                    f"trigger {trigger.text!r} can never fire on {channel.topic}: {error}"
                )
            else:
                names = frozenset(path.split(".", 1)[0] for path in trigger.predicate.fields())
                from hybridlog.query.predicate.to_mask import mask_of_objects

                def test(message, of=trigger.predicate, types=types):  # type: ignore
                    return bool(mask_of_objects(of, types, [message])[0])

                yield _Watch(trigger.text, test, names)

    def _warn_once(self, text: str) -> None:
        if text not in self._warned and len(self._warned) < _MAX_WARNINGS:
            self._warned.add(text)
            self._say(text)


def _fired(watches: tuple[_Watch, ...], channel: Channel, payload: bytes) -> Iterator[str]:
    names = frozenset[str]().union(*(watch.names for watch in watches))
    fields: Mapping[str, object] | None = None
    for text, test, _ in watches:
        if test is not None and fields is None:
            try:
                fields = plain_message(codec_for(channel), payload, names)
            except (PayloadError, DefinitionError):
                fields = {}  # it has no fields, as in an answer
        if test is None or (fields is not None and test(fields)):
            yield text
