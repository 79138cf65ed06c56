"""A writer whose chunks a test sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hybridlog_storage.segments.chunk import PackedChunk, StoredChunk
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

    def _create(self, group: int | None) -> SegmentFile:
        segment = super()._create(group)

        def noted(own: Sequence[PackedChunk]) -> list[StoredChunk]:
            stored = SegmentFile.append_chunks(segment, own)
            self.chunks += stored
            return stored

        segment.append_chunks = noted  # type: ignore[method-assign]
        return segment
