"""Summaries of recordings, which say enough to choose among them.

A question first chooses among summaries, and then reads the entries of the chosen
recordings. The summaries of ten thousand recordings load in some ten milliseconds.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any, Final, NamedTuple


class TopicType(NamedTuple):
    """A topic of a recording, and how its messages are encoded.

    Attributes:
        topic: Full name.
        encoding: Encoding of the messages; empty if all messages of the topic are lost.
        schema: Hash of the schema; empty without one.
    """

    topic: str
    encoding: str
    schema: str


class RecordingSummary(NamedTuple):
    """One recording in short.

    Attributes:
        id: As of `RecordingEntry`, like all attributes without a description here.
        label: See there.
        name: See there.
        tags: See there.
        source: See there.
        created: See there.
        status: See there.
        span: Log time `[first, last]`, ns, both inclusive; None without messages.
        extent: Log time `[begin, end)`, ns, with lost messages; `(0, 0)` without any.
        topics: Hash of its topics and their types; see `hash_of`.
        topic_count: Number of its topics.
        messages: Number of messages.
        stored_bytes: See there.
        segments: See there.
        has_losses: Whether its loss ledger has a row.
        has_lost_segments: Whether stored messages of it are missing.
        expired: Number of messages whose payloads were deleted to make room.
        not_copied: Number of messages whose payloads were not copied yet.
        notes: See there.
        look: State of its directory and its journal when its files were read.
        indexed_by: The id of the index that is known to be complete for it; empty if none is.
    """

    id: str
    label: str
    name: str
    tags: dict[str, str]
    source: dict[str, Any]
    created: int
    status: str
    span: tuple[int, int] | None
    extent: tuple[int, int]
    topics: str
    topic_count: int
    messages: int
    stored_bytes: int
    segments: int
    has_losses: bool
    has_lost_segments: bool
    expired: int
    not_copied: int
    notes: list[dict[str, Any]]
    look: str
    indexed_by: str = ""

    @property
    def key(self) -> str:
        """The first 64 bits of the id, 16 hexadecimal digits; index documents refer to it."""
        return self.id[:16]

    def to_json(self) -> str:
        """The summary as text, without the state of its index. In ASCII."""
        return json.dumps(self[:-1], separators=(",", ":"))

    @classmethod
    def from_values(cls, values: list[Any], indexed_by: str) -> RecordingSummary:
        """The summary from the values of its text.

        Raises:
            TypeError: A value is missing, of another type, or there is one too many.
            ValueError: A span is no pair, or a number has more than 64 bits.
        """
        if [type(value) for value in values] not in (_TYPES, _TYPES_WITHOUT_SPAN):
            raise TypeError("the values are no summary")
        span, (begin, end) = values[_SPAN : _SPAN + 2]
        numbers = [begin, end, *(value for value in values if type(value) is int)]
        if span is not None:
            first, last = span
            span = first, last
            numbers += span
        if any(type(one) is not int or not -MAX_INT <= one <= MAX_INT for one in numbers):
            raise ValueError("a time or a count is no number of 64 bits")
        rest = values[_SPAN + 2 :]
        return cls._make([*values[:_SPAN], span, (begin, end), *rest, indexed_by])


MAX_INT: Final = 2**63 - 1
"""The greatest time and count, without the sign."""
_SPAN: Final = RecordingSummary._fields.index("span")  # the extent follows
_TYPES: Final[list[type]] = [
    *(str, str, str, dict, dict, int, str, list, list, str),
    *(int, int, int, int, bool, bool, int, int, list, str),
]
_TYPES_WITHOUT_SPAN: Final = [*_TYPES[:_SPAN], type(None), *_TYPES[_SPAN + 1 :]]


def topics_to_json(topics: Iterable[TopicType]) -> str:
    """Topics and their types as text, in ASCII; equal for equal sets."""
    return json.dumps(sorted(set(topics)), separators=(",", ":"))


def topics_from_json(text: str) -> tuple[TopicType, ...]:
    """Topics and their types from their text."""
    return tuple(TopicType(*values) for values in json.loads(text))


def hash_of(topics: str) -> str:
    """128 bits of BLAKE2b of the text of a set of topics, in hexadecimal digits."""
    return hashlib.blake2b(topics.encode(), digest_size=16).hexdigest()
