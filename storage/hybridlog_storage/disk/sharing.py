"""Shared stores: every user of a group can record, ask and remove.

The folders of a shared store are setgid and group-writable. `hybridlog_storage.disk.files`
recognizes them by that: new files in them belong to the same group and are group-writable,
too. The folders of the embedded MongoDB belong to one user each.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from hybridlog_storage.disk import durability, files

_OWN: Final = "mongod"
"""Prefix of folders that belong to one user."""
_FOLDER: Final = stat.S_ISGID | stat.S_IRWXG
_FILE: Final = stat.S_IRGRP | stat.S_IWGRP


def make_shared(path: Path) -> None:
    """Make all files and folders of a store writable by the group of its directory.

    Files of other users are unchanged: only they could change them.

    Args:
        path: The store's directory; the caller writes `shared = true` into its settings.

    Raises:
        StoreError: The system refuses.
    """
    try:
        with files.folder(path, 0) as fd:
            group = os.fstat(fd).st_gid
            _open_up(fd, group)
            for name in sorted(os.listdir(fd)):  # noqa: PTH208 - of a handle
                if not name.startswith(_OWN):
                    _share(fd, name, group)
    except OSError as error:
        raise durability.explain(error, path, "sharing") from error


def _share(parent: int, name: str, group: int) -> None:
    """Open a folder and its content to the group, recursively."""
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
    about = os.stat(name, dir_fd=parent, follow_symlinks=False)
    if not stat.S_ISDIR(about.st_mode) and not stat.S_ISREG(about.st_mode):
        return
    if about.st_uid != os.geteuid():
        return
    fd = os.open(name, flags, dir_fd=parent)
    try:
        _open_up(fd, group)
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            for inner in sorted(os.listdir(fd)):  # noqa: PTH208 - of a handle
                _share(fd, inner, group)
    finally:
        os.close(fd)


def _open_up(fd: int, group: int) -> None:
    about = os.fstat(fd)
    if about.st_uid != os.geteuid():
        return
    if about.st_gid != group:
        os.fchown(fd, -1, group)
    wanted = about.st_mode | (_FOLDER if stat.S_ISDIR(about.st_mode) else _FILE)
    if wanted != about.st_mode:
        files.system.chmod(fd, stat.S_IMODE(wanted))
