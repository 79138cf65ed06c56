"""A load from a log: any bag that hybridlog reads."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.loads.spool import Spool
from hybridlog.formats.detect import open_source
from hybridlog_storage.errors import SourceError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from benchmarks.loads.base import Load
    from hybridlog.formats.reading import Damage, Source


def from_log(path: Path, directory: Path, *, seconds: float | None = None) -> Load:
    """Make a load of a log: each message is due when it was recorded.

    Messages go in the order of their log times; of equal ones, that of the file counts.
    What of the log is damaged is left out, and told in the load.

    Args:
        path: A file or a directory.
        directory: Where the load goes; what lies there is replaced.
        seconds: Only so many from the start of the log; all when None.
    """
    if seconds is not None and not seconds > 0:
        raise UsageError(f"{seconds:g} s of a log are nothing; choose more than 0 s")
    with open_source(path) as source, Spool(directory) as spool:
        if not _copy(source, spool, seconds):
            lost = _damage(source.damage) or "it is empty"
            raise SourceError(f"{path}: no message can be read ({lost}); choose another log")
        return spool.finish(log_name(path), None, source.channels, seconds, _damage(source.damage))


def _damage(places: Sequence[Damage]) -> str:
    if not places:
        return ""
    rest = f", and {len(places) - 1} more" if len(places) > 1 else ""
    return f"{places[0].reason}{rest}"


def _copy(source: Source, spool: Spool, seconds: float | None) -> int:
    """Copy what may be within the first seconds; returns how many messages.

    Where the log starts is known for sure only when all is read. Until then a message
    is left out when it comes too late after the earliest one so far.
    """
    copied = 0
    earliest = np.iinfo(np.int64).max
    for batch in source.batches():
        if seconds is not None and len(batch):
            earliest = min(earliest, int(batch.log_time.min()))
            batch = batch.take(batch.log_time - earliest < round(seconds * 1e9))  # noqa: PLW2901
        payloads = map(batch.payload, range(len(batch)))
        spool.messages(batch.channel, payloads, batch.log_time)
        copied += len(batch)
    return copied


def log_name(path: Path) -> str:
    """The name of a log without its endings, safe for a directory and for a table."""
    name = re.sub(r"\.(bag|mcap|db3|zst|zstd|active)\b", "", path.resolve().name)
    return re.sub(r"[^A-Za-z0-9_.+-]", "_", name)[:60].strip(".") or "log"
