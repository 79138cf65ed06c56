"""The interface of a reader of foreign logs: batches in file order, and damage.

A damaged file does not stop a source: it yields the readable messages and describes every
damaged place, so that the consumer can store the messages and report the damage. Only a
file of which nothing can be read raises `SourceError`, when the source is opened.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import tempfile
from abc import ABC, abstractmethod
from contextlib import contextmanager
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import IO, TYPE_CHECKING, BinaryIO, NamedTuple, Self

import numpy as np
import zstandard
from msgspec import Struct
from msgspec.structs import force_setattr, replace

from hybridlog_storage.disk.files import undone
from hybridlog_storage.errors import NO_SPACE, SourceError
from hybridlog_storage.messages import MAX_CHANNELS, Batch, Channel

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from mcap.records import Metadata

    from hybridlog_storage.segments.segment_format import Attachment


BATCH_BYTES = 2 << 20
"""Payload bytes at which a source closes a batch; a single payload may exceed it."""

BATCH_MESSAGES = 16384
"""Most messages of one batch."""

MAX_PLACES = 10_000
"""Damaged places of a file that are reported one by one."""


_TOO_MUCH = 1 << 63  # limit of BSON integers and of file sizes


class Damage(Struct, frozen=True):
    """One place of a file that could not be read.

    Attributes:
        file: The file.
        offset: Byte in the file where the place starts, None if unknown.
        length: Bytes from `offset` on that could not be read, None if unknown.
        reason: Description of the damage.
        messages_lost: Number of messages in it, None if unknown.

    A damaged file can claim numbers of more than 64 bits. They become None, because the
    loss ledger is stored in the database.
    """

    file: Path
    offset: int | None
    length: int | None
    reason: str
    messages_lost: int | None

    def __post_init__(self) -> None:
        """Replace impossible numbers by None."""
        for name in ("offset", "length", "messages_lost"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < _TOO_MUCH:
                force_setattr(self, name, None)


class Source(ABC):
    """A foreign log. A context manager; its batches can be read once.

    Attributes:
        path: The opened file, or the directory of a split log.
        kind: `ROS 1 bag`, `ROS 2 bag (sqlite3)`, `ROS 2 bag (mcap)` or `MCAP`.
        profile: MCAP profile of the messages: `ros1`, `ros2`, or empty.
        files: The files that hold messages, in reading order.
        size_bytes: Sum of the sizes of `files`.
        channels: Channels found so far; `Batch.channel` indexes it. It only grows, and holds
            every channel of a batch before that batch is yielded. After the last batch it
            holds the channels without messages, too.
        damage: Damaged places found so far. It only grows.
        remarks: What is odd, where nothing is damaged or lost.
        extras: Metadata and attachments found so far (MCAP only). The consumer removes them
            as it stores them. Attachments can still be read when the source is closed.
        message_count: Number of messages as stated by the log, None if it states none.
        time_range: Log time `[start, end)`, ns, by the log's own index, None without an index
            or without messages.
        bytes_read: Bytes read of `size_bytes`, for progress.
    """

    def __init__(self, path: Path, *, kind: str, profile: str, files: Sequence[Path]) -> None:
        self.path = path
        self.kind = kind
        self.profile = profile
        self.files: list[Path] = list(files)
        self.size_bytes: int = sum(size_of(file) for file in self.files)
        self.channels: list[Channel] = []
        self.damage: list[Damage] = []
        self.remarks: list[str] = []
        self.extras: list[Metadata | Attachment] = []
        self.message_count: int | None = None
        self.time_range: tuple[int, int] | None = None
        self.bytes_read: int = 0

    def add_channel(self, channel: Channel) -> int:
        """Add a channel; its index in `channels`. SourceError if no recording can hold it."""
        if len(self.channels) >= MAX_CHANNELS:
            raise SourceError(
                f"{self.path}: it has more than {MAX_CHANNELS} channels, the most of a recording; "
                "split it"
            )
        self.channels.append(channel)
        return len(self.channels) - 1

    def note(self, damage: Damage) -> None:
        """Add a damaged place; above `MAX_PLACES`, the last row is for all further ones."""
        if len(self.damage) <= MAX_PLACES:
            self.damage.append(damage)
            return
        before, lost = self.damage[-1].messages_lost, damage.messages_lost
        lost = None if before is None or lost is None else before + lost
        self.damage[-1] = Damage(damage.file, None, None, "more places could not be read", lost)

    def settle(self, listed: int, got: int, file: Path | None = None) -> None:
        """Tell how many messages are missing of those that a file lists; None for all files.

        They are of the damaged place whose number is unknown, if it is a single one.
        """
        rows = range(len(self.damage))
        missing = listed - got - sum(self.damage[row].messages_lost or 0 for row in rows)
        if missing < 0:
            return
        unknown = [row for row in rows if self.damage[row].messages_lost is None]
        for row in unknown:
            lost = missing if len(unknown) == 1 else 0
            self.damage[row] = replace(self.damage[row], messages_lost=lost)
        if missing and len(unknown) != 1:
            reason = f"the log lists {listed} messages, {got} are there"
            self.note(Damage(file or self.path, None, None, reason, missing))

    @abstractmethod
    def batches(self) -> Iterator[Batch]:
        """Yield all readable messages once, in file order, in bounded memory.

        A batch may have any size; its buffer stays valid after the source is closed. A file that
        cannot be read any more raises SourceError.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the files. May be called more than once."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def size_of(file: Path) -> int:
    """Size of a file in bytes."""
    try:
        return file.stat().st_size
    except OSError as error:
        raise cannot_open(file, error) from error


