"""Makes index documents from chunks, as a pure function.

`documents_of` makes the index disposable: it needs only chunks and their channels.
`record`, recovery, `index rebuild` and `verify` all call it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.schema.codec import Codec, no_rows, stamps_of
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.column import STAMP
from hybridlog.schema.index_bodies import bodies_of
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.messages import Channel
from hybridlog_storage.mongo.index_documents import DocumentAssembler, Origin, Placed
from hybridlog_storage.ordering import run_starts
from hybridlog_storage.segments.chunk import StoredChunk

if TYPE_CHECKING:
    from numpy.typing import NDArray


Decoded = dict[int, ChannelStats]
"""Results of decoding, by channel."""


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
        self.recording = recording
        self._key = recording[-16:]
        self._has_documents = has_documents
        self._parts: dict[int, tuple[Codec, DocumentAssembler, bool]] = {}

    def documents_of(
        self, chunks: Sequence[StoredChunk], channels: Mapping[int, Channel]
    ) -> tuple[list[Documents], list[Decoded]]:
        """Make all index documents of some chunks, and the results of decoding each chunk.

        They equal those of each chunk alone. Several chunks of few messages take little longer
        than one.
        """
        placed = Placed.of(chunks)
        documents: list[Documents] = []
        decoded: list[Decoded] = [{} for _ in chunks]
        for channel_id, rows in rows_by_channel(placed.batch.channel):
            channel = channels[channel_id]
            codec, assembler, stamped = self._part(channel_id, channel)
            is_indexed = channel.is_indexed and self._has_documents
            batch = placed.batch.take(rows)
            found = _Results(placed.number[rows])
            tables: list[NDArray[np.uint8]] = []
            for group in bodies_of(codec, batch):
                if group.error is not None:
                    found.unreadable.append(group.rows)
                found.surplus.append(group.surplus)
                if group.stamps is not None:
                    found.stamped.append(group.rows)
                    found.stamps.append(group.stamps)
                if is_indexed:
                    row = rows[group.rows]
                    tables.append(assembler.assemble(placed, row, group.body, group.error))
            if stamped:
                left = np.setdiff1d(np.arange(len(batch)), np.concatenate(found.stamped))
                if len(left):
                    own, values = stamps_of(codec, batch.take(left))
                    found.stamped.append(left[own])
                    found.stamps.append(values)
            for place, of_chunk in found.by_chunk(batch.log_time):
                decoded[place][channel_id] = of_chunk
            if tables:
                documents.append(Documents(channel.topic, tables))
        return documents, decoded

    def reason(self, channel_id: int, channel: Channel) -> str | None:
        """Reason why a channel's fields are not indexed, None if they are."""
        return self._part(channel_id, channel)[0].reason

    def _part(self, channel_id: int, channel: Channel) -> tuple[Codec, DocumentAssembler, bool]:
        part = self._parts.get(channel_id)
        if part is None:
            codec = codec_for(channel)
            paths = codec.paths()
            stamped = any(one.path == STAMP and one.type == "time" for one in paths)
            origin = Origin(self._key, channel.topic, channel.has_publish_time)
            part = self._parts[channel_id] = codec, DocumentAssembler(origin), stamped
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
    """Results of decoding messages of one channel.

    Args:
        number: intp[n], index of each message's chunk; ascending.

    Attributes:
        unreadable: Rows of messages that cannot be read.
        surplus: Rows of those with bytes left over.
        stamped: Rows of those with a header stamp, which may be zero: not set.
        stamps: The stamps.
    """

    def __init__(self, number: NDArray[np.intp]) -> None:
        self._number = number
        self.unreadable = [no_rows()]
        self.surplus = [no_rows()]
        self.stamped = [no_rows()]
        self.stamps = [no_rows().astype(np.int64)]

    def by_chunk(self, log_time: NDArray[np.int64]) -> Iterator[tuple[int, ChannelStats]]:
        """The chunks with messages, and the results of each."""
        size = int(self._number[-1]) + 1
        rows, stamps = np.concatenate(self.stamped), np.concatenate(self.stamps)
        number, is_set = self._number[rows], stamps != 0
        skew = (log_time[rows] - stamps)[is_set]

        def count(of: NDArray[np.intp]) -> list[int]:
            return [*map(int, np.bincount(of, minlength=size))]

        counts = zip(
            count(self._number[np.concatenate(self.unreadable)]),
            count(self._number[np.concatenate(self.surplus)]),
            count(number),
            count(number[~is_set]),
            np.bincount(number[is_set], skew, size).tolist(),  # integers could overflow
            strict=True,
        )
        found = [
            ChannelStats(unreadable=a, surplus=b, stamped=c, unset=d, skew_sum=e)
            for a, b, c, d, e in counts
        ]
        for place, least, greatest in _bounds(number[is_set], stamps[is_set]):
            found[place].first_stamp, found[place].last_stamp = least, greatest
        for place, least, greatest in _bounds(number[is_set], skew):
            found[place].skew_min, found[place].skew_max = least, greatest
        for place in np.unique(self._number).tolist():
            yield place, found[place]


def _bounds(number: NDArray[np.intp], values: NDArray[np.int64]) -> Iterator[tuple[int, int, int]]:
    """Least and greatest value of each number."""
    if not len(number):
        return
    order = np.argsort(number, kind="stable")
    number, values = number[order], values[order]
    begins = run_starts(number)
    least, greatest = np.minimum.reduceat(values, begins), np.maximum.reduceat(values, begins)
    yield from zip(number[begins].tolist(), least.tolist(), greatest.tolist(), strict=True)
