"""Durable writes, and the meaning of a failed write.

Model: a file system may reorder writes of different files, and may lose everything
since the last fsync when power fails; when only a process dies, what was written
stays. A rename within one directory is atomic; it is durable once the directory is
synced. So a file becomes visible under its final name only complete, and a reader
never meets a half-made one.
"""

from __future__ import annotations

import errno
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hybridlog_storage.disk import files
from hybridlog_storage.errors import NO_SPACE, DiskFullError, HybridlogError, StoreError, exhausted


def explain(error: OSError, path: Path, doing: str) -> HybridlogError:
    """Map an operating system error on a file of the store to a hybridlog error."""
    if error.errno in NO_SPACE:
        return DiskFullError(
            f"No space left while {doing} {path}. Free some space and run the command again."
        )
    short = exhausted(error.errno, f"{doing} {path}")
    if short is not None:
        return short
    if error.errno in {errno.EROFS, errno.EACCES, errno.EPERM}:
        return StoreError(
            f"Not allowed to write while {doing} {path}: {error.strerror}. "
            "Check the owner and the mount of the store, or choose another with --store."
        )
    return StoreError(f"Error while {doing} {path}: {error.strerror or error}.")


@contextmanager
def explained(path: Path, doing: str) -> Iterator[None]:
    """Raise operating system errors of a block as hybridlog errors."""
    try:
        yield
    except OSError as error:
        raise explain(error, path, doing) from error


def publish(temporary: Path, final: Path) -> None:
    """Durably give a synced file its final name in its folder; a file of that name is replaced."""
    files.rename(temporary, final)
    files.sync_folder(final.parent)


def remove(folder: Path, names: Collection[str]) -> None:
    """Remove files, if they are there; after an error, the next opening removes the others."""
    with explained(folder, "removing files of"):
        for name in names:
            with suppress(FileNotFoundError):
                files.unlink(folder / name)
        if names:
            files.sync_folder(folder)


def write_new(final: Path, content: bytes) -> None:
    """Write a small file atomically."""
    with explained(final, "writing"):
        files.write_file(final, content)
