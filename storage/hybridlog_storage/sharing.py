"""Stores that a group shares: each of its users can record, ask and remove.

The folders of such a store are setgid and group-writable. That is the mark that
`hybridlog_storage.files` goes by: what is made in them later belongs to the same group, and
is group-writable, too. The embedded MongoDB's folders stay each user's own.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from hybridlog_storage import durability, files

_OWN: Final = "mongod"
"""Names of folders that belong to one user begin like this."""
_FOLDER: Final = stat.S_ISGID | stat.S_IRWXG
_FILE: Final = stat.S_IRGRP | stat.S_IWGRP


def make_shared(path: Path) -> None:
    """Let the group of a store's directory write it, in all that is there now.

    What belongs to other users stays as it is: only they could change it.

    Args:
        path: The store's directory; `shared = true` in its settings is not this one's part.

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
    """Open what lies in a folder to the group, and what lies in that."""
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
