"""A writer whose chunks a test sees."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hybridlog_storage.segments.chunk import OpenChunk, PackedChunk, StoredChunk
from hybridlog_storage.segments.chunk_table import places_of
from hybridlog_storage.segments.segment_file import SegmentFile
from hybridlog_storage.segments.segment_writer import Key, RecordingWriter


class NotingWriter(RecordingWriter):
    """Puts the chunks that are in a file into a list."""

    def __init__(
        self,
        directory: Path,
        recording: Mapping[str, Any],
        chunks: list[StoredChunk],
        *args: Any,
        **options: Any,
    ) -> None:
        super().__init__(directory, recording, *args, **options)
        self.chunks = chunks
        self._held: dict[int, tuple[PackedChunk, OpenChunk]] = {}

    def _pack(self, chunk: OpenChunk) -> PackedChunk:
        packed = super()._pack(chunk)
        self._held[id(packed)] = packed, chunk
        return packed

    def _create(self, key: Key, group: int | None) -> SegmentFile:
        segment = super()._create(key, group)

        def noted(packed: PackedChunk) -> None:
            SegmentFile.append_chunk(segment, packed)
            place = places_of(segment.content.table.build())[-1]
            batch, seq = self._held.pop(id(packed))[1].laid_out()
            self.chunks.append(StoredChunk(segment.number, place, batch, seq))

        segment.append_chunk = noted  # type: ignore[method-assign]
        return segment
