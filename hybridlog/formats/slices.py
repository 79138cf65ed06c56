"""Slices: parts of a recording as files of their own, and those in the user's cache."""

from __future__ import annotations

import hashlib
import os
import pickle
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from hybridlog.attachments import extras_of
from hybridlog.formats import OUTPUTS
from hybridlog.formats.answer import Answer
from hybridlog.query.planner import Planner
from hybridlog_storage.disk.files import user_directory
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.attachments import Extras
    from hybridlog.query.query import Query
    from hybridlog_storage.messages import Batch, Channel


@dataclass(frozen=True, slots=True)
class Front:
    """Latched messages from before the time range, and whether these keep their log time."""

    latched: bool = True
    original_times: bool = False


IN_FORCE: Final = Front()
"""The latched messages that are in force, at the beginning of the slice."""


def batches_of(query: Query, front: Front) -> Iterator[tuple[Batch, Sequence[Channel]]]:
    """The messages of a slice in the order of the file, many at once."""
    before = copy(query)
    if front.latched:
        for batch, channels in before.latched(original_times=front.original_times):
            yield batch, [c.channel for c in channels]
    for batch, channels in query.batches():
        yield batch, [c.channel for c in channels]
    query.counters.add(before.counters)


def fingerprint(query: Query) -> str:
    """A digest of a question and of the state of its recordings, in hexadecimal digits.

    As long as it is the same, so is the answer.
    """
    states = [(o.id, o.look, o.status, o.messages, o.extent) for o in query.summaries()]
    return hashlib.sha256(pickle.dumps((query.question, states), protocol=5)).hexdigest()


def payload_bytes(query: Query) -> int:
    """Bytes of payload of a slice, about."""
    question = query.question
    if not question.is_by_log_time:
        question = replace(question, bounds=None)
    parts = Planner(query.session, question).split()
    return int(sum(p.share * sum(s.payload_bytes for s in p.stats) for p in parts))


def profile_of(query: Query) -> str:
    """The MCAP profile of a slice: `ros1` or `ros2`, empty for others and for a mixture."""
    examples = Planner(query.session, query.question).examples
    spoken = [channel for channel in examples if channel.stats.messages] or examples
    encodings = {channel.channel.message_encoding for channel in spoken}
    return {"ros1": "ros1", "cdr": "ros2"}.get(encodings.pop(), "") if len(encodings) == 1 else ""


def log_of(query: Query, front: Front = IN_FORCE, extras: Extras | None = None) -> Answer:
    """A slice as a log."""
    return Answer(batches=batches_of(query, front), extras=extras, profile=profile_of(query))


def write_mcap(query: Query, path: Path) -> None:
    """Write a slice as an MCAP file, as `hybridlog export` does; all of it or nothing."""
    OUTPUTS["mcap"].write(log_of(query, extras=extras_of(query.session, query.question)), path)


MAX_BYTES: Final = 16 << 30
"""Bytes that the files in the cache may have together."""

_NAME_DIGITS = 16
_NAME_LENGTH = 50  # characters; a file name has 255 bytes at most
_writing = threading.Lock()  # one at a time: they would compete for the disk


def cached_slice(query: Query, name: str, write: Callable[[Query, Path], None]) -> Path:
    """The MCAP file of a slice in `hybridlog/slices` of the user's cache.

    It is written, all or nothing, if there is none; those that are unused for longest make room for
    it. A file is the same, byte for byte, whenever it is written again for the same state of the
    recordings. Several threads and processes may use the same directory. A slice larger than all
    files may be together raises UsageError. The file is called `name`, and its digest.
    """
    directory = user_directory("XDG_CACHE_HOME", ".cache", "slices") / "slices"
    path = directory / f"{name[:_NAME_LENGTH]}-{fingerprint(query)[:_NAME_DIGITS]}.mcap"
    if not _use(path):
        with _writing:
            if not _use(path):
                _make_room(directory, payload_bytes(query))
                write(query, path)
    return path


def _use(path: Path) -> bool:
    """Note that a file is used now; False if there is none."""
    try:
        os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
    except FileNotFoundError:
        return False
    return True


def _make_room(directory: Path, size: int) -> None:
    """Remove the files that are unused for longest, until `size` bytes fit."""
    if size > MAX_BYTES:
        raise UsageError(
            f"This slice has about {size / 1e9:.0f} GB, and at most {MAX_BYTES / 1e9:.0f} GB are "
            "kept: choose fewer topics or less time."
        )
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{directory} cannot be made: {error.strerror}.") from error
    files = []
    for path in directory.iterdir():
        with suppress(FileNotFoundError):  # another process has removed it
            about = path.lstat()
            files.append((about.st_atime_ns, about.st_size, path))
    total = sum(length for _, length, _ in files) + size
    for _, length, path in sorted(files):
        if total <= MAX_BYTES:
            break
        path.unlink(missing_ok=True)
        total -= length
