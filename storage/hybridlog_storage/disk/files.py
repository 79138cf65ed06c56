"""File operations on a store, without following symlinks.

A store may come from another user. So a symlink in the place of a file or folder in it is an
error. The path to the store itself may contain symlinks.

A store in a bucket is read by the same functions: `mounted` knows who answers for its path, and
nothing in it can be changed here. What is read of its files goes through `pread` and `preadv`,
or is announced by `fetch` before.

All changes of a store on the disk go through `system`. Tests replace it to record the
order of steps, to fail at a step, or to lose unsynced data.
"""

from __future__ import annotations

import errno
import fcntl
import math
import os
import resource
import shutil
import stat
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast
from weakref import WeakSet, finalize

from hybridlog_storage.errors import NO_SPACE, DiskFullError, HybridlogError, StoreError, exhausted
from hybridlog_storage.stopping import pause

if TYPE_CHECKING:
    from hybridlog_storage.messages import Buffer


_STORE = "hybridlog.toml"
_LEVELS = 5  # of folders in a store
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
_POLL_S = 0.005  # between two looks at a lock
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
Identity = tuple[int, int]
"""Inode of a folder, and time of its last change, ns."""


mounted: Final[dict[Path, Any]] = {}
"""Stores in buckets, as of `remote.store.BucketStore`, by their paths."""


class System:
    """The calls that change a file system. Tests replace `system`."""

    open = staticmethod(os.open)
    writev = staticmethod(os.writev)
    pwritev = staticmethod(os.pwritev)
    truncate = staticmethod(os.ftruncate)
    sync = staticmethod(os.fsync)
    rename = staticmethod(os.rename)
    link = staticmethod(os.link)
    unlink = staticmethod(os.unlink)
    mkdir = staticmethod(os.mkdir)
    rmdir = staticmethod(os.rmdir)


system: System = System()
"""The calls used by all functions here; looked up on each use."""


@contextmanager
def folder(path: Path) -> Iterator[int]:
    """The handle of a folder, which must be no symlink if it lies in a store."""
    if _mounted(path) is not None:
        raise OSError(errno.EROFS, "a store in a bucket cannot be changed like this", str(path))
    try:
        fd = os.open(path, _FOLDER | os.O_NOFOLLOW)
    except OSError as error:  # ELOOP in some systems
        is_in_store = any(os.path.lexists(outer / _STORE) for outer in path.parents[:_LEVELS])
        if error.errno not in {errno.ENOTDIR, errno.ELOOP} or is_in_store:
            raise
        fd = os.open(path, _FOLDER)
    try:
        yield fd
    finally:
        os.close(fd)


def open_file(path: Path, flags: int, mode: int = 0o666) -> int:
    """Open a file of a store; no symlink is followed, and no pipe is waited for."""
    if not flags & _WRITES and (found := _mounted(path)) is not None:
        return cast("int", found[0].open(found[1]))
    with folder(path.parent) as fd:
        return system.open(path.name, flags | os.O_NOFOLLOW | os.O_NONBLOCK, mode, dir_fd=fd)


def read_file(path: Path, most: int) -> bytes:
    """Read a small ordinary file, up to `most` bytes and one more, to notice larger files."""
    with os.fdopen(open_file(path, os.O_RDONLY), "rb") as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise OSError(0, "it is not an ordinary file", str(path))
        return file.read(min(about.st_size, most) + 1)


def write_all(fd: int, parts: Sequence[Buffer]) -> int:
    """Write all parts at the file's position; return the number of bytes."""
    views = [memoryview(part).cast("B") for part in parts if len(part)]
    total = sum(len(view) for view in views)
    while views:
        views = left_over(views, system.writev(fd, views[:512]))
    return total


def left_over(views: Sequence[memoryview], done: int) -> list[memoryview]:
    """The views without their first bytes."""
    for index, view in enumerate(views):
        if done < len(view):
            return [view[done:], *views[index + 1 :]]
        done -= len(view)
    return []


