"""The one module that decides when bytes are safe, and what a failed write means.

Model: a file system may reorder writes of different files, and may lose everything
since the last fsync when power fails; when only a process dies, what was written
stays. A rename within one directory is atomic; it is durable once the directory is
synced. So a file becomes visible under its final name only complete, and a reader
never meets a half-made one.
"""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from hybridlog_storage.errors import NO_SPACE, DiskFullError, HybridlogError, StoreError
from hybridlog_storage.messages import Buffer


def explain(error: OSError, path: Path, doing: str) -> HybridlogError:
    """The error of our tree for an operating system error on a file of the store."""
    if error.errno in NO_SPACE:
        return DiskFullError(
            f"No space left while {doing} {path}. Free some space and run the command again."
        )
    if error.errno in {errno.EROFS, errno.EACCES, errno.EPERM}:
        return StoreError(
            f"Not allowed to write while {doing} {path}: {error.strerror}. "
            "Check the owner and the mount of the store, or choose another with --store."
        )
    return StoreError(f"Error while {doing} {path}: {error.strerror or error}.")


def write_all(fd: int, parts: Sequence[Buffer]) -> int:
    """Write all parts at the file's position; returns the number of bytes.

    Raises:
        OSError: when the system refuses; a part may have been written by then.
    """
    views = [memoryview(part).cast("B") for part in parts if len(part)]
    total = sum(len(view) for view in views)
    while views:
        views = left_over(views, os.writev(fd, views[:512]))
    return total


def left_over(views: Sequence[memoryview], done: int) -> list[memoryview]:
    """What remains of some views when their first bytes have been dealt with."""
    for index, view in enumerate(views):
        if done < len(view):
            return [view[done:], *views[index + 1 :]]
        done -= len(view)
    return []


def sync_file(fd: int) -> None:
    """Return once everything written to the file is on the disk."""
    os.fsync(fd)


def sync_directory(path: Path) -> None:
    """Return once renames and removals in the directory are on the disk."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def publish(temporary: Path, final: Path) -> None:
    """Give a synced file its final name, durably."""
    temporary.replace(final)
    sync_directory(final.parent)


@contextmanager
def new_file(final: Path) -> Iterator[int]:
    """A file descriptor of a temporary file that becomes `final` if the block succeeds.

    Nothing is left behind when it does not.
    """
    try:
        fd, name = tempfile.mkstemp(dir=final.parent, prefix=f".{final.name}.")
    except OSError as error:
        raise explain(error, final, "creating") from error
    temporary = Path(name)
    try:
        yield fd
        sync_file(fd)
        publish(temporary, final)
    except OSError as error:
        raise explain(error, final, "writing") from error
    finally:
        os.close(fd)
        with suppress(FileNotFoundError):
            temporary.unlink()


def write_new(final: Path, content: bytes) -> None:
    """Write a small file: all of it or nothing."""
    with new_file(final) as fd:
        write_all(fd, [content])
