"""Content of moved chunks, from the columns of their recording."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from hybridlog_storage.segment_reader import SegmentReader

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.payloads.reader import RecordingPayloads
    from hybridlog_storage.messages import Buffer


class MovedContents:
    """Returns the content of moved chunks of one recording. Thread safe.

    Nothing is read before the first one is asked for.

    Args:
        recording: The recording's directory.
    """

    def __init__(self, recording: Path) -> None:
        self._recording = recording
        self._payloads: RecordingPayloads | None = None
        self._lock = threading.Lock()

    def __call__(self, segment: int, chunk: int, size: int) -> Buffer:
        """The uncompressed content of a chunk.

        Raises:
            SegmentError: It is missing or damaged.
        """
        return self.payloads().content(segment, chunk, size)

    def payloads(self) -> RecordingPayloads:
        """The files of columns of the recording.

        Raises:
            StoreError: The journal cannot be read.
        """
        with self._lock:
            if self._payloads is None:
                from hybridlog.payloads.reader import RecordingPayloads

                self._payloads = RecordingPayloads.of(self._recording)
            return self._payloads


def open_segment(path: Path, number: int, contents: MovedContents | None = None) -> SegmentReader:
    """Open a sealed segment whose chunks may have been moved to columns.

    Args:
        path: The file, in its recording's directory.
        number: Its number.
        contents: Shared by the segments of a recording.

    Raises:
        SegmentError: It cannot be opened.
    """
    return SegmentReader(path, number, contents=contents or MovedContents(path.parent))
