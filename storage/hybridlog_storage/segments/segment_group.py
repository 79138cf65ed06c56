"""A group: the segments of a recording that are opened and sealed together.

The first one has small topics, latched messages, attachments and metadata; it stays as long as
the recording. Others have larger messages, which may go earlier: topics with a file of their
own, and the second file with the rest.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from hybridlog_storage.segments.chunk import PackedChunk
    from hybridlog_storage.segments.segment_file import Sealed, SegmentFile

FIRST: Final = 1
"""Key of the first segment of a group."""
SECOND: Final = 2
"""Key of the segment with larger topics that have none of their own."""
LATCHED: Final = 3
"""Key of the segment with latched messages, where they stay alone: a group of its own."""
Key = Literal[1, 2, 3] | str
"""A segment of a group: one of the above, or that of a topic."""
_NAMED: Final = 14  # topics with segments of their own by a rule
_OTHERS: Final = 16  # and by their size: a group has 32 segments at most
_LEAST: Final = 16  # times that mean payload that it has had: small logs have few files
_MAX_CHUNKS: Final = 1 << 14  # of a segment: its reader needs a kilobyte of memory for each
_MAX_PARTS: Final = 1 << 20  # sum over a segment's chunks of their channels in the summary


class Division:
    """Decides which segment of a group a chunk goes to.

    Args:
        own_payload: Mean payload bytes from which a topic has a segment of its own in the first
            group, once it has two messages and 16 times so many bytes.
        large_payload: The same in later groups, for those with the most bytes in the group
            before.
        is_named: Returns whether a rule names a topic.
    """

    def __init__(
        self, own_payload: int, large_payload: int, is_named: Callable[[str], bool]
    ) -> None:
        self._own_payload = own_payload
        self._large_payload = large_payload
        self._is_named = is_named
        self._named: dict[str, bool] = {}
        self._own: set[str] = set()
        self._is_first = True
        self._messages: Counter[str] = Counter()  # of this group
        self._bytes: Counter[str] = Counter()

    def is_named(self, topic: str) -> bool:
        """True if a rule names a topic, and there was room for a segment of its own."""
        found = self._named.get(topic)
        if found is None:
            has_room = sum(self._named.values()) < _NAMED
            found = self._named[topic] = has_room and self._is_named(topic)
        return found

    def key(self, topic: str, chunk: PackedChunk) -> Key:
        """The segment for the next chunk of a topic that shares no chunks."""
        messages = self._messages[topic] = self._messages[topic] + int(
            chunk.parts["messages"].sum()
        )
        size = self._bytes[topic] = self._bytes[topic] + int(chunk.parts["payload_bytes"].sum())
        if topic in self._own or self.is_named(topic):
            return topic
        is_large = messages > 1 and size >= self._own_payload * max(messages, _LEAST)
        if self._is_first and len(self._own) < _OTHERS and is_large:
            self._own.add(topic)
            return topic
        return SECOND

    def begin(self) -> None:
        """Begin the next group."""
        large = [
            topic
            for topic, size in self._bytes.most_common()
            if size >= self._large_payload * self._messages[topic] and not self.is_named(topic)
        ]
        self._own = {*large[:_OTHERS]}
        self._is_first = False
        self._messages.clear()
        self._bytes.clear()


class SegmentGroup:
    """The open segments of a group, by key, in the order of their numbers.

    `create` starts the next one, given the number of the group's first one, or None to start that.
    """

    def __init__(self, create: Callable[[int | None], SegmentFile]) -> None:
        self._create = create
        self._opened = time.monotonic()
        self.segments: dict[Key, SegmentFile] = {FIRST: create(None)}

    @property
    def first(self) -> SegmentFile:
        """Its first segment."""
        return self.segments[FIRST]

    @property
    def position(self) -> int:
        """Bytes in its segments."""
        return sum(segment.position for segment in self.segments.values())

    def segment(self, key: Key) -> SegmentFile:
        """A segment; started if there is none."""
        found = self.segments.get(key)
        if found is None:
            group = None if key == LATCHED else self.first.number
            found = self.segments[key] = self._create(group)
        return found

    def is_full(self, size: int, span_s: float | None) -> bool:
        """True if it has a size, has lasted for a time, or a segment has too many chunks."""
        if span_s is not None and time.monotonic() - self._opened >= span_s:
            return True
        return self.position >= size or any(
            one.table.chunks >= _MAX_CHUNKS or one.table.parts >= _MAX_PARTS
            for one in self.segments.values()
        )

    def sync(self) -> None:
        """Force the written bytes to the disk."""
        for segment in [*self.segments.values()]:
            segment.sync()

    def prepare(self, *, sync: bool) -> list[Sealed]:
        """Complete all segments, the first one last: until then it takes records."""
        segments = [*self.segments.values()]
        for segment in reversed(segments):
            segment.complete()
        # A file system that forces one of them to the disk then does so for all.
        for segment in segments:
            segment.trim()
        return [segment.prepare(sync=sync) for segment in segments]

    def abandon(self) -> None:
        """Close all without sealing them."""
        for segment in self.segments.values():
            segment.abandon()