def write_file(
    path: Path, content: bytes, *, sync: bool = True, modified: int | None = None
) -> None:
    """Write a small file atomically, as the only writer. It replaces a file or symlink of its name.

    With `sync` it is on the disk when this returns. `modified` is in ns.
    """
    temporary = path.with_name(f".{path.name}.new")
    with suppress(FileNotFoundError):
        unlink(temporary)  # of a writer that died
    fd = open_file(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    try:
        try:
            write_all(fd, [content])
            if modified is not None:
                os.utime(fd, ns=(modified, modified))
            if sync:
                system.sync(fd)
        finally:
            os.close(fd)
        rename(temporary, path)
    except BaseException:
        with suppress(OSError):
            unlink(temporary)
        raise
    if sync:
        sync_folder(path.parent)


@contextmanager
def locked_folder(path: Path, wait_s: float = math.inf) -> Iterator[None]:
    """Lock a folder against other processes; `BlockingIOError` after `wait_s`."""
    with folder(path) as fd:
        _lock(fd, wait_s)
        yield


@contextmanager
def locked_file(path: Path, flags: int, wait_s: float) -> Iterator[int]:
    """Lock a file, and give its handle; errors as of `locked_folder`.

    If it was deleted meanwhile, the one of its name is locked.
    """
    end = time.monotonic() + wait_s
    while True:
        fd = open_file(path, flags)
        try:
            _lock(fd, end - time.monotonic())
            if is_at(fd, path):
                yield fd
                return
        finally:
            os.close(fd)


def _lock(fd: int, wait_s: float) -> None:
    end = time.monotonic() + wait_s
    while True:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | (0 if wait_s == math.inf else fcntl.LOCK_NB))
        except BlockingIOError:
            if time.monotonic() >= end:
                raise
            pause(_POLL_S * os.urandom(1)[0] / 255)
        else:
            return


def status(path: Path) -> os.stat_result:
    """The status of a file or folder; of a symlink, that of the link itself."""
    with folder(path.parent) as fd:
        return os.stat(path.name, dir_fd=fd, follow_symlinks=False)


def names(path: Path) -> dict[str, os.stat_result]:
    """The status of each entry of a folder, by name."""
    return changed_names(path, None)[1] or {}


def changed_names(
    path: Path, before: Identity | None
) -> tuple[Identity, dict[str, os.stat_result] | None]:
    """The status of each entry of a folder, by name, if it may have changed since `before`.

    First comes its inode and the time of its last change, ns, which is `before` of the next call;
    the entries are None if they are as before.
    """
    if _mounted(path) is not None:
        raise FileNotFoundError(errno.ENOENT, "a bucket has no tables", str(path))
    with folder(path) as fd:
        about = os.fstat(fd)
        now = about.st_ino, about.st_mtime_ns
        if now == before:
            return now, None
        entries = {}
        with os.scandir(fd) as listed:
            for entry in listed:
                with suppress(FileNotFoundError):
                    entries[entry.name] = entry.stat(follow_symlinks=False)
        return now, entries


def is_fetched(fd: int) -> bool:
    """True for a file in a bucket, where each request takes long."""
    return type(fd) is not int


def fetch(fd: int, ranges: Iterable[tuple[int, int]]) -> None:
    """Announce that some ranges of a file will be read, so that a bucket is asked once."""
    if is_fetched(fd):
        cast("Any", fd).fetch(ranges)


def pread(fd: int, size: int, offset: int) -> bytes:
    """As `os.pread`."""
    fetch(fd, [(offset, offset + size)])
    return os.pread(fd, size, offset)


def preadv(fd: int, buffers: Sequence[memoryview], offset: int) -> int:
    """As `os.preadv`."""
    fetch(fd, [(offset, offset + sum(map(len, buffers)))])
    return os.preadv(fd, buffers, offset)


