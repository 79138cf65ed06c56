from __future__ import annotations

import errno
import gc
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from msgspec.structs import replace

import hybridlog.formats
from hybridlog.formats import OUTPUTS, formats_of
from hybridlog.formats.writing import Answer, Sink
from hybridlog_storage.disk import files
from hybridlog_storage.disk.files import (
    beside,
    undo_unfinished,
    undone,
)
from hybridlog_storage.errors import DiskFullError, UsageError
from tests.calls import Calls
from tests.formats.batches import many, ros1_channels

WRITERS = formats_of("lines", "table", "log", "payloads", "points")
DIRECTORIES = [name for name in WRITERS if not OUTPUTS[name].suffixes]
FILES = [name for name in WRITERS if name not in DIRECTORIES]
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw", "latitude", "longitude")
POINTS = np.zeros(5, [(axis, np.float32) for axis in "xyz"])
TABLE = pa.table(
    {
        "log_time": pa.array([1, 2], pa.timestamp("ns", "UTC")),
        **{name: [1.0, 2.0] for name in POSE},
        "name": ["a", "b"],
        "v": [[1, 2], []],
    }
)


def write(name: str, target: object, messages: int = 300, error: type | None = None) -> None:
    """Write something in any format; `error` is raised at its end."""

    def pieces(*given: Any) -> Iterator[Any]:
        yield from given
        if error is not None:
            raise error

    channels = ros1_channels()
    if name == "rosbag2":
        channels = [replace(one, message_encoding="cdr") for one in channels]
    answer = Answer(
        tables=pieces(TABLE),
        lines=pieces(['{"x": 1}'] * 100),
        batches=pieces((many(messages), channels)),
        points=pieces(*((POINTS, "/cloud", "Cloud", n) for n in range(messages))),
    )
    OUTPUTS[name].write(answer, target)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", WRITERS)
def test_an_exception_in_the_answer_aborts(name: str, tmp_path: Path) -> None:
    target = tmp_path / "out"
    if name in FILES:
        target.write_bytes(b"what was there")
    with pytest.raises(KeyError):
        write(name, target, error=KeyError)
    if name in DIRECTORIES:
        assert list(tmp_path.iterdir()) == []
    else:
        assert target.read_bytes() == b"what was there"
        assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("name", FILES)
def test_a_full_disk(name: str) -> None:
    if name == "bag":
        with pytest.raises(UsageError, match="bag is no stream"):
            write(name, "/dev/full")
        return
    with pytest.raises(DiskFullError, match="no space left"):
        write(name, "/dev/full")


