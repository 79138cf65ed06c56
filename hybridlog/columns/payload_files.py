"""The folders of a recording that hold files of payloads."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from hybridlog.columns.layout import IN_PAYLOADS, PAYLOAD_PARTS
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import PAYLOADS, payload_names
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.segments.segment_file import sealed_name
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from hybridlog_storage.journal import PayloadFile

THINNED: Final = re.compile(r"(?P<number>\d{6,9})\.mcap\.thinned")
"""Name of a segment that is about to replace the whole one."""


def publish(recording: Path, listed: Mapping[str, PayloadFile]) -> None:
    """Give finished files their names, and remove the folder of unfinished files.

    Args:
        recording: The recording's directory, locked by this process.
        listed: The files that the journal lists.

    Raises:
        HybridlogError: A file cannot be renamed or removed.
    """
    parts, final = recording / PAYLOAD_PARTS, recording / PAYLOADS
    try:
        names = sorted(payload_names(recording, PAYLOAD_PARTS))
        moved = [name for name in names if name in listed]
        folders = {(final / name).parent for name in moved}
        for folder in folders:
            files.make_folders(folder, depth=IN_PAYLOADS - 1)
        if moved:  # folders are on the disk before anything moves into them
            files.sync_folder(recording)
            files.sync_folder(final, depth=files.IN_RECORDING)
        for name in moved:
            files.rename(parts / name, final / name, depth=IN_PAYLOADS, new_depth=IN_PAYLOADS)
        for folder in folders:
            files.sync_folder(folder, depth=IN_PAYLOADS - 1)
        files.remove_tree(parts, depth=files.IN_RECORDING)
    except OSError as error:
        raise durability.explain(error, final, "moving payloads to") from error


def replace_segments(
    recording: Path, names: Iterable[str], thinned: Mapping[int, Sequence[tuple[str, int]]]
) -> list[str]:
    """Put finished segments without moved chunks in the place of the whole ones.

    Those that the journal does not list are removed.

    Args:
        recording: The recording's directory, locked by this process.
        names: Names of files in it.
        thinned: Digest and size of such segments as the journal lists them, by number.

    Returns:
        Names of the segments that were replaced.

    Raises:
        HybridlogError: A file cannot be renamed or removed.
    """
    done = []
    try:
        for name in names:
            found = THINNED.fullmatch(name)
            if found is None:
                continue
            number = int(found["number"])
            if _is_listed(recording / name, number, thinned.get(number, ())):
                final = sealed_name(number)
                files.rename(recording / name, recording / final)
                done.append(final)
            else:
                files.unlink(recording / name)
        if done:
            files.sync_folder(recording)
    except OSError as error:
        raise durability.explain(error, recording, "replacing segments of") from error
    return done


def _is_listed(path: Path, number: int, listed: Sequence[tuple[str, int]]) -> bool:
    if not listed:
        return False
    try:
        with SegmentReader(path, number) as reader:
            summary = reader.summary()
    except SegmentError:
        return False
    return (summary.digest, summary.size) == listed[-1]
