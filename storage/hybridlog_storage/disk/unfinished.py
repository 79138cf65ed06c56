"""Temporary names for files and directories until they are complete.

An interruption (Ctrl-C) may come at any moment: after a file is created and before an
object owns it, or on the way into the function that would remove it. So a name is
registered before its file exists, and unregistered only after its file is gone.
Registered files are removed with their owner, by `undo_unfinished`, or when the process
ends. `undone` registers other things to take back.
"""

from __future__ import annotations

import os
import shutil
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_noted: dict[Path, int] = {}
"""Unfinished paths and the process that makes them: a child process removes none."""
_undo: list[tuple[int, Callable[[], object]]] = []


class Unfinished:
    """A temporary name, unused so far, where the owner creates a file or a directory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        _noted[path] = os.getpid()
        self._at_the_end = weakref.finalize(self, _remove, path)

    def publish(self, final: Path) -> None:
        """Rename it atomically to its final name in its directory, and sync that.

        It replaces a file, or as a directory an empty directory.
        """
        from hybridlog_storage.disk.files import publish

        publish(self.path, final)
        self.remove()

    def remove(self) -> None:
        """Remove the file or directory; does nothing after `publish`."""
        _remove(self.path)
        self._at_the_end.detach()


def beside(final: Path) -> Unfinished:
    """An unused name in the same directory."""
    import secrets

    return Unfinished(final.with_name(f".{final.name[:100]}.{secrets.token_hex(6)}.partial"))


@contextmanager
def undone(undo: Callable[[], object]) -> Iterator[None]:
    """Take something back if the block fails, or if the process is stopped in it.

    `undo` may be called before it was done.
    """
    registered = os.getpid(), undo
    _undo.append(registered)
    try:
        yield
    except BaseException:
        undo()
        raise
    finally:
        _undo.remove(registered)


def undo_unfinished() -> None:
    """Remove all unfinished files of this process, and take back what is registered.

    For a process that is stopping and may have lost its reference to the writer.
    """
    for path in list(_noted):
        _remove(path)
    for process, undo in reversed(_undo):
        if process == os.getpid():
            with suppress(OSError):
                undo()


def _remove(path: Path) -> None:
    if _noted.get(path) != os.getpid():
        return
    with suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    _noted.pop(path, None)
