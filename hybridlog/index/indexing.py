"""Decodes the messages of a recording, once for tables, documents and statistics; sends documents.

All that is derived of them needs only chunks and their channels, so it is disposable.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog.schema.codec import Codec, Decoded, stamps_of
from hybridlog.schema.codecs import bodies_in, codec_for
from hybridlog.schema.column import STAMP, Records, header_stamps
from hybridlog.schema.states import encoding_of
from hybridlog_storage.cache import lazy
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.messages import EXPIRED_IDS, Channel, rows_by_channel
from hybridlog_storage.mongo.index_documents import DocumentAssembler, IndexState, collection_of
from hybridlog_storage.segments.chunk import Placed, StoredChunk

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.mongo.database import Database


class Messages:
    """Messages of some chunks, on channels that are alike: `channel` is one of them."""

    def __init__(self, channel: Channel, codec: Codec, placed: Placed) -> None:
        self.channel = channel
        self.codec = codec
        self.placed = placed

    @lazy
    def decoded(self) -> Decoded | None:
        """The messages decoded; None where these have no fields."""
        return self.codec.columns_of(self.placed.batch) if self.codec.indexed else None


class ChunkIndexer:
    """Decodes the chunks of a recording, given by its id or key, and makes its documents."""

    def __init__(self, recording: str) -> None:
        self._key = recording[-16:]
        self._kinds: dict[int, tuple[Hashable, Channel, Codec]] = {}  # by channel
        self._assemblers: dict[tuple[str, bool], DocumentAssembler] = {}

    def messages_in(
        self, chunks: Sequence[StoredChunk], channels: Mapping[int, Channel]
    ) -> list[Messages]:
        """The messages of some chunks; several chunks of few take little longer than one."""
        placed = Placed.of(chunks)
        alike: dict[Hashable, tuple[Channel, Codec, list[NDArray[np.intp]]]] = {}
        for number, rows in rows_by_channel(placed.batch.channel):
            if number not in self._kinds:
                self._kinds[number] = _kind_of(channels[number])
            kind, channel, codec = self._kinds[number]
            alike.setdefault(kind, (channel, codec, []))[2].append(rows)
        return [
            Messages(channel, codec, placed.take(np.concatenate(own)))
            for channel, codec, own in alike.values()
        ]

    def take(
        self, messages: Messages, decoded: dict[int, ChannelStats], *, has_documents: bool
    ) -> list[NDArray[np.uint8]]:
        """Make documents, and add the results of decoding by channel.

        Returns uint8[k, width] each, a whole BSON document a row; none without `has_documents`.
        """
        channel, placed = messages.channel, messages.placed
        batch, found = placed.batch, messages.decoded
        unreadable, surplus = np.zeros((2, len(batch)), np.bool_)
        tables = []
        if has_documents and channel.is_indexed:
            key = channel.topic, channel.has_publish_time
            if key not in self._assemblers:
                self._assemblers[key] = DocumentAssembler(self._key, channel)
            for group in bodies_in(found, len(batch)):
                unreadable[group.rows] = group.error is not None
                made = self._assemblers[key].assemble(placed, group.rows, group.body, group.error)
                tables.append(made)
        elif found is not None:
            for bad in found.unreadable:
                unreadable[bad.rows] = True
        if found is not None:
            surplus[found.surplus] = True
        stamped, stamps = _stamps_of(messages)
        for number, rows in rows_by_channel(batch.channel):
            own = rows[stamped[rows]]
            stats = stamp_stats(batch.log_time[own], stamps[own])
            stats.unreadable, stats.surplus = int(unreadable[rows].sum()), int(surplus[rows].sum())
            decoded.setdefault(number % EXPIRED_IDS, ChannelStats()).add(stats)
        return tables


def _kind_of(channel: Channel) -> tuple[Hashable, Channel, Codec]:
    codec = codec_for(channel)
    original = encoding_of(channel.message_encoding, channel.metadata)
    about = channel.has_publish_time, channel.is_indexed, codec.reason
    kind = channel.topic, channel.schema, channel.message_encoding, original, *about
    return kind, channel, codec


def _stamps_of(messages: Messages) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which of n messages have a header stamp, bool[n], and the stamps, int64[n]."""
    decoded, batch = messages.decoded, messages.placed.batch
    stamped, stamps = np.zeros(len(batch), np.bool_), np.zeros(len(batch), np.int64)
    if decoded is None:
        return stamped, stamps
    rows, found = decoded.rows, None
    if isinstance(decoded.records, Records):
        found = header_stamps(decoded.records)
    elif any(one.path == STAMP and one.type == "time" for one in messages.codec.paths()):
        rows, found = stamps_of(messages.codec, batch)
    if found is not None:
        stamped[rows], stamps[rows] = True, found
    return stamped, stamps


def stamp_stats(log_time: NDArray[np.int64], stamps: NDArray[np.int64]) -> ChannelStats:
    """Statistics of messages with a header stamp, which may be zero: not set.

    The sum of skews is exact.
    """
    known = stamps[stamps != 0]
    skew = log_time[stamps != 0] - known
    found = ChannelStats(
        stamped=len(stamps),
        unset=len(stamps) - len(skew),
        skew_sum=(int((skew >> 32).sum()) << 32) + int((skew & 0xFFFF_FFFF).sum()),
    )
    if len(skew):
        found.first_stamp, found.last_stamp = int(known.min()), int(known.max())
        found.skew_min, found.skew_max = int(skew.min()), int(skew.max())
    return found


_SEND_BYTES: Final = 8 << 20  # documents that are sent together, at most


class Sender:
    """Sends documents to the index.

    Attributes:
        database: The index.
        messages: Number of those whose documents it has sent.
        ended: Digests of segments all of whose documents were added, by number as text.
    """

    def __init__(self, key: str, database: Database) -> None:
        self.database = database
        self.messages = 0
        self._key = key
        self._collections: set[str] = set()  # that exist
        self._begin()

    def _begin(self) -> None:
        self._documents: defaultdict[str, list[NDArray[np.uint8]]] = defaultdict(list)
        self._size = self._added = 0
        self.ended: dict[str, str] = {}

    def add(self, documents: Iterable[tuple[str, NDArray[np.uint8]]], messages: int) -> None:
        """Add the documents of some messages, in tables of their topics; errors as of `send`."""
        for topic, table in documents:
            self._documents[topic].append(table)
            self._size += table.size
        self._added += messages
        if self._size >= _SEND_BYTES:
            self.send()

    def send(self) -> None:
        """Send what was added; HybridlogError if MongoDB fails."""
        if self._documents and not self._collections:
            # One command, where creating each would be one for each topic.
            self._collections.update(self.database.list_collections())
        for topic, tables in self._documents.items():
            name = collection_of(topic)
            if name not in self._collections:
                self.database.ensure_collection(name)
                self._collections.add(name)
            self.database.insert_raw(name, [row.tobytes() for table in tables for row in table])
        if self.ended:
            IndexState(self.database).put_segments(self._key, self.ended)
        self.messages += self._added
        self._begin()
