"""Compares a sealed segment with its digest, and finds what is damaged if that differs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.walk import Walk

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from hybridlog_storage.segments.segment_reader import SegmentSummary


class SegmentCheck:
    """Checks one sealed segment; a context manager.

    Args:
        path: The file.
        digest: The one in the manifest; empty if it lists none.

    Raises:
        SegmentError: It cannot be opened.
    """

    def __init__(self, path: Path, digest: str = "") -> None:
        self._digest = digest
        self.summary: SegmentSummary | None = None
        """The segment's summary; None if it is damaged."""
        self._reader = SegmentReader(path, 0)
        self._problem = ""
        try:
            self.summary = self._reader.summary()
        except SegmentError as error:
            self._problem = str(error)

    def __enter__(self) -> Self:
        """Return this object."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self._reader.close()

    def problems(self, progress: Callable[[int], None] | None = None) -> Iterator[tuple[int, str]]:
        """Find all damage.

        Args:
            progress: Called with the number of bytes read so far.

        Yields:
            Byte and description, in file order; a damaged summary comes first.
        """
        if self.summary is None:
            yield max(self._reader.size - 1, 0), self._problem
            walk = Walk(self._reader)
            walk.go_on()
            yield from ((one.offset, one.reason) for one in walk.damaged)
            return
        digest = self._reader.digest(progress)
        if digest == self._digest:
            return
        found = [*self._unreadable(self.summary)]
        yield from sorted(found)
        if self._digest and not found:
            yield 0, "it is not the file that the manifest lists: their digests differ"

    def _unreadable(self, summary: SegmentSummary) -> Iterator[tuple[int, str]]:
        """Chunks, attachments and metadata records that are lost."""
        for place in summary.chunks:
            try:
                self._reader.read_chunk(place)
            except SegmentError as error:
                yield place.offset, f"chunk {place.number}: {error}"
        for attachment in summary.attachments:
            try:
                self._reader.attachment(attachment)
            except SegmentError as error:
                yield attachment.offset, str(error)
        for record in summary.metadata:
            try:
                self._reader.metadata(record)
            except SegmentError as error:
                yield record.offset, str(error)
