"""A writer whose chunks a test sees."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hybridlog_storage.segments.chunk import PackedChunk, StoredChunk
from hybridlog_storage.segments.open_chunk import OpenChunk
from hybridlog_storage.segments.segment_file import SegmentFile
from hybridlog_storage.segments.segment_writer import RecordingWriter


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

    def _create(self, group: int | None) -> SegmentFile:
        segment = super()._create(group)

        def noted(packed: PackedChunk) -> None:
            SegmentFile.append_chunk(segment, packed)
            rows = segment.table.build().chunks[["offset", "length", "trailer"]].tolist()
            offset, length, trailer = rows[-1]
            batch, seq = self._held.pop(id(packed))[1].laid_out()
            place = {"offset": offset, "length": length, "trailer": trailer}
            about = {"segment": segment.number, "number": len(rows) - 1}
            self.chunks.append(StoredChunk(**about, **place, batch=batch, seq=seq))

        segment.append_chunk = noted  # type: ignore[method-assign]
        return segment
