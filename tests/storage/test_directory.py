"""The store on disk."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from hybridlog_storage.cells import put
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import LOCK, Holder, StoreDirectory
from hybridlog_storage.errors import HeldError, TopicError
from tests import places
from tests.waiting import at_once


@pytest.fixture
def store(tmp_path: Path) -> StoreDirectory:
    return StoreDirectory.create(tmp_path / "store")


def test_a_new_store(tmp_path: Path) -> None:
    made = StoreDirectory.create(tmp_path / "deep/er/store")
    values = tomllib.loads((made.path / "hybridlog.toml").read_text())
    assert values == {"format": 4, "store_id": made.settings.store_id}
    assert made.settings.mongo is None
    assert made.ids() == []
    again = StoreDirectory.create(made.path)
    assert again.settings == made.settings == StoreDirectory(made.path).settings
    other = StoreDirectory.create(tmp_path / "other")
    assert other.settings.store_id != made.settings.store_id


def made(store: StoreDirectory, name: str = "r") -> Path:
    files.make_folders(store.recording(name))
    return store.recording(name)


def test_many_make_the_same_store_at_once(tmp_path: Path) -> None:
    for turn in range(5):
        path = tmp_path / f"store{turn}"
        made: list[StoreDirectory] = []
        at_once(*[lambda path=path, made=made: made.append(StoreDirectory.create(path))] * 4)
        assert {one.settings.store_id for one in made} == {StoreDirectory(path).settings.store_id}
        names = sorted(p.name for p in path.iterdir())
        assert (len(made), names) == (4, ["hybridlog.toml", "manifests", "recordings"])


def test_segments_are_told_by_their_numbers(store: StoreDirectory) -> None:
    recording = made(store)
    names = ["000010.mcap", "000002.mcap", "000003.mcap.open", "x.mcap", "-1.mcap", "٣.mcap",
             "000001.mcap.tmp", "1.bag", "writer.lock"]  # fmt: skip
    for name in names:
        (recording / name).write_bytes(b"")
    assert [n for n, _ in places.segments(store.path, "r")] == [2, 10]
    assert [*store.listing("r").open] == [3]
    assert places.segments(store.path, "nothing") == []


HOLD = """
import sys
from pathlib import Path
from hybridlog_storage.disk.directory import StoreDirectory
store, kind = sys.argv[1:]
with StoreDirectory(Path(store)).writing("r", records=kind == "records"):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def holding(store: StoreDirectory, *, as_: str) -> Iterator[int]:
    """A process that holds the recording `r` until it is killed; its id."""
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(store.path), as_],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        yield other.pid
    finally:
        other.kill()
        other.communicate()


def test_one_process_writes_a_recording_and_its_lock_says_which(store: StoreDirectory) -> None:
    made(store)
    for kind, what in (("changes", "changed"), ("records", "written")):
        with holding(store, as_=kind) as pid:
            assert store.holder("r") == Holder(f"process {pid}", is_recording=kind == "records")
            refused = pytest.raises(HeldError, match=rf"'r' is being {what} by process {pid}\.")
            with refused, store.writing("r", wait_s=600 if kind == "records" else 0):
                pass  # a recorder is not waited for
    # What is killed lets go.
    with store.writing("r"):
        with pytest.raises(HeldError, match=f"process {os.getpid()}"), store.writing("r"):
            pass
        assert store.holder("r") is not None
    assert store.holder("r") is None
    assert (store.recording("r") / LOCK).read_bytes() == b""
    for odd in (b"", b"1", b"1 2", b"\xff" * 300, b"7 1\ny", b"1 0 x"):
        with store.writing("r"):
            (store.recording("r") / LOCK).write_bytes(odd)
            assert store.holder("r") == Holder("another process", is_recording=False)


def test_a_command_waits_for_another_one(store: StoreDirectory) -> None:
    made(store)
    with ExitStack() as held, ThreadPoolExecutor(1) as pool:
        held.enter_context(store.writing("r"))

        def wait() -> str:
            with store.writing("r", wait_s=60):
                return "r"

        waiting = pool.submit(wait)
        with pytest.raises(TimeoutError):
            waiting.result(0.2)
        held.close()
        assert waiting.result(60) == "r"
    # A look at the lock takes it for a moment, when its line may be that of a killed recorder.
    with ExitStack() as held, ThreadPoolExecutor(1) as pool:
        fd = os.open(store.recording("r") / LOCK, os.O_RDONLY)
        held.callback(os.close, fd)
        fcntl.flock(fd, fcntl.LOCK_SH)
        waiting = pool.submit(wait)
        with pytest.raises(TimeoutError):
            waiting.result(0.1)
        held.close()
        assert waiting.result(60) == "r"


def test_a_recording_that_was_removed_is_not_locked(
    store: StoreDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("", "run"):
        with (
            pytest.raises(TopicError, match=f"'{name or 'gone'}' is no longer in the store"),
            store.writing("gone", name),
        ):
            pass
    made(store)
    open_file = files.open_file

    def opened(path: Path, *args: Any, **options: Any) -> int:
        found: int = open_file(path, *args, **options)
        files.remove_tree(store.recording("r"))
        return found

    monkeypatch.setattr(files, "open_file", opened)
    with pytest.raises(TopicError, match="no longer in the store"), store.writing("r"):
        pass


def test_the_catalog_of_a_store_that_is_not_written_lies_in_the_users_cache(
    store: StoreDirectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    before = [*store.path.iterdir()]
    for _ in range(2):
        cells = StoreDirectory(store.path, read_only=True).cells
        found = cells.read("a", "b")
        cells.write([put("a", "b", b"c")])
        cells.close()
    assert found == b"c"
    assert [*store.path.iterdir()] == before
    assert len([*tmp_path.glob("cache/**/*.sqlite")]) == 1
