"""Slices: parts of a recording as files of their own, and those in the user's cache."""

from __future__ import annotations

import hashlib
import os
import pickle
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.formats import OUTPUTS
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.attachments import Extras
    from hybridlog.formats.answer import Answer
    from hybridlog.query.query import Query
    from hybridlog_storage.messages import Batch, Channel


@dataclass(frozen=True, slots=True)
class Front:
    """The choice of latched messages from before the time range, in MCAP and bag files.

    Attributes:
        latched: They are written.
        original_times: They keep their log time.
    """

    latched: bool = True
    original_times: bool = False


IN_FORCE: Final = Front()
"""The latched messages that are in force, at the beginning of the slice."""


def batches_of(query: Query, front: Front) -> Iterator[tuple[Batch, Sequence[Channel]]]:
    """The messages of a slice in the order of the file, many at once.

    Args:
        query: The query; its counters count the messages, those in front as `latched`.
        front: The latched messages in front of the answer.
    """
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
    from hybridlog.query.counters import Counters
    from hybridlog.query.planner import Planner

    question = query.question
    if not question.is_by_log_time:
        question = replace(question, bounds=None)
    parts = Planner(query.session, question, Counters()).parts()
    return int(sum(p.share * sum(s.payload_bytes for s in p.stats) for p in parts))


def profile_of(query: Query) -> str:
    """The MCAP profile of a slice: `ros1` or `ros2`, empty for others and for a mixture."""
    from hybridlog.query.counters import Counters
    from hybridlog.query.planner import Planner

    examples = Planner(query.session, query.question, Counters()).examples
    spoken = [channel for channel in examples if channel.stats.messages] or examples
    encodings = {channel.channel.message_encoding for channel in spoken}
    return {"ros1": "ros1", "cdr": "ros2"}.get(encodings.pop(), "") if len(encodings) == 1 else ""


def log_of(query: Query, front: Front = IN_FORCE, extras: Extras | None = None) -> Answer:
    """A slice as a log.

    Args:
        query: The slice.
        front: The latched messages in front of the answer.
        extras: What it has beside messages.
    """
    from hybridlog.formats.answer import Answer

    return Answer(batches=batches_of(query, front), extras=extras, profile=profile_of(query))


def write_mcap(query: Query, path: Path) -> None:
    """Write a slice as an MCAP file, as `hybridlog export` does; all of it or nothing."""
    from hybridlog.attachments import extras_of

    OUTPUTS["mcap"].write(log_of(query, extras=extras_of(query.session, query.question)), path)


MAX_BYTES: Final = 16 << 30
"""Bytes that the files may have together, by default."""

_NAME_DIGITS = 16
_NAME_LENGTH = 50  # characters; a file name has 255 bytes at most


class SliceCache:
    """MCAP files of slices. Several threads and processes may use the same directory.

    A file is the same, byte for byte, whenever it is written again for the same state of the
    recordings.

    Args:
        directory: Where they lie; without, `hybridlog/slices` in the user's cache.
        max_bytes: Bytes that they may have together. Those unused for longest are removed.
    """

    def __init__(self, directory: Path | None = None, *, max_bytes: int = MAX_BYTES) -> None:
        if directory is None:
            from hybridlog_storage.disk.files import user_directory

            directory = user_directory("XDG_CACHE_HOME", ".cache", "slices") / "slices"
        self._directory = directory
        self._max_bytes = max_bytes
        self._writing = threading.Lock()

    def get(self, query: Query, name: str, write: Callable[[Query, Path], None]) -> Path:
        """The file of a slice; written if there is none.

        Args:
            query: The slice.
            name: What the file is called, beside its digest.
            write: Writes it: all of it or nothing.

        Raises:
            UsageError: The slice is larger than all files may be together, or the directory
                cannot be used.
        """
        path = self._directory / f"{name[:_NAME_LENGTH]}-{fingerprint(query)[:_NAME_DIGITS]}.mcap"
        if not self._use(path):
            with self._writing:  # one at a time: they would compete for the disk
                if not self._use(path):
                    self._write(query, path, write)
        return path

    def _use(self, path: Path) -> bool:
        """Note that a file is used now; False if there is none."""
        try:
            os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
        except FileNotFoundError:
            return False
        return True

    def _write(self, query: Query, path: Path, write: Callable[[Query, Path], None]) -> None:
        size = payload_bytes(query)
        if size > self._max_bytes:
            raise UsageError(
                f"This slice has about {size / 1e9:.0f} GB, and at most "
                f"{self._max_bytes / 1e9:.0f} GB are kept: choose fewer topics or less time."
            )
        try:
            self._directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{self._directory} cannot be made: {error.strerror}.") from error
        self._make_room(size)
        write(query, path)

    def _make_room(self, size: int) -> None:
        """Remove the files that are unused for longest, until `size` bytes fit."""
        files = [(about.st_atime_ns, about.st_size, path) for path, about in self._files()]
        total = sum(length for _, length, _ in files) + size
        for _, length, path in sorted(files):
            if total <= self._max_bytes:
                break
            path.unlink(missing_ok=True)
            total -= length

    def _files(self) -> list[tuple[Path, os.stat_result]]:
        found = []
        for entry in os.scandir(self._directory):
            try:
                found.append((Path(entry.path), entry.stat(follow_symlinks=False)))
            except FileNotFoundError:
                continue  # another process has removed it
        return found
