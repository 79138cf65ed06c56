"""Commands that die, fail or are stopped at the n-th step that changes a store.

`Stepper` runs commands in processes of their own, which are forked from one that has
imported everything, so that a process takes a few hundredths of a second. In these, each
call that changes files or the database is a step.
"""

from __future__ import annotations

import errno
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NoReturn, Self

from hybridlog_storage.disk import files
from tests.copies import bring

LIMIT_S = 60.0
ROOT = Path(__file__).parents[2]

Fault = Literal[
    "none",
    "die",  # as by SIGKILL
    "torn",  # the same in the middle of a step: half of it is done
    "ENOSPC",  # from this step on nothing more can be written
    "EIO",  # this step of the file system fails
    "database",  # from this step on the database fails
    "INT",
    "TERM",
]
TORN = ("write", "insert", "delete")
"""Steps of which half can be done."""
ALLOCATES = ("create", "write", "mkdir", "sync")
"""Steps that a full disk fails."""

DATABASE = ("insert", "delete", "update", "collection")
"""Steps of the database."""


@dataclass(frozen=True)
class Point:
    """Where a command is disturbed, and how.

    Attributes:
        fault: What happens.
        at: Number of the step, from 0.
        after: Whether the step is done first.
    """

    fault: Fault
    at: int = -1
    after: bool = False


@dataclass(frozen=True)
class Run:
    """How a command went.

    Attributes:
        steps: What its steps were, in order, as far as it came.
        outcome: `done`, `killed`, `stopped`, or the name of an error of hybridlog's.
        message: Of the error.
    """

    steps: tuple[str, ...]
    outcome: str
    message: str


class Stepper:
    """Runs commands in processes of their own. A context manager."""

    def __enter__(self) -> Self:
        path = os.pathsep.join([str(ROOT), str(ROOT / "storage")])
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.faults.steps"],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate(timeout=LIMIT_S)

    def start(self, command: Sequence[str], store: Path, uri: str, point: Point) -> None:
        """Begin to run a command.

        Args:
            command: A name from `COMMANDS`, and its arguments.
            store: The store.
            uri: Its database.
            point: Where it is disturbed.
        """
        job = {"command": list(command), "store": str(store), "uri": uri, "point": asdict(point)}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()

    def wait(self) -> Run:
        """How it went."""
        assert self._process.stdout is not None
        told = json.loads(self._process.stdout.readline())
        assert told["outcome"] != "hangs", told
        return Run(tuple(told["steps"]), told["outcome"], told["message"])

    def run(self, command: Sequence[str], store: Path, uri: str, point: Point) -> Run:
        """Run a command."""
        self.start(command, store, uri, point)
        return self.wait()


# In the processes.


class Seam:
    """Counts steps, and disturbs one of them. Thread safe.

    Args:
        point: Which, and how.
        tell: Told of each step.
    """

    def __init__(self, point: Point, tell: Callable[[str], None]) -> None:
        self._point = point
        self._tell = tell
        self._count = 0
        self._lock = threading.RLock()
        self._broken = False

    def step(
        self, kind: str, what: str, do: Callable[[], Any], half: Callable[[], object] | None = None
    ) -> Any:
        """Do a step, or not.

        Args:
            kind: What it is.
            what: Of what.
            do: Does it.
            half: Does half of it.
        """
        with self._lock:
            number, point = self._count, self._point
            self._count += 1
            self._tell(f"{kind} {what}")
            if number == point.at and point.fault == "torn":
                if half is not None:
                    half()
                os.kill(os.getpid(), signal.SIGKILL)
            if number == point.at and not point.after:
                self._disturb(kind)
            self._fail_if_broken(kind)
            result = do()
            if number == point.at and point.after:
                self._disturb(kind)
                self._fail_if_broken(kind)
            return result

    def _disturb(self, kind: str) -> None:
        fault = self._point.fault
        if fault == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        elif fault in {"INT", "TERM"}:
            os.kill(os.getpid(), getattr(signal, f"SIG{fault}"))
        elif fault == "EIO":
            self._broken = True
            try:
                self._fail_if_broken(kind)
            finally:
                self._broken = False
        elif fault in {"ENOSPC", "database"}:
            self._broken = True

    def _fail_if_broken(self, kind: str) -> None:
        from hybridlog_storage.errors import DatabaseError

        if not self._broken:
            return
        is_database = kind.startswith(DATABASE)
        fault = self._point.fault
        if fault == "database" and is_database:
            raise DatabaseError("MongoDB does not answer")
        if fault == "ENOSPC" and kind in ALLOCATES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if fault == "EIO" and not is_database:
            raise OSError(errno.EIO, os.strerror(errno.EIO))