def cannot_open(path: Path, error: OSError) -> SourceError:
    """The error for a path that cannot be opened, with the cure."""
    if isinstance(error, FileNotFoundError):
        return SourceError(f"{path}: no such file or directory; check the spelling of the path")
    if isinstance(error, PermissionError):
        return SourceError(
            f"{path}: permission denied; make it readable for this user (chmod u+r) "
            "or run as its owner"
        )
    return SourceError(
        f"{path}: cannot be read ({error.strerror or error}); check the disk, or copy the "
        "file to another one and use the copy"
    )


def split(batch: Batch) -> Iterator[Batch]:
    """Split a batch into parts over the same buffer, each closed once it has `BATCH_BYTES`."""
    ends = np.cumsum(batch.length)
    row = before = 0
    while row < len(batch):
        full = int(np.searchsorted(ends, before + BATCH_BYTES)) + 1
        stop = min(full, row + BATCH_MESSAGES, len(batch))
        yield batch.take(slice(row, stop))
        row, before = stop, int(ends[stop - 1])


WHOLE = 4 << 20
"""Largest file that is read whole, bytes."""

SAMPLES = 256
SAMPLE_BYTES = 16 << 10


class Fingerprint(NamedTuple):
    """The fingerprint of a log.

    Attributes:
        whole: Of all its files in their order, 32 hexadecimal digits.
        parts: Of each file, as if it were a log of its own.
    """

    whole: str
    parts: tuple[str, ...]


def fingerprint(files: Sequence[Path]) -> Fingerprint:
    """Compute the fingerprint of files in their order; their names do not matter.

    That of a file covers its size and its whole content up to `WHOLE` bytes. Larger files are
    covered by `SAMPLES` evenly spaced samples, the first at the start and the last at the end.
    That of several files covers those of each.
    """
    parts = []
    for path in files:
        part = blake2b(digest_size=16)
        try:
            with path.open("rb", buffering=SAMPLE_BYTES) as file:
                size = file.seek(0, 2)
                part.update(size.to_bytes(8, "little"))
                last, count = size - SAMPLE_BYTES, SAMPLE_BYTES
                starts = [last * number // (SAMPLES - 1) for number in range(SAMPLES)]
                if size <= WHOLE:
                    starts, count = [0], size
                for start in starts:
                    file.seek(start)
                    part.update(file.read(count))
        except OSError as error:
            raise cannot_open(path, error) from error
        parts.append(part.hexdigest())
    whole = (
        parts[0]
        if len(parts) == 1
        else blake2b("".join(parts).encode(), digest_size=16).hexdigest()
    )
    return Fingerprint(whole, tuple(parts))


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

_PIECE = 1 << 20
_MIN_FREE_BYTES = 64 << 20
# Frames that need more memory than this are refused (as zstd's `--long=27`).
_MAX_WINDOW = 1 << 27


def peek(path: Path, count: int) -> bytes:
    """The first unpacked bytes of a zstd file, fewer if it is damaged."""
    try:
        with path.open("rb") as file:
            data = file.read(1 << 17)
    except OSError as error:
        raise cannot_open(path, error) from error
    try:
        unpacker = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
        with unpacker.stream_reader(data) as reader:
            return reader.read(count)
    except zstandard.ZstdError:
        return b""


def spool(path: Path) -> tuple[Path, str | None]:
    """Unpack the intact part of a zstd file to a temporary one; also why that is cut, if it is.

    Its name can be removed once it is open.
    """
    with _temporary(path) as (made, source, target, room):
        return made, _unpack(source, target, room)


def copy_start(path: Path, count: int) -> Path:
    """Copy the first `count` bytes of a file to a temporary one."""
    with _temporary(path, count) as (made, source, target, _):
        shutil.copyfileobj(source, target)
        target.truncate(count)
    return made


@contextmanager
def _temporary(path: Path, size: int = 0) -> Iterator[tuple[Path, BinaryIO, IO[bytes], int]]:
    """A file, and a new temporary one for so many bytes, at least, of its content.

    The last value is the room for it, bytes.
    """
    folder = Path(tempfile.gettempdir())
    room = shutil.disk_usage(folder).free - _MIN_FREE_BYTES
    made = folder / f"hybridlog-{secrets.token_hex(8)}"
    with undone(partial(made.unlink, missing_ok=True)):
        try:
            if size > room:
                raise OSError(errno.ENOSPC, "no space left")
            with (
                path.open("rb") as source,
                open(made, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as target,
            ):
                yield made, source, target, room
        except OSError as error:
            if error.errno not in NO_SPACE:
                raise cannot_open(path, error) from error
            raise SourceError(
                f"{path}: has to be unpacked to read it, and {folder} has no room for that; make "
                "room there, or set TMPDIR to a folder that has it"
            ) from error


def _unpack(source: BinaryIO, target: IO[bytes], room: int) -> str | None:
    """Copy the content of the frames of `source`; return a description of damage."""
    done = 0
    data = source.read(_PIECE)
    while data:
        frame = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).decompressobj()
        while not frame.eof:
            if not data:
                return f"the compressed file is cut short; it gives {done} bytes"
            try:
                part = frame.decompress(data)
            except zstandard.ZstdError as error:
                return f"the compressed file is damaged after {done} unpacked bytes: {error}"
            done += len(part)
            if done > room:
                raise OSError(errno.ENOSPC, "no space left")
            target.write(part)
            data = frame.unused_data if frame.eof else source.read(_PIECE)
        data = data or source.read(_PIECE)
    return None
