"""Makes index documents from chunks, as a pure function.

`documents_of` makes the index disposable: it needs only chunks and their channels.
`record`, recovery, `index rebuild` and `verify` all call it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.schema.codec import Codec, stamps_of
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.column import STAMP
from hybridlog.schema.index_bodies import bodies_of
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.messages import EXPIRED_IDS, Channel
from hybridlog_storage.mongo.index_documents import DocumentAssembler
from hybridlog_storage.ordering import run_starts
from hybridlog_storage.segments.chunk import Placed, StoredChunk

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Documents(NamedTuple):
    """Index documents of one topic; tables are uint8[k, width], a whole BSON document a row."""

    topic: str
    tables: list[NDArray[np.uint8]]

    @property
    def size(self) -> int:
        """Bytes of all documents."""
        return sum(table.size for table in self.tables)


class ChunkIndexer:
    """Makes the index documents of the chunks of a recording, given by its id or key.

    Without `has_documents`, it makes only the results of decoding, for the catalog.
    """

    def __init__(self, recording: str, *, has_documents: bool = True) -> None:
        self._key = recording[-16:]
        self._has_documents = has_documents
        self._parts: dict[int, tuple[Codec, DocumentAssembler, bool]] = {}

    def documents_of(
        self,
        chunks: Sequence[StoredChunk],
        channels: Mapping[int, Channel],
        decoded: dict[int, ChannelStats],
    ) -> list[Documents]:
        """Make all index documents of some chunks; add the results of decoding, by channel.

        They equal those of each chunk alone. Several chunks of few messages take little longer
        than one.
        """
        placed = Placed.of(chunks)
        documents: list[Documents] = []
        for channel_id, rows in rows_by_channel(placed.batch.channel):
            channel = channels[channel_id]
            codec, assembler, stamped = self._part(channel_id, channel)
            is_indexed = channel.is_indexed and self._has_documents
            batch = placed.batch.take(rows)
            found = _Results(len(rows))
            tables: list[NDArray[np.uint8]] = []
            for group in bodies_of(codec, batch, found.surplus):
                found.unreadable[group.rows] = group.error is not None
                if group.stamps is not None:
                    found.stamped[group.rows] = True
                    found.stamps[group.rows] = group.stamps
                if is_indexed:
                    row = rows[group.rows]
                    tables.append(assembler.assemble(placed, row, group.body, group.error))
            if stamped:
                left = np.flatnonzero(~found.stamped)
                if len(left):
                    own, values = stamps_of(codec, batch.take(left))
                    found.stamped[left[own]] = True
                    found.stamps[left[own]] = values
            known = decoded.setdefault(channel_id % EXPIRED_IDS, ChannelStats())
            known.add(found.stats(batch.log_time))
            if tables:
                documents.append(Documents(channel.topic, tables))
        return documents

    def _part(self, channel_id: int, channel: Channel) -> tuple[Codec, DocumentAssembler, bool]:
        part = self._parts.get(channel_id)
        if part is None:
            codec = codec_for(channel)
            paths = codec.paths()
            stamped = any(one.path == STAMP and one.type == "time" for one in paths)
            assembler = DocumentAssembler(self._key, channel)
            part = self._parts[channel_id] = codec, assembler, stamped
        return part


def rows_by_channel(channel: NDArray[np.int32]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Channel ids in a chunk, ascending, and the rows of each, in chunk order."""
    if len(channel) and bool((channel == channel[0]).all()):
        yield int(channel[0]), np.arange(len(channel))  # chunks of large messages are small
        return
    order = np.argsort(channel, kind="stable")
    ids = channel[order]
    starts = run_starts(ids).tolist()
    for start, end in zip(starts, [*starts[1:], len(ids)], strict=True):
        yield int(ids[start]), order[start:end]


class _Results:
    """Results of decoding `messages` of one channel.

    Attributes:
        unreadable: bool[n], messages that cannot be read.
        surplus: bool[n], those with bytes left over.
        stamped: bool[n], those with a header stamp, which may be zero: not set.
        stamps: int64[n], the stamps.
    """

    def __init__(self, messages: int) -> None:
        self.unreadable, self.surplus, self.stamped = np.zeros((3, messages), np.bool_)
        self.stamps = np.zeros(messages, np.int64)

    def stats(self, log_time: NDArray[np.int64]) -> ChannelStats:
        """The results as statistics; the sum of skews is exact."""
        stamps = self.stamps[self.stamped]
        known = stamps[stamps != 0]
        skew = (log_time[self.stamped] - stamps)[stamps != 0]
        found = ChannelStats(
            unreadable=int(self.unreadable.sum()),
            surplus=int(self.surplus.sum()),
            stamped=len(stamps),
            unset=len(stamps) - len(skew),
            skew_sum=(int((skew >> 32).sum()) << 32) + int((skew & 0xFFFF_FFFF).sum()),
        )
        if len(skew):
            found.first_stamp, found.last_stamp = int(known.min()), int(known.max())
            found.skew_min, found.skew_max = int(skew.min()), int(skew.max())
        return found
