"""Compares a sealed segment with its digest, and finds what is damaged if that differs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.walk import Walk

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from hybridlog_storage.segments.segment_reader import SegmentSummary


def damage_of(
    path: Path, digest: str = "", progress: Callable[[int], None] | None = None
) -> tuple[list[tuple[int, str]], bool]:
    """All damage in a sealed segment.

    Args:
        path: The file.
        digest: The one in the manifest; empty if it lists none.
        progress: Called with the number of bytes read so far.

    Returns:
        Byte and description of each, in file order, but for a damaged summary, which comes
        first; and whether the summary is whole.

    Raises:
        SegmentError: It cannot be read.
    """
    with SegmentReader(path, 0) as reader:
        try:
            summary = reader.summary()
        except SegmentError as error:
            walk = Walk(reader)
            walk.go_on()
            damaged = [(one.offset, one.reason) for one in walk.damaged]
            return [(max(reader.size - 1, 0), str(error)), *damaged], False
        if reader.digest(progress) == digest:
            return [], True
        found = sorted(_unreadable(reader, summary))
    if digest and not found:
        found = [(0, "it is not the file that the manifest lists: their digests differ")]
    return found, True


def _unreadable(reader: SegmentReader, summary: SegmentSummary) -> Iterator[tuple[int, str]]:
    """Chunks, attachments and metadata records that are lost."""
    for place in summary.chunks:
        try:
            reader.read_chunk(place)
        except SegmentError as error:
            yield place.offset, f"chunk {place.number}: {error}"
    for attachment in summary.attachments:
        try:
            reader.attachment(attachment)
        except SegmentError as error:
            yield attachment.offset, str(error)
    for record in summary.metadata:
        try:
            reader.metadata(record)
        except SegmentError as error:
            yield record.offset, str(error)
