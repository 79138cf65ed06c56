"""Triggers: conditions on messages, which mark and pin what is around."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog.query.predicate.parser import parse
from hybridlog.query.topics import TopicMatcher, matcher, split_topic
from hybridlog_storage.errors import UsageError, WhereError

if TYPE_CHECKING:
    from hybridlog.query.predicate.tree import Predicate


@dataclass(frozen=True, slots=True)
class Trigger:
    """A condition on messages of topics; without a predicate any of them fires it."""

    text: str
    fits: TopicMatcher
    predicate: Predicate | None

    @classmethod
    def of(cls, text: str) -> Trigger:
        """Parse `/diagnostics: status[*].level >= 2`, or a topic alone.

        Raises:
            UsageError: The topic is missing.
            TopicError: The pattern is malformed.
            WhereError: The predicate is malformed, or is not about the fields of one message.
        """
        topic, condition = split_topic(text)
        if not topic or (not condition and " " in topic):
            raise UsageError(f"--trigger wants TOPIC, or TOPIC: PREDICATE, not {text!r}.")
        fits, predicate = matcher([topic]), parse(condition) if condition else None
        if predicate is not None:
            names = {path.split(".", 1)[0] for path in predicate.fields()}
            if names & {"_id", "_meta"} or predicate.filters:
                raise WhereError(
                    f"A trigger asks for fields of the message alone, not for {condition}."
                )
        return cls(text, fits, predicate)
