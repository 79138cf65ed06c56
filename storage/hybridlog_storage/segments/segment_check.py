"""Compares a sealed segment with its digest, and finds what is damaged if that differs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.walk import Walk

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from hybridlog_storage.segments.segment_reader import SegmentSummary


class SegmentDamage(NamedTuple):
    """A damaged place of a segment; `offset` is the byte where it starts.

    `chunk` is the number of a chunk that cannot be read; None for something else.
    """

    offset: int
    problem: str
    chunk: int | None = None


def damage_of(
    path: Path, digest: str = "", progress: Callable[[int], None] | None = None
) -> tuple[list[SegmentDamage], bool]:
    """All damage in a sealed segment. Its chunks are read only if the digest differs.

    It is in file order, but for a damaged summary, which comes first; with it comes whether the
    summary is whole. `digest` is that of the manifest; empty if it lists none. `progress` is called
    with the number of bytes read so far.
    """
    with SegmentReader(path, 0) as reader:
        try:
            summary = reader.summary()
        except SegmentError as error:
            walk = Walk(reader)
            walk.go_on()
            damaged = [SegmentDamage(one.offset, one.reason) for one in walk.damaged]
            return [SegmentDamage(max(reader.size - 1, 0), str(error)), *damaged], False
        if reader.digest(progress) == digest:
            return [], True
        found = sorted(_unreadable(reader, summary))
    if digest and not found:
        problem = "it is not the file that the manifest lists: their digests differ"
        found = [SegmentDamage(0, problem)]
    return found, True


def _unreadable(reader: SegmentReader, summary: SegmentSummary) -> Iterator[SegmentDamage]:
    """Chunks, attachments and metadata records that are lost."""
    for place in summary.chunks:
        try:
            reader.read_chunk(place)
        except SegmentError as error:
            parts = summary.table.chunk_parts(place.number)[["channel", "messages"]].tolist()
            lost = [f"{summary.channels[channel].topic} {count}" for channel, count in parts]
            topics = ", ".join(lost[:5]) + (f" and {len(lost) - 5} more" if lost[5:] else "")
            problem = f"chunk {place.number} is lost (messages: {topics}): {error}"
            yield SegmentDamage(place.offset, problem, place.number)
    reads: list[tuple[Callable[[Any], object], list[Any]]] = [
        (reader.attachment, summary.attachments),
        (reader.metadata, summary.metadata),
    ]
    for read, record in ((read, record) for read, records in reads for record in records):
        try:
            read(record)
        except SegmentError as error:
            yield SegmentDamage(record.offset, str(error))
