"""Finds what is damaged in segments; recovers and seals those that a crash left open, in place.

The file is cut behind its last whole record. What is damaged before becomes a record that readers
skip. Then the summary is written, as the recorder would have done.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from msgspec import Struct, field

from hybridlog_storage.disk import files
from hybridlog_storage.disk.append_file import AppendFile
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.segments.segment_file import (
    OPEN_SUFFIX,
    Sealed,
    SegmentFile,
    sealed_name,
)
from hybridlog_storage.segments.segment_format import (
    START,
    damaged_head,
    group_of,
)
from hybridlog_storage.segments.segment_reader import SegmentReader, check_format
from hybridlog_storage.segments.walk import MENDED, Walk


class Recovered(Struct):
    """The result of recovering an open segment; `path` is None for an empty one, which is removed.

    `damage` says what was wrong before the last whole record.
    """

    path: Path | None
    messages: int = 0
    damage: list[str] = field(default_factory=list)


def recover_segment(
    path: Path,
    on_sealing: Callable[[Sealed, Recovered], object] = lambda *_: None,
    *,
    recording: Mapping[str, object] | None = None,
) -> Recovered:
    """Cut, complete and seal one open segment, `.mcap.open`, that has no writer.

    `on_sealing` is called when the segment is complete and on the disk, before it gets its final
    name. If it fails, the file stays, and this can be called again. `recording` is the catalog
    entry, for a segment whose own is damaged. A `StoreError` leaves the file unchanged, a
    `DiskFullError` all whole records.
    """
    number = int(path.name.removesuffix(OPEN_SUFFIX))
    final = path.with_name(sealed_name(number))
    with files.explained(path, "recovering"):
        with suppress(FileNotFoundError):
            files.status(final)
            raise StoreError(
                f"{final} is sealed, and {path} lies beside it. Move one of them out of the store."
            )
        with SegmentReader(path, number) as reader:
            walk = _walked(reader)
            damage = [f"byte {one.offset}: {one.reason}" for one in walk.damaged]
            if not (walk.recording or walk.table.chunks or walk.attachments or damage):
                files.unlink(path)
                files.sync_folder(path.parent)
                return Recovered(None)
            found = Recovered(final, sum(walk.table.build().counts().values()), damage)
            group = number
            if walk.recording is not None:
                check_format(walk.recording, path)
                group = group_of(walk.recording, number)
            file = AppendFile.reopen(path)
            segment = SegmentFile(path, number, file, group=group, content=walk)
            try:
                _mend(segment, walk, recording)
                on_sealing(segment.prepare(sync=True), found)
                segment.publish()
            finally:
                segment.abandon()
    return found


def _walked(reader: SegmentReader) -> Walk:
    walk = Walk(reader, reads=True)
    walk.go_on()
    return walk


def _damage(walk: Walk) -> dict[int, str]:
    """Reasons of damage by the byte where it starts, without what a recovery has mended."""
    return {one.offset: one.reason for one in walk.damaged if one.reason != MENDED}


def _mend(segment: SegmentFile, walk: Walk, recording: Mapping[str, object] | None) -> None:
    """Cut what is not whole, and let readers skip what is damaged."""
    if walk.recording is None and recording is None:
        raise SegmentError(
            f"{segment.path} was left open, and what it says of its recording is damaged. "
            "Move it out of the store, and see what is left with `mcap recover`."
        )
    segment.cut(walk.end)
    if walk.recording is None:
        segment.add_recording(recording or {})
    # Only now: what is damaged looks well behind this.
    if bytes(walk.reader.read(0, len(START))) != START:
        segment.rewrite(0, START)
    for one in walk.damaged:
        if one.offset < walk.end:
            segment.rewrite(one.offset, damaged_head(one.length))


def rebuild_summary(path: Path) -> bool:
    """Seal a segment again of which the summary alone is damaged; False if more is."""
    number = int(path.name.partition(".")[0])
    with SegmentReader(path, number) as reader:
        walk = _walked(reader)
    if _damage(walk) or walk.recording is None or not walk.is_complete:
        return False
    opened = path.with_name(f"{number:06d}{OPEN_SUFFIX}")
    with files.explained(path, "rebuilding"):
        files.rename(path, opened)
        files.sync_folder(path.parent)  # or a power cut leaves it cut, and sealed by its name
    recover_segment(opened)
    return True


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
    """All damage in a sealed segment; its records are read only if the digest differs.

    It is in file order, but for a damaged summary, which comes first; with it comes whether the
    summary is whole. `digest` is that of the manifest; empty if it lists none. `progress` is called
    with the number of bytes read so far.
    """
    with SegmentReader(path, 0) as reader:
        if reader.digest(progress) == digest:
            return [], True
        walk = Walk(reader, reads=True)
        try:
            summary = reader.summary()
        except SegmentError as error:
            walk.go_on()
            found = [SegmentDamage(*one) for one in _damage(walk).items()]
            return [SegmentDamage(max(reader.size - 1, 0), str(error)), *found], False
        walk.channels |= summary.channels
        walk.go_on()
    why, whole, found = _damage(walk), {*walk.table.build().chunks["offset"].tolist()}, []
    for place in summary.chunks:
        if place.offset not in whole:
            parts = summary.table.chunk_parts(place.number)[["channel", "messages"]].tolist()
            lost = ", ".join(f"{summary.channels[c].topic} {count}" for c, count in parts[:5])
            lost += ", ..." if parts[5:] else ""
            reason = why.pop(place.offset, "it cannot be read")
            problem = f"chunk {place.number} is lost (messages: {lost}): {reason}"
            found.append(SegmentDamage(place.offset, problem, place.number))
    found = sorted([*found, *(SegmentDamage(*one) for one in why.items())])
    if digest and not found:
        problem = "it is not the file that the manifest lists: their digests differ"
        found = [SegmentDamage(0, problem)]
    return found, True
