"""Deletes payloads of a recording to make room; fields, counts and times stay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Collection

    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.journal import Journal


@dataclass(slots=True)
class Expired:
    """What an expiry has deleted.

    Attributes:
        label: The recording.
        segments: Numbers of the segments that lost payloads.
        messages: Number of messages whose payloads went, by topic.
        freed: Bytes of the disk that became free, what was written subtracted.
        field_bytes: Bytes of the files of fields that were written.
    """

    label: str
    segments: list[int]
    messages: dict[str, int]
    freed: int = 0
    field_bytes: int = 0


def expire(
    directory: StoreDirectory,
    label: str,
    segments: Collection[int],
    topics: Collection[str] | None = None,
    *,
    log: Journal | None = None,
    progress: Progress | None = None,
) -> Expired:
    """Delete payloads in sealed segments of a recording that this process has locked.

    Expired payloads do not expire again: what is gone already is left out.

    Args:
        directory: The store.
        label: The recording; it may be running, then it is the caller who records it.
        segments: Numbers of sealed segments.
        topics: Full names of the topics whose payloads go; None for all. Messages of other
            topics in the same chunk keep theirs, and so the chunk stays.
        log: The journal of a running recording, which its recorder appends to; None to open it.
        progress: Called after each chunk.

    Raises:
        StoreError: Files cannot be read or written; what was not announced is as before.
        DiskFullError: There is no room for the fields; nothing is deleted.
    """
    raise StoreError("Payloads cannot expire yet.")
