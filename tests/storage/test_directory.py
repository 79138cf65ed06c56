"""The store on disk."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from hybridlog_storage.directory import StoreDirectory, check_recording_id
from hybridlog_storage.errors import StoreError, UsageError


@pytest.fixture
def store(tmp_path: Path) -> StoreDirectory:
    return StoreDirectory.create(tmp_path / "store")


def test_a_new_store(tmp_path: Path) -> None:
    made = StoreDirectory.create(tmp_path / "deep/er/store")
    values = tomllib.loads((made.path / "hybridlog.toml").read_text())
    assert values == {"format": 1, "store_id": made.settings.store_id}
    assert made.settings.mongo is None
    assert made.recording_ids() == []
    again = StoreDirectory.create(made.path)
    assert again.settings == made.settings == StoreDirectory(made.path).settings
    other = StoreDirectory.create(tmp_path / "other")
    assert other.settings.store_id != made.settings.store_id


@pytest.mark.parametrize("uri", ["mongodb://h/db", 'mongodb://a:"p\\w"@h/ä?x=y', "mongodb://h/\t"])
def test_a_uri_is_kept(tmp_path: Path, uri: str) -> None:
    StoreDirectory.create(tmp_path / "store", mongo=uri)
    assert StoreDirectory(tmp_path / "store").settings.mongo == uri


def test_an_empty_directory_becomes_a_store(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    assert StoreDirectory.create(tmp_path / "store").recording_ids() == []


def test_what_is_no_place_for_a_store(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/precious.txt").write_text("x")
    with pytest.raises(StoreError, match="is a file"):
        StoreDirectory.create(tmp_path / "file")
    with pytest.raises(StoreError, match="holds files"):
        StoreDirectory.create(tmp_path / "full")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "full", "precious.txt"]
    with pytest.raises(StoreError, match="no such directory"):
        StoreDirectory(tmp_path / "nothing")
    with pytest.raises(StoreError, match=r"no hybridlog\.toml"):
        StoreDirectory(tmp_path / "full")
    with pytest.raises(StoreError, match="is a file"):
        StoreDirectory(tmp_path / "file")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "format"),
        (b"format = 'one'", "format"),
        (b"format = 0", "format"),
        (b"format = 2\nstore_id = 'x'", "newer"),
        (b"format = 1", "store_id"),
        (b"format = 1\nstore_id = ''", "store_id"),
        (b"format = 1\nstore_id = 5", "store_id"),
        (b"format = 1\nstore_id = 'x'\nmongo = 1", "mongo"),
        (b"format = [", "damaged"),
        (b"\xff\xfe", "damaged"),
        (b"format = " + b"[" * 100_000, "damaged"),
        (b"#" * (2 << 20), "too large"),
    ],
)
def test_settings_that_are_none(store: StoreDirectory, content: bytes, words: str) -> None:
    (store.path / "hybridlog.toml").write_bytes(content)
    with pytest.raises(StoreError, match=words):
        StoreDirectory(store.path)
    with pytest.raises(StoreError, match=words):
        StoreDirectory.create(store.path)


def test_settings_of_a_later_version_may_say_more(store: StoreDirectory) -> None:
    with (store.path / "hybridlog.toml").open("a") as file:
        file.write("colour = 'blue'\n")
    assert StoreDirectory(store.path).settings == store.settings


def test_many_make_the_same_store_at_once(tmp_path: Path) -> None:
    for turn in range(20):
        path = tmp_path / f"store{turn}"
        made: list[object] = []
        start = threading.Barrier(4)

        def make(
            path: Path = path,
            made: list[object] = made,
            wait: Callable[[], int] = start.wait,
        ) -> None:
            wait()
            try:
                made.append(StoreDirectory.create(path).settings.store_id)
            except StoreError as error:
                made.append(error)

        threads = [threading.Thread(target=make) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert set(made) == {StoreDirectory(path).settings.store_id}
        assert sorted(p.name for p in path.iterdir()) == ["hybridlog.toml", "recordings"]


@pytest.mark.parametrize(
    ("name", "recording_id"),
    [
        ("robot", "robot"),
        ("my run/1", "my-run-1"),
        ("../../etc", "etc"),
        (".hidden", "hidden"),
        ("--all", "all"),
        ("", "recording"),
        ("...", "recording"),
        ("äöü", "recording"),
        ("x" * 300, "x" * 80),
        ("a\0b\nc", "a-b-c"),
    ],
)
def test_names_become_directories(store: StoreDirectory, name: str, recording_id: str) -> None:
    first, second = store.new_recording(name), store.new_recording(name)
    assert (first, second) == (recording_id, f"{recording_id}-2")
    for made in (first, second):
        assert check_recording_id(made) == made
        assert store.recording(made).parent == store.path / "recordings"
    assert store.recording_ids() == sorted([first, second])


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "/a", ".x", "a b", "a\n", "ä"])
def test_ids_that_are_no_plain_names(name: str) -> None:
    with pytest.raises(UsageError):
        check_recording_id(name)


def test_segments_are_told_by_their_numbers(store: StoreDirectory) -> None:
    recording = store.recording(store.new_recording("r"))
    names = ["000010.mcap", "000002.mcap", "000003.mcap.open", "x.mcap", "-1.mcap", "٣.mcap",
             "000001.mcap.tmp", "1.bag", "writer.lock"]  # fmt: skip
    for name in names:
        (recording / name).write_bytes(b"")
    assert [n for n, _ in store.segments("r")] == [2, 10]
    assert [n for n, _ in store.open_segments("r")] == [3]
    assert store.segments("nothing") == []


def test_other_things_among_the_recordings(store: StoreDirectory, tmp_path: Path) -> None:
    base = store.path / "recordings"
    (base / "file").write_text("")
    (base / ".removed-x-1").mkdir()
    (base / "link").symlink_to(tmp_path)
    store.new_recording("r")
    assert store.recording_ids() == ["r"]
    base.rename(base.with_name("elsewhere"))
    assert store.recording_ids() == []


def test_removing(store: StoreDirectory) -> None:
    recording = store.recording(store.new_recording("r"))
    (recording / "000000.mcap").write_bytes(b"x")
    store.remove_recording("r")
    assert list((store.path / "recordings").iterdir()) == []
    with pytest.raises(StoreError, match="removing"):
        store.remove_recording("r")


HOLD = """
import sys
from pathlib import Path
from hybridlog_storage.directory import StoreDirectory
with StoreDirectory(Path(sys.argv[1])).writing("r") as mine:
    print(mine, flush=True)
    sys.stdin.read()
"""


def test_one_process_writes_a_recording(store: StoreDirectory) -> None:
    store.new_recording("r")
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(store.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "True\n"
    with store.writing("r") as mine:
        assert not mine
    # What is killed lets go.
    other.kill()
    other.communicate()
    with store.writing("r") as mine:
        assert mine
        with store.writing("r") as again:
            assert not again
    with store.writing("r") as mine:
        assert mine


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_store_that_cannot_be_written(store: StoreDirectory) -> None:
    recordings = store.path / "recordings"
    recordings.chmod(0o555)
    try:
        with pytest.raises(StoreError, match="read-only"):
            store.check_writable()
        with pytest.raises(StoreError, match="Not allowed"):
            store.new_recording("r")
    finally:
        recordings.chmod(0o755)
    store.check_writable()
