"""Puts a segment without the content of some chunks in the place of the whole one.

It is another file, with another name, and every chunk of it is read and compared with the old
one. Only then the manifest lists it in the place of the old one, which is removed. A crash on
either side of that change leaves a file that the next opening removes.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import structs

from hybridlog.columns import payload_files
from hybridlog.columns.payload_files import open_segment
from hybridlog_storage.errors import HybridlogError, SegmentError
from hybridlog_storage.manifest import with_file
from hybridlog_storage.manifests import manifests_at
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.segments.segment_check import SegmentCheck
from hybridlog_storage.segments.segment_file import number_of, sealed_name
from hybridlog_storage.segments.segment_thinning import thin

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from pathlib import Path

    from hybridlog.columns.payload_files import RecordingPayloads
    from hybridlog_storage.manifest import File, Manifest
    from hybridlog_storage.messages import Buffer
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.segment_reader import (
        SegmentReader,
        SegmentSummary,
    )


def replace_chunks(
    path: Path,
    manifest: Manifest,
    reader: SegmentReader,
    summary: SegmentSummary,
    records: Mapping[int, Callable[[Buffer], bytes]],
    *,
    contents: RecordingPayloads,
    check: Callable[[Manifest], object],
) -> int:
    """Write a segment without the content of some chunks, prove it, and put it in place.

    Args:
        path: The recording's directory, locked by this process.
        manifest: Its manifest, which lists the files that what is left of them lies in.
        reader: The segment.
        summary: Its footer.
        records: As for `thin`.
        contents: Has what is left of them.
        check: Raises if they must not go any more.

    Returns:
        Bytes that became free.

    Raises:
        SegmentError: The new segment is not what it should be.
        DiskFullError: There is no room.
    """
    log = manifest.logs[reader.number]
    _, version = number_of(log.name) or (log.number, 0)
    target = path / sealed_name(log.number, version + 1)
    try:
        made = write_thinned(target, manifest, reader, summary, records, contents=contents)

        def how(now: Manifest) -> Manifest:
            check(now)
            topics = {*now.logs[log.number].expired, *made.expired}
            what = {"name": made.name, "bytes": made.bytes, "digest": made.digest}
            return with_file(now, log.number, expired=tuple(sorted(topics)), **what)

        now = manifests_at(path).change(path.name, how)
    except BaseException:
        with suppress(HybridlogError, OSError):  # the next opening does it
            now = manifests_at(path).read(path.name)
            payload_files.remove_replaced(path, [log.name, target.name], now)
        raise
    payload_files.remove_replaced(path, [log.name, target.name], now)
    return reader.size - made.bytes


def write_thinned(
    target: Path,
    manifest: Manifest,
    reader: SegmentReader,
    summary: SegmentSummary,
    records: Mapping[int, Callable[[Buffer], bytes]],
    *,
    contents: RecordingPayloads,
) -> File:
    """Write a segment without the content of some chunks, and prove it; its line of the manifest.

    Args:
        target: The new file.
        manifest: As of `replace_chunks`, as are the others.
        reader: The segment.
        summary: Its footer.
        records: As for `thin`.
        contents: Has what is left of them.

    Raises:
        SegmentError: The new segment is not what it should be.
        DiskFullError: There is no room.
    """
    log = manifest.logs[reader.number]
    about = {
        "digest": summary.content(log.digest),
        "files": [structs.asdict(file) for file in manifest.fields],
    }
    written = thin(reader, target, records, about)
    _prove(target, reader, summary, records, contents)
    topics = summary.topics_in(one for one in summary.chunks if one.number in records)
    return structs.replace(
        log,
        name=target.name,
        bytes=written.bytes,
        digest=written.digest,
        expired=tuple(sorted({*log.expired, *topics})),
    )


def _prove(
    target: Path,
    reader: SegmentReader,
    summary: SegmentSummary,
    changed: Collection[int],
    contents: RecordingPayloads,
) -> None:
    """Compare a new segment with the old one: every byte, every message.

    Raises:
        SegmentError: It differs.
    """
    with SegmentCheck(target) as check:
        problems = [problem for _, problem in check.problems()]
    with open_segment(target, reader.number, contents) as new:
        found = new.summary()
        is_same = (
            not problems
            and (found.recording, found.end, found.losses)
            == (summary.recording, summary.end, summary.losses)
            and _channels(found) == _channels(summary)
            and np.array_equal(found.table.as_stored().parts, summary.table.as_stored().parts)
            and len(found.chunks) == len(summary.chunks)
            and _expired(found) == {*changed} | _expired(summary)
            and _stretches(found)[: len(summary.table.others) - 1] == _stretches(summary)[:-1]
            and [len(part) for part in new.indexes()[1:]]
            == [len(part) for part in reader.indexes()[1:]]
            and all(
                there.crc == here.crc
                if here.is_expired
                else _is_same(new.read_chunk(there), reader.read_chunk(here))
                for there, here in zip(found.chunks, summary.chunks, strict=True)
            )
        )
    if not is_same:
        raise SegmentError(f"{target} is not what it should be: {problems or 'a chunk differs'}")


def _expired(summary: SegmentSummary) -> set[int]:
    """Numbers of expired chunks."""
    return {chunk.number for chunk in summary.chunks if chunk.is_expired}


def _channels(summary: SegmentSummary) -> dict[int, dict[str, Any]]:
    return {number: asdict(summary.channels[number]) for number in summary.schema_ids}


def _stretches(summary: SegmentSummary) -> list[tuple[int, int]]:
    """Length and checksum of all bytes between chunks."""
    return [(length, crc) for _, length, crc in summary.table.others.tolist()]


def _is_same(one: StoredChunk, other: StoredChunk) -> bool:
    """True if a chunk has the same messages; of expired ones the payloads are not there."""
    a, b = one.batch, other.batch
    columns = ("log_time", "publish_time", "sequence")
    is_there = one.fields is None
    return (
        not (is_there and memoryview(a.buffer).cast("B") != memoryview(b.buffer).cast("B"))
        and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in columns)
        and np.array_equal(a.channel % EXPIRED_IDS, b.channel % EXPIRED_IDS)
        and all(map(np.array_equal, a.places, b.places))
        and np.array_equal(one.seq, other.seq)
    )
