"""Checks the file or directory that is written, and replaces what is there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from hybridlog_storage.disk.unfinished import is_published, undone
from hybridlog_storage.errors import UsageError


def check_room(path: Path, *, force: bool, is_directory: bool = False) -> None:
    """Refuse to overwrite without --force, and foreign directories even with it.

    Args:
        path: The output.
        force: --force was given.
        is_directory: It is to be a directory with a file a message.

    Raises:
        UsageError: The path cannot be written.
    """
    if not os.path.lexists(path) or _is_device(path):
        return
    if path.is_dir():
        if not is_directory:
            raise UsageError(f"{path} is a directory; name a file in it.")
        inside = next(path.iterdir(), None)
        if inside is None:
            return
        if not _holds_messages(path):
            raise UsageError(f"{path} is a directory that holds other things; name a new one.")
    elif is_directory:
        raise UsageError(f"{path} is a file; messages go into a directory.")
    if not force:
        raise UsageError(f"{path} exists; --force overwrites it.")


@contextmanager
def replacing(path: Path, *, force: bool, is_directory: bool = False) -> Iterator[None]:
    """Move a directory aside while a new one is written; it comes back when the block fails.

    Files are replaced by their writers in one step.

    Raises:
        UsageError: The path cannot be written.
    """
    check_room(path, force=force, is_directory=is_directory)
    if not path.is_dir() or path.is_symlink() or next(path.iterdir(), None) is None:
        yield
        return
    import secrets
    import shutil

    aside = path.with_name(f".{path.name[:100]}.{secrets.token_hex(6)}.old")
    with undone(partial(_bring_back, aside, path)):
        try:
            path.rename(aside)
        except OSError as error:
            raise UsageError(f"{path} cannot be replaced: {error.strerror}.") from error
        yield
    shutil.rmtree(aside, ignore_errors=True)


def _bring_back(aside: Path, path: Path) -> None:
    with suppress(OSError):
        if not path.exists():
            aside.rename(path)


def not_written(path: Path) -> str:
    """The sentence about an output file after a stopped command; empty if the file is complete."""
    return "" if is_published(path) else f"{path} is not written."


def _holds_messages(path: Path) -> bool:
    from hybridlog.formats.raw import holds_messages

    try:
        return holds_messages(path)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}.") from error


def _is_device(path: Path) -> bool:
    return path.exists() and not path.is_file() and not path.is_dir()
