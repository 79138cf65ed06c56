"""Content of moved chunks, from the columns of their recording."""

from __future__ import annotations

import threading
from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from hybridlog_storage import journal
from hybridlog_storage.disk.directory import PAYLOADS
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from hybridlog.columns.payload_reader import PayloadReader
    from hybridlog_storage.journal import PayloadFile
    from hybridlog_storage.messages import Buffer


class RecordingPayloads:
    """The files of payloads of one recording. Thread safe.

    Nothing is read before it is needed.

    Args:
        recording: The recording's directory.
        listed: The files; None for those that its journal lists.
        folder: Name of the folder that holds them.
    """

    def __init__(
        self,
        recording: Path,
        listed: Sequence[PayloadFile] | None = None,
        folder: str = PAYLOADS,
    ) -> None:
        self._recording = recording
        self._given = listed
        self._folder = recording / folder
        self._readers: dict[str, PayloadReader] = {}
        self._places: dict[tuple[int, int], list[PayloadReader]] | None = None
        self._problem = ""  # of a file that cannot be read
        self._lock = threading.RLock()

    @lazy
    def listed(self) -> Sequence[PayloadFile]:
        """The files.

        Raises:
            StoreError: The journal cannot be read.
        """
        if self._given is not None:
            return self._given
        state = journal.read(self._recording)
        return [] if state is None else list(state.payloads.values())

    def reader(self, listed: PayloadFile) -> PayloadReader:
        """The reader of a file.

        Raises:
            StoreError: The file is missing or damaged.
        """
        with self._lock:
            found = self._readers.get(listed.file)
            if found is None:
                from hybridlog.columns.payload_reader import PayloadReader

                found = self._readers[listed.file] = PayloadReader(self._folder, listed)
            return found

    def ordered(self, topic: str) -> list[PayloadReader]:
        """The readers of a topic; none if rows of a file are in another order than of time.

        Raises:
            StoreError: A file is missing or damaged.
        """
        readers = [self.reader(file) for file in self.listed if file.topic == topic]
        return readers if all(reader.is_ordered for reader in readers) else []

    def __call__(self, segment: int, chunk: int, size: int) -> Buffer:
        """As `content`."""
        return self.content(segment, chunk, size)

    def content(self, segment: int, chunk: int, size: int) -> Buffer:
        """The uncompressed content of a chunk.

        Args:
            segment: Number of its segment.
            chunk: Its number there.
            size: Its bytes.

        Raises:
            SegmentError: Its messages are missing or damaged.
        """
        try:
            return self._content(segment, chunk, size)
        except SegmentError:
            raise
        except StoreError as error:
            raise SegmentError(str(error)) from error

    def _content(self, segment: int, chunk: int, size: int) -> Buffer:
        readers = self.having(segment, chunk)
        content = np.empty(size, np.uint8)
        filled = 0
        for reader in readers:
            place = reader.places[segment, chunk]
            rebuilt = reader.rebuilt(place.group)
            rows = slice(place.begin, place.begin + place.rows)
            starts, bounds = rebuilt.place[rows].tolist(), rebuilt.offset
            ends = bounds[place.begin + 1 : place.begin + place.rows + 1].tolist()
            for start, begin, end in zip(starts, bounds[rows].tolist(), ends, strict=True):
                if not 0 <= start <= size - (end - begin):
                    raise SegmentError("a message lies outside of its chunk")
                content[start : start + end - begin] = rebuilt.data[begin:end]
                filled += end - begin
        if filled != size:
            raise SegmentError(
                self._problem or f"{size - filled} bytes of its content are in no file of columns"
            )
        return content.data

    def having(self, segment: int, chunk: int) -> list[PayloadReader]:
        """The readers of files with messages of a chunk, but for damaged or missing files."""
        with self._lock:
            if self._places is None:
                places = defaultdict(list)
                for listed in self.listed:
                    try:
                        reader = self.reader(listed)
                    except StoreError as error:
                        self._problem = str(error)
                        continue
                    for key in reader.places:
                        places[key].append(reader)
                self._places = dict(places)
            return self._places.get((segment, chunk), [])


def open_segment(
    path: Path, number: int, contents: RecordingPayloads | None = None
) -> SegmentReader:
    """Open a sealed segment whose chunks may have been moved to columns.

    Args:
        path: The file, in its recording's directory.
        number: Its number.
        contents: Shared by the segments of a recording.

    Raises:
        SegmentError: It cannot be opened.
    """
    return SegmentReader(path, number, contents=contents or RecordingPayloads(path.parent))
