"""Reads a segment while another process writes it.

What the writer has not finished yet is left out. The chunks become rows of a `ChunkTable`, as
those of a sealed segment are.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import CHUNK_HEAD
from hybridlog_storage.segments.chunk_table import ChunkTable, TableBuilder
from hybridlog_storage.segments.segment_file import OPEN_SUFFIX, sealed_name
from hybridlog_storage.segments.segment_format import OUR_NAMES, START
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.walk import Walk

if TYPE_CHECKING:
    from mcap.records import AttachmentIndex, MetadataIndex

    from hybridlog_storage.mcap.mcap_content import Damage
    from hybridlog_storage.messages import Channel

_WRITING_S: Final = 0.02  # the time that a writer may take for the rest of a record
_LOOKS: Final = 5  # at what seems damaged, before it counts as damaged


class Flushed(NamedTuple):
    """Content of a segment at one moment, as the summary of a sealed one says it.

    Attachments and metadata are those of the source, in file order.
    """

    table: ChunkTable
    attachments: Sequence[AttachmentIndex]
    metadata: Sequence[MetadataIndex]
    reader: SegmentReader


class OpenSegment:
    """The content that a segment has at this moment; it may be sealed meanwhile."""

    def __init__(self, recording: Path, number: int) -> None:
        self.number = number
        try:
            self.reader = SegmentReader(recording / f"{number:06d}{OPEN_SUFFIX}", number)
        except SegmentError:  # it may have been sealed just now
            self.reader = SegmentReader(recording / sealed_name(number), number)
        self._begin()

    def _begin(self) -> None:
        self._walk = Walk(self.reader)
        self._table = TableBuilder()
        self._last = b""  # head of the last chunk
        self._flushed: Flushed | None = None

    @property
    def channels(self) -> dict[int, Channel]:
        """Channels by id, as far as they are defined."""
        return {number: channel for number, (_, channel) in self._walk.channels.items()}

    @property
    def losses(self) -> list[dict[str, Any]]:
        """Rows of the loss ledger written so far."""
        return self._walk.losses

    @property
    def damaged(self) -> list[Damage]:
        """Parts that cannot be read, in file order."""
        return self._walk.damaged

    @property
    def end(self) -> int:
        """Byte of the file up to which it has been read."""
        return self._walk.end

    @property
    def flushed(self) -> Flushed:
        """Its content so far."""
        if self._flushed is not None:
            return self._flushed
        walk = self._walk
        for chunk in walk.chunks[self._table.chunks :]:
            parts = chunk.parts
            times = int(parts["first"].min()), int(parts["last"].max())
            self._table.chunk((chunk.offset, chunk.head.length, chunk.trailer), times, parts)
        table = self._table.build(is_flushed=True)
        metadata = [one for one in walk.metadata if not one.name.startswith(OUR_NAMES)]
        self._flushed = Flushed(table, tuple(walk.attachments), metadata, self.reader)
        return self._flushed

    def follow(self) -> bool:
        """Read what was flushed since, also if it was sealed meanwhile; True if there is anything.

        A read beside a write may see a part of it, and zeros in place of the rest. So what seems
        damaged is looked at again, and counts only if it is still the same.
        """
        is_cut = self.is_cut()
        if is_cut:
            self._begin()
        before = self.end, self.damaged
        known = self.damaged
        self._read_on()
        for _ in range(_LOOKS):
            seen = self.damaged
            if seen == known:
                break
            time.sleep(_WRITING_S)
            self._begin()
            self._read_on()
            if self.damaged == seen:
                break
        return is_cut or (self.end, self.damaged) != before

    def is_cut(self) -> bool:
        """True if the writer took chunks back that were read, on a full disk."""
        self.reader.grow()
        if self.reader.size < self.end:
            return self.end > len(START)
        return bool(self._walk.chunks) and self._head_of_last() != self._last

    def _head_of_last(self) -> bytes:
        return bytes(self.reader.read(self._walk.chunks[-1].offset, CHUNK_HEAD.size))

    def _read_on(self) -> None:
        self.reader.grow()
        size, end, known = self.reader.size, self.end, len(self._walk.chunks)
        try:
            self._walk.go_on()
        except SegmentError:  # the writer has just cut the padding behind its last block
            self.reader.grow()
            if self.reader.size >= size:
                raise
            self._walk.go_on()
        if self.end != end:
            self._flushed = None
        if len(self._walk.chunks) > known:
            self._last = self._head_of_last()
