"""A private directory with a short path for unix sockets of this user's processes."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from hybridlog_storage.errors import StoreError

MAX_SOCKET_PATH = 100
"""Bytes; Linux allows 107, other systems 103."""


def socket_base() -> Path:
    """The directory of this user's sockets.

    It is in `/tmp`, or in HYBRIDLOG_RUNTIME_DIR. The path of the store's directory may be too
    long for a socket, and XDG_RUNTIME_DIR is removed at logout, while a recording may go on.
    """
    base = Path(os.environ.get("HYBRIDLOG_RUNTIME_DIR") or "/tmp").absolute()  # noqa: S108
    return base / f"hybridlog-{os.geteuid()}"


def lasting_socket(file: int) -> Path:
    """Path of a socket that goes with an open file, the same in every process.

    Its directory, which only this user can open, is made.
    """
    base, about = socket_base(), os.fstat(file)
    socket = base / f"{about.st_dev:x}-{about.st_ino:x}.sock"
    if len(os.fsencode(socket)) > MAX_SOCKET_PATH:
        raise StoreError(
            f"{base.parent} is too long a path for a socket: set HYBRIDLOG_RUNTIME_DIR to a short "
            f"one."
        )
    try:
        base.mkdir(mode=0o700)
    except FileExistsError:
        pass
    except OSError as error:
        raise StoreError(
            f"{base} cannot be made for a socket: {error.strerror}. Set "
            f"HYBRIDLOG_RUNTIME_DIR to a directory that can be written."
        ) from error
    if not is_private(base):
        raise StoreError(
            f"{base} must be a directory that only this user can open, and is "
            f"not. Remove it, or set HYBRIDLOG_RUNTIME_DIR to another directory."
        )
    return socket


def is_private(directory: Path) -> bool:
    """True if a path is a real directory that only this user can open."""
    try:
        about = directory.lstat()
    except OSError:
        return False
    return (
        stat.S_ISDIR(about.st_mode)
        and about.st_uid == os.geteuid()
        and not stat.S_IMODE(about.st_mode) & 0o077
    )
