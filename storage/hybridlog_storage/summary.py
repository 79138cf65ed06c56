"""Summaries of recordings, which say enough to choose among them.

A question first chooses among summaries, and then reads the entries of the chosen
recordings. The summaries of ten thousand recordings load within a tenth of a second.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Annotated, Any, Final, NamedTuple

from msgspec import Meta

MAX_INT: Final = 2**63 - 1
"""The greatest time and count, without the sign."""
Int = Annotated[int, Meta(ge=-MAX_INT, le=MAX_INT)]


class TopicType(NamedTuple):
    """A topic of a recording, and how its messages are encoded.

    `encoding` is empty if all messages of the topic are lost; `schema`, a hash, and `type`, its
    name, without one.
    """

    topic: str
    encoding: str
    schema: str
    type: str


class RecordingSummary(NamedTuple):
    """One recording in short; attributes without a description are as of `RecordingEntry`.

    Attributes:
        span: Log time `[first, last]`, ns, both inclusive; None without messages.
        extent: Log time `[begin, end)`, ns, with lost messages; `(0, 0)` without any.
        topics: Hash of its topics and their types; see `hash_of`.
        has_losses: Whether its loss ledger has a row.
        has_lost_segments: Whether stored messages of it are missing.
        expired: Number of messages whose payloads were deleted to make room.
        not_copied: Number of messages whose payloads were not copied yet.
        look: State of its directory and its manifest then.
        indexed_by: The id of the index that is known to be complete for it; empty if none is.
    """

    id: str
    name: str
    tags: dict[str, str]
    source: dict[str, Any]
    created: Int
    status: str
    span: tuple[Int, Int] | None
    extent: tuple[Int, Int]
    topics: str
    topic_count: Int
    messages: Int
    stored_bytes: Int
    segments: Int
    has_losses: bool
    has_lost_segments: bool
    expired: Int
    not_copied: Int
    notes: list[dict[str, Any]]
    look: str
    indexed_by: str = ""

    @property
    def key(self) -> str:
        """The random digits of the id; index documents refer to it."""
        return self.id[-16:]


def topics_to_json(topics: Iterable[TopicType]) -> str:
    """Topics and their types as text, in ASCII; equal for equal sets."""
    return json.dumps(sorted(set(topics)), separators=(",", ":"))


def hash_of(topics: str) -> str:
    """128 bits of BLAKE2b of the text of a set of topics, in hexadecimal digits."""
    return hashlib.blake2b(topics.encode(), digest_size=16).hexdigest()
