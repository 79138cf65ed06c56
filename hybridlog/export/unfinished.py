"""What is being made, under names of its own, until it is complete.

An interruption (Ctrl-C) may come at any instant: after a file is created and before
anything holds it, or on the way into the function that would remove it. So a name is
noted before anything exists under it, and forgotten only when nothing does any more.
What is noted is removed when its owner is, by `remove_unfinished`, or when the process
ends.
"""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
import weakref
from contextlib import suppress
from pathlib import Path

from hybridlog_storage.durability import publish

_noted: dict[Path, int] = {}
"""What is unfinished, and the process that makes it: a child removes nothing of it."""


class Unfinished:
    """A name under which something is made.

    Args:
        path: Nothing is there yet; the owner makes a file or a directory there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _noted[path] = os.getpid()
        self._at_the_end = weakref.finalize(self, _remove, path)

    def publish(self, final: Path) -> None:
        """Give it its name, in one step, and sync the directory.

        Args:
            final: In the same directory. A file there is replaced, and an empty directory
                by a directory.

        Raises:
            OSError: It cannot be done.
        """
        publish(self.path, final, depth=1)
        self.remove()

    def remove(self) -> None:
        """Leave nothing; does nothing after `publish`."""
        _remove(self.path)
        self._at_the_end.detach()


def beside(final: Path) -> Unfinished:
    """A name in the same directory that is not in use."""
    return Unfinished(final.with_name(f".{final.name[:100]}.{secrets.token_hex(6)}.partial"))


def scratch_directory() -> Unfinished:
    """A new directory for temporary files, which only this user may enter.

    Raises:
        OSError: It cannot be made.
    """
    place = Unfinished(Path(tempfile.gettempdir()) / f"hybridlog-{secrets.token_hex(8)}")
    place.path.mkdir(mode=0o700)
    return place


def remove_unfinished() -> None:
    """Remove all that this process has begun and not completed.

    For a process that was told to stop: it may be that nobody holds the writer any more.
    """
    for path in list(_noted):
        _remove(path)


def _remove(path: Path) -> None:
    if _noted.get(path) != os.getpid():
        return
    with suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    _noted.pop(path, None)