class SteppedSystem(files.System):
    """A file system of which each change is a step."""

    def __init__(self, seam: Seam) -> None:
        self._seam = seam

    def open(self, name: str, flags: int, mode: int = 0o666, *, dir_fd: int | None = None) -> int:
        def do() -> int:
            return super(SteppedSystem, self).open(name, flags, mode, dir_fd=dir_fd)

        return int(self._seam.step("create", name, do)) if flags & os.O_CREAT else do()

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        def do() -> int:
            return super(SteppedSystem, self).writev(fd, parts)

        def half() -> None:
            whole = b"".join(parts)
            os.write(fd, whole[: len(whole) // 2])

        return int(self._seam.step("write", _name(fd), do, half))

    def pwritev(self, fd: int, parts: Sequence[memoryview], position: int) -> int:
        def do() -> int:
            return super(SteppedSystem, self).pwritev(fd, parts, position)

        def half() -> None:
            first = memoryview(parts[0]).cast("B")
            length = len(first) // 2 // 4096 * 4096  # a direct write takes whole blocks
            if length:
                os.pwritev(fd, [first[:length]], position)

        return int(self._seam.step("write", _name(fd), do, half))

    def truncate(self, fd: int, length: int) -> None:
        self._seam.step("truncate", _name(fd), lambda: os.ftruncate(fd, length))

    def sync(self, fd: int) -> None:
        # Nothing is lost of what was not synced: that is what other tests are for.
        self._seam.step("sync", _name(fd), lambda: None)

    def rename(self, old: str, new: str, *, src_dir_fd: int, dst_dir_fd: int) -> None:
        self._seam.step(
            "rename",
            f"{old} {new}",
            lambda: os.rename(old, new, src_dir_fd=src_dir_fd, dst_dir_fd=dst_dir_fd),
        )

    def link(
        self, old: str, new: str, *, src_dir_fd: int, dst_dir_fd: int, follow_symlinks: bool
    ) -> None:
        def do() -> None:
            places = {"src_dir_fd": src_dir_fd, "dst_dir_fd": dst_dir_fd}
            os.link(old, new, **places, follow_symlinks=follow_symlinks)

        self._seam.step("link", f"{old} {new}", do)

    def unlink(self, name: str, *, dir_fd: int) -> None:
        self._seam.step("unlink", name, lambda: os.unlink(name, dir_fd=dir_fd))

    def mkdir(self, name: str, mode: int, *, dir_fd: int) -> None:
        self._seam.step("mkdir", name, lambda: os.mkdir(name, mode, dir_fd=dir_fd))

    def rmdir(self, name: str, *, dir_fd: int) -> None:
        self._seam.step("rmdir", name, lambda: os.rmdir(name, dir_fd=dir_fd))


def _name(fd: int) -> str:
    return Path(f"/proc/self/fd/{fd}").readlink().name


def step_database(seam: Seam) -> None:
    """Make each change of the database a step."""
    from hybridlog_storage.mongo.database import Database

    def stepped(method: str, kind: str, half: Callable[..., object] | None = None) -> None:
        original = getattr(Database, method)

        def call(self: Database, collection: str, *args: Any, **kwargs: Any) -> Any:
            return seam.step(
                kind,
                collection,
                lambda: original(self, collection, *args, **kwargs),
                None if half is None else lambda: half(self, collection, *args, **kwargs),
            )

        setattr(Database, method, call)

    insert, delete = Database.insert_raw, Database.delete

    def half_of_insert(self: Database, collection: str, documents: Any) -> None:
        insert(self, collection, documents[: len(documents) // 2])

    def half_of_delete(self: Database, collection: str, query: Mapping[str, object]) -> None:
        ids = [found["_id"] for found in self.find(collection, query, {"_id": 1})]
        delete(self, collection, {"_id": {"$in": ids[: len(ids) // 2]}})

    stepped("insert_raw", "insert", half_of_insert)
    stepped("delete", "delete", half_of_delete)
    stepped("update", "update")
    for method in ("ensure_collection", "create_index", "drop_index"):
        stepped(method, "collection")


Command = Callable[[Callable[[], None], Path, str, Sequence[str]], None]
"""Gets what makes steps count from now on, the store, its database, and arguments."""


def _on_store(do: Callable[[Any, Sequence[str]], object]) -> Command:
    def command(arm: Callable[[], None], store: Path, uri: str, args: Sequence[str]) -> None:
        import hybridlog as hl

        with hl.open(store, mongo=uri, require_database=True) as opened:
            arm()
            do(opened, args)

    return command


def _open(arm: Callable[[], None], store: Path, uri: str, _args: Sequence[str]) -> None:
    import hybridlog as hl
    from hybridlog_storage.errors import StoreError

    arm()
    with hl.open(store, mongo=uri, require_database=True) as opened:
        if opened.repairs.unreadable:  # the command line tells it
            raise StoreError(str(opened.repairs.unreadable))


def _record(store: Any, args: Sequence[str]) -> None:
    from tests.faults.logs import SETTINGS

    store.record(args[0], name=args[1], settings=SETTINGS)


def _repair(store: Any, _args: Sequence[str]) -> None:
    from hybridlog_storage.errors import StoreError

    found = store.verify(repair=True).findings
    left = [one for one in found if "nothing else can prove it" not in one.cure]
    if left:  # the command line tells it, and exits with 1
        raise StoreError(str(left))


COMMANDS: Mapping[str, Command] = {
    "open": _open,
    "rm": _on_store(lambda store, args: store.remove(args[0])),
    "reindex": _on_store(lambda store, args: store.index.rebuild(args or None)),
    "rename": _on_store(lambda store, args: store.edit(args[0], name=args[1])),
    "tag": _on_store(lambda store, args: store.edit(args[0], tag={args[1]: args[2]})),
    "mark": _on_store(lambda store, args: store.mark(args[0], args[1], args[2])),
    "import": _on_store(lambda store, args: bring(store, args[0])),
    "repair": _on_store(_repair),
    "record": _on_store(_record),
}


def _run(job: Mapping[str, Any], tell: Callable[[str], None]) -> tuple[str, str]:
    """Run a command in this process; returns outcome and message."""
    from hybridlog.cli import signals
    from hybridlog_storage.errors import HybridlogError

    name, *args = job["command"]
    point = Point(**job["point"])
    signals.install()

    def arm() -> None:
        seam = Seam(point, tell)
        files.system = SteppedSystem(seam)
        step_database(seam)

    try:
        COMMANDS[name](arm, Path(job["store"]), job["uri"], args)
    except signals.Stopped:
        return "stopped", ""
    except HybridlogError as error:
        return type(error).__name__, str(error)
    except BaseException:
        import traceback

        return "crash", traceback.format_exc()
    return "done", ""


def _serve() -> NoReturn:
    """Run the commands that are named on standard input, each in a process of its own."""
    import logging

    import bson
    import pandas as pd
    import pymongo

    import hybridlog.columns.tables
    import hybridlog.formats.mcap.reader
    import hybridlog.maintenance.copying
    import hybridlog.maintenance.derived
    import hybridlog.maintenance.edit
    import hybridlog.maintenance.verify
    import hybridlog.record.recorder
    import hybridlog.store
    import tests.faults.logs

    logging.disable()
    assert all((bson, pd, pymongo, hybridlog, tests.faults.logs))
    for line in sys.stdin:
        job = json.loads(line)
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            try:
                tell = partial(_tell, writing)
                tell(f"end {json.dumps(_run(job, tell))}")
            finally:
                os._exit(0)
        os.close(writing)
        print(json.dumps(_follow(child, reading)), flush=True)
    sys.exit(0)


def _tell(writing: int, line: str) -> None:
    os.write(writing, f"{line}\n".encode())


def _follow(child: int, reading: int) -> dict[str, Any]:
    """What a process tells until it ends."""
    told, deadline = b"", time.monotonic() + LIMIT_S
    hangs = False
    while True:
        ready, _, _ = select.select([reading], [], [], max(deadline - time.monotonic(), 0))
        if not ready:
            hangs = True
            os.kill(child, signal.SIGKILL)
        piece = os.read(reading, 1 << 16)
        if not piece:
            break
        told += piece
    os.close(reading)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    *steps, last = told.decode().splitlines() or [""]
    if last.startswith("end "):
        outcome, message = json.loads(last.removeprefix("end "))
    else:
        steps.append(last)
        is_stopped = code in {128 + signal.SIGINT, 128 + signal.SIGTERM}
        outcome, message = "stopped" if is_stopped else "killed", ""
    return {"steps": steps, "outcome": "hangs" if hangs else outcome, "message": message}


if __name__ == "__main__":
    _serve()