def is_at(fd: int, path: Path) -> bool:
    """True if an open file is the one that has a path now."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(fd), status(path))
    return False


def identity(fd: Any) -> tuple[int, ...]:
    """A value that no other file has, nor this one after a change."""
    about = os.fstat(fd)
    now = about.st_ino, about.st_size, about.st_mtime_ns
    return cast("tuple[int, ...]", fd.identity()) if is_fetched(fd) else now


def duplicate(fd: Any) -> int:
    """As `os.dup`."""
    return cast("int", fd.again()) if is_fetched(fd) else os.dup(fd)


def most_open(most: int) -> int:
    """Number of files that a cache may hold open: some, or an eighth of what is allowed."""
    allowed, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return most if allowed < 0 else max(min(most, allowed // 8), 4)


def make_folder(path: Path, mode: int = 0o777) -> None:
    """Create a folder; the umask applies."""
    with folder(path.parent) as fd:
        system.mkdir(path.name, mode, dir_fd=fd)


def rename(old: Path, new: Path) -> None:
    """Give a file or a folder of the store another name, in another folder, too."""
    with folder(old.parent) as fd, folder(new.parent) as new_fd:
        system.rename(old.name, new.name, src_dir_fd=fd, dst_dir_fd=new_fd)


def link(old: Path, new: Path) -> None:
    """Give a file of the store a second name."""
    with folder(old.parent) as fd, folder(new.parent) as new_fd:
        system.link(old.name, new.name, src_dir_fd=fd, dst_dir_fd=new_fd, follow_symlinks=False)


def unlink(path: Path) -> None:
    """Remove a file."""
    with folder(path.parent) as fd:
        system.unlink(path.name, dir_fd=fd)


def sync_folder(path: Path) -> None:
    """Force renames, new names and removals in a folder to the disk."""
    with folder(path) as fd:
        system.sync(fd)


def make_folders(path: Path) -> None:
    """Make a folder and the one above it, as far as they are missing."""
    for place in (path.parent, path):
        with suppress(FileExistsError):
            make_folder(place)


def remove_tree(path: Path) -> None:
    """Remove a folder and its content; ignore what does not exist."""
    with folder(path.parent) as fd:
        _remove(fd, path.name)


def _remove(parent: int, name: str) -> None:
    with suppress(FileNotFoundError):
        try:
            fd = os.open(name, _FOLDER | os.O_NOFOLLOW, dir_fd=parent)
        except OSError:  # a file or a symlink
            system.unlink(name, dir_fd=parent)
            return
        try:
            for inner in sorted(os.listdir(fd)):  # noqa: PTH208 - of a handle
                _remove(fd, inner)
        finally:
            os.close(fd)
        system.rmdir(name, dir_fd=parent)


def _mounted(path: Path) -> tuple[Any, tuple[str, ...]] | None:
    """The store that is no directory and has a path, and the names on the way in it."""
    if mounted:
        for outer in (path, *path.parents):
            if outer in mounted:
                return mounted[outer], path.parts[len(outer.parts) :]
    return None


def user_cache() -> Path:
    """The directory for what was read of buckets, and of stores that cannot be written."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    try:
        # A relative one does not count.
        base = Path(named) if os.path.isabs(named) else Path.home() / ".cache"  # noqa: PTH117
    except RuntimeError as error:
        raise StoreError("This user has no home directory: set XDG_CACHE_HOME.") from error
    return base / "hybridlog/buckets"


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
    rename(temporary, final)
    sync_folder(final.parent)


def remove(folder: Path, names: Collection[str]) -> None:
    """Remove files, if they are there; after an error, the next opening removes the others."""
    with explained(folder, "removing files of"):
        for name in names:
            with suppress(FileNotFoundError):
                unlink(folder / name)
        if names:
            sync_folder(folder)


# Names until what is written is complete.

_unfinished: WeakSet[Unfinished] = WeakSet()
_undo: list[tuple[int, Callable[[], object]]] = []


class Unfinished:
    """A temporary name, unused so far, where the owner creates a file or a directory.

    An interruption may come at any moment, so it exists before the file does. The file goes with
    its owner, by `undo_unfinished`, or when the process ends; a child process removes none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._process = os.getpid()
        self._at_the_end = finalize(self, _remove_own, path, self._process)
        _unfinished.add(self)

    def publish(self, final: Path) -> None:
        """Rename it atomically to its final name in its directory, and sync that.

        It replaces a file, or as a directory an empty directory.
        """
        publish(self.path, final)
        self._at_the_end.detach()

    def remove(self) -> None:
        """Remove the file or directory; does nothing after `publish`."""
        if self._at_the_end.alive:
            _remove_own(self.path, self._process)
            self._at_the_end.detach()


def beside(final: Path) -> Unfinished:
    """An unused name in the same directory."""
    return Unfinished(final.with_name(f".{final.name[:100]}.{os.urandom(6).hex()}.partial"))


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
    for one in [*_unfinished]:
        one.remove()
    for process, undo in reversed(_undo):
        if process == os.getpid():
            with suppress(OSError):
                undo()


def _remove_own(path: Path, process: int) -> None:
    if process != os.getpid():
        return
    with suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
