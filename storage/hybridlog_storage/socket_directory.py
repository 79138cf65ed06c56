"""Unix sockets of this user's processes: in private directories with short paths."""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
from pathlib import Path

from hybridlog_storage.errors import StoreError

MAX_SOCKET_PATH = 100
"""Bytes; the kernel takes 107, other systems 103."""


def socket_base() -> Path:
    """The directory of this user's sockets.

    Not the store's directory, whose path may be too long for a socket, and not
    XDG_RUNTIME_DIR, which is removed when its user logs out, while a recording may go on.
    HYBRIDLOG_RUNTIME_DIR overrides `/tmp`.
    """
    base = Path(os.environ.get("HYBRIDLOG_RUNTIME_DIR") or "/tmp").absolute()  # noqa: S108
    return base / f"hybridlog-{os.geteuid()}"


def new_socket(directory: Path, name: str) -> Path:
    """Where a new socket that belongs to a directory may be made: in one of its own.

    New each time, so that the end of a process can never remove the socket of the next.

    Args:
        directory: A part of the path says whose it is, to whoever looks around in /tmp.
        name: Of the socket.

    Raises:
        StoreError: The path is too long, or the directory is not private to this user.
    """
    return _private(socket_base() / f"{_part(directory)}-{secrets.token_hex(4)}", name)


def is_socket_of(path: str, directory: Path) -> bool:
    """Whether a path is one that `new_socket` may have given for a directory."""
    place = Path(path)
    own = place.parent
    return own.parent == socket_base() and own.name.startswith(f"{_part(directory)}-")


def _part(directory: Path) -> str:
    return hashlib.sha256(os.fsencode(directory)).hexdigest()[:8]


def _private(directory: Path, name: str) -> Path:
    """Make a directory that nobody else can open, and the one above it."""
    own = directory.parent
    if len(os.fsencode(directory / name)) > MAX_SOCKET_PATH:
        raise StoreError(
            f"{own.parent} is too long a path for a socket: set HYBRIDLOG_RUNTIME_DIR to a short "
            f"one."
        )
    for path in (own, directory):
        try:
            path.mkdir(mode=0o700)
        except FileExistsError:
            pass
        except OSError as error:
            raise StoreError(
                f"{path} cannot be made for a socket: {error.strerror}. Set "
                f"HYBRIDLOG_RUNTIME_DIR to a directory that can be written."
            ) from error
        if not is_private(path):
            raise StoreError(
                f"{path} has to be a directory of this user that nobody else can open, and is "
                f"not. Remove it, or set HYBRIDLOG_RUNTIME_DIR to another directory."
            )
    return directory / name


def is_private(directory: Path) -> bool:
    """Whether this is a real directory, ours, and closed to everybody else."""
    try:
        about = directory.lstat()
    except OSError:
        return False
    return (
        stat.S_ISDIR(about.st_mode)
        and about.st_uid == os.geteuid()
        and not stat.S_IMODE(about.st_mode) & 0o077
    )


def is_our_socket(path: str) -> bool:
    """Whether a path leads to a socket of ours in a private directory."""
    place = Path(path)
    if not place.is_absolute() or ".." in place.parts or not is_private(place.parent):
        return False
    try:
        about = place.lstat()
    except (OSError, ValueError):
        return False
    return stat.S_ISSOCK(about.st_mode) and about.st_uid == os.geteuid()
