"""Unpacks compressed files to temporary files, so that a reader can seek."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import tempfile
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import zstandard

from hybridlog.formats.reading import cannot_open
from hybridlog_storage.disk.files import undone
from hybridlog_storage.errors import NO_SPACE, SourceError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import IO

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