@pytest.mark.parametrize("name", WRITERS)
def test_a_disk_that_fills_up_at_the_end(name: str, tmp_path: Path, calls: Calls) -> None:
    for sync in ("fsync", "sync"):
        calls.fail(os, sync, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    with pytest.raises(DiskFullError):
        write(name, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", WRITERS)
def test_wrong_places(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no directory|No such file"):
        write(name, tmp_path / "missing" / "out")
    (tmp_path / "dir" / "inner").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"is a directory|not empty"):
        write(name, tmp_path / "dir")
    with pytest.raises(UsageError, match=r"[Tt]oo long"):
        write(name, tmp_path / ("x" * 300))
    (tmp_path / "dir" / "hybridlog.toml").touch()
    with pytest.raises(UsageError, match="is within the store"):
        write(name, tmp_path / "dir" / "inner" / "out")
    assert list(tmp_path.iterdir()) == [tmp_path / "dir"]


def test_a_pipe_is_written_not_replaced(tmp_path: Path) -> None:
    fifo = tmp_path / "pipe"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    sink = Sink(fifo)
    sink.write(b"abc")
    sink.commit()
    assert os.read(reader, 100) == b"abc"
    os.close(reader)
    assert stat.S_ISFIFO(fifo.stat().st_mode)


def test_a_broken_pipe_stays_one() -> None:
    read, write = os.pipe()
    os.close(read)
    stream = open(write, "wb", buffering=0)  # noqa: PTH123, SIM115
    with pytest.raises(BrokenPipeError):
        Sink(stream).write(b"x")
    stream.close()


def write_few(name: str, target: Path) -> None:
    """What a script does; a command takes back what is unfinished, besides."""
    write(name, target, messages=5)


class Interruption:
    """Ctrl-C at one instant: before the n-th step of the export modules and of the caller.

    A step is a bytecode there, and the call of any function from there.

    Args:
        at: Number of the step, from 1; 0 for none.
    """

    OURS = (str(Path(hybridlog.formats.__file__).parent), files.__file__)

    def __init__(self, at: int) -> None:
        self.at = at
        self.steps = 0

    def __call__(self, frame: FrameType, event: str, arg: object) -> object:
        code = frame.f_code
        ours = code.co_filename.startswith(self.OURS)
        if not ours and code is not write_few.__code__:
            caller = frame.f_back
            if caller is not None and caller.f_code.co_filename.startswith(self.OURS):
                self._step()
            return None
        frame.f_trace_opcodes = True
        self._step()
        return self._within

    def _within(self, frame: FrameType, event: str, arg: object) -> object:
        if event == "opcode":
            self._step()
        return self._within

    def _step(self) -> None:
        self.steps += 1
        if self.steps == self.at:
            raise KeyboardInterrupt


def interrupted(at: int, name: str, target: Path) -> int:
    """Write with an interruption; returns how many steps were done."""
    interruption = Interruption(at)
    before = sys.gettrace()
    try:
        sys.settrace(interruption)  # type: ignore[arg-type]
        write_few(name, target)
    except BaseException:
        # Libraries may make another error of it; what counts is what they leave.
        assert at > 0
    finally:
        sys.settrace(before)
    return interruption.steps


# Files that nobody could close are closed by the collector, which warns.
UNCLOSED = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


@UNCLOSED
@pytest.mark.parametrize("name", WRITERS)
def test_an_interruption_at_any_instant_leaves_the_file_or_nothing(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    for time in range(2):  # what is done once only, such as imports, is not counted
        target = tmp_path / f"whole{time}" / "out"
        target.parent.mkdir()
        steps = interrupted(0, name, target)
    whole = contents(target)
    outcomes = set()
    for at in [*range(1, steps, max(1, steps // 8)), steps]:
        place = tmp_path / str(at)
        place.mkdir()
        interrupted(at, name, place / "out")
        left = [path.name for path in place.iterdir()]
        assert left in ([], ["out"]), at
        assert list(scratch.iterdir()) == [], at
        if left:
            assert contents(place / "out") == whole, at
        outcomes.add(len(left))
    assert outcomes == {0, 1}
    gc.collect()


def contents(path: Path) -> dict[str, bytes]:
    """The bytes of a file, or of all files in a directory."""
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def test_a_child_process_removes_nothing_of_its_parent(tmp_path: Path) -> None:
    file, directory = beside(tmp_path / "out"), beside(tmp_path / "dir")
    file.path.touch()
    directory.path.mkdir()
    (directory.path / "inner").touch()
    child = os.fork()
    if not child:
        try:
            undo_unfinished()
            file.remove()
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert len(list(tmp_path.iterdir())) == 2
    undo_unfinished()
    assert list(tmp_path.iterdir()) == []
    file.path.touch()  # another's by now
    file.remove()
    assert list(tmp_path.iterdir()) == [file.path]


def test_what_was_done_is_undone_when_the_process_is_stopped_or_the_work_fails() -> None:
    done: list[str] = []
    with undone(lambda: done.append("over")):
        pass
    with suppress(ValueError), undone(lambda: done.append("failed")):
        raise ValueError
    with undone(lambda: done.append("outer")), undone(lambda: done.append("inner")):
        child = os.fork()
        if not child:
            undo_unfinished()
            os._exit(len(done) - 1)
        assert os.waitpid(child, 0)[1] == 0
        undo_unfinished()
    undo_unfinished()
    assert done == ["failed", "inner", "outer"]
