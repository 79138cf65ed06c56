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

from hybridlog_storage.directory import REMOVED, StoreDirectory
from hybridlog_storage.errors import StoreError
from tests.other_user import User, needs_root, open_place


@pytest.fixture
def store(tmp_path: Path) -> StoreDirectory:
    return StoreDirectory.create(tmp_path / "store")


def test_a_new_store(tmp_path: Path) -> None:
    made = StoreDirectory.create(tmp_path / "deep/er/store")
    values = tomllib.loads((made.path / "hybridlog.toml").read_text())
    assert values == {"format": 2, "store_id": made.settings.store_id}
    assert made.settings.mongo is None
    assert made.labels() == []
    again = StoreDirectory.create(made.path)
    assert again.settings == made.settings == StoreDirectory(made.path).settings
    other = StoreDirectory.create(tmp_path / "other")
    assert other.settings.store_id != made.settings.store_id


@pytest.mark.parametrize("uri", ["mongodb://h/db", "mongodb://a:p%5Cw@h/ä?x=y"])
def test_a_uri_is_kept_without_its_password(tmp_path: Path, uri: str) -> None:
    StoreDirectory.create(tmp_path / "store", mongo=uri)
    assert StoreDirectory(tmp_path / "store").settings.mongo == uri.replace(":p%5Cw", "")


def test_an_empty_directory_becomes_a_store(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    assert StoreDirectory.create(tmp_path / "store").labels() == []


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
    ("content", "words"), [(b"", "format"), (b"format = 1\nstore_id = 'x'", "no longer read")]
)
def test_settings_that_are_none(store: StoreDirectory, content: bytes, words: str) -> None:
    (store.path / "hybridlog.toml").write_bytes(content)
    with pytest.raises(StoreError, match=words):
        StoreDirectory(store.path)
    with pytest.raises(StoreError, match=words):
        StoreDirectory.create(store.path)


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
    ("name", "label"),
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
def test_names_become_directories(store: StoreDirectory, name: str, label: str) -> None:
    first, second = store.new_recording(name), store.new_recording(name)
    assert (first, second) == (label, f"{label}-2")
    for made in (first, second):
        assert store.recording(made).parent == store.path / "recordings"
    assert store.labels() == sorted([first, second])


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
    assert store.labels() == ["r"]
    base.rename(base.with_name("elsewhere"))
    assert store.labels() == []


def test_removing(store: StoreDirectory) -> None:
    recording = store.recording(store.new_recording("r"))
    (recording / "000000.mcap").write_bytes(b"x")
    hidden = store.hide("r")
    assert store.labels() == []
    assert hidden.startswith(REMOVED)
    assert store.names() == [hidden]
    assert (store.recording(hidden) / "000000.mcap").read_bytes() == b"x"
    store.sweep(hidden)
    assert list((store.path / "recordings").iterdir()) == []
    store.sweep(hidden)  # somebody else was quicker
    with pytest.raises(StoreError, match="renaming"):
        store.hide("r")


def test_what_a_recording_looks_like_changes_with_its_files(store: StoreDirectory) -> None:
    recording = store.recording(store.new_recording("r"))
    seen = [store.listing("r").print]

    def changed() -> bool:
        seen.append(store.listing("r").print)
        return seen[-1] not in seen[:-1]

    (recording / "journal").write_bytes(b"one\n")
    assert changed()
    (recording / "000000.mcap").write_bytes(b"segment")
    assert changed()
    (recording / "journal").write_bytes(b"two\n")
    assert changed()
    (recording / "000000.mcap").rename(recording / "000001.mcap")
    assert changed()
    (recording / "000002.mcap.open").write_bytes(b"")
    assert changed()
    (recording / "notes.txt").write_bytes(b"x")
    assert not changed()
    recording.rename(recording.with_name("s"))
    assert store.listing("s").print == seen[-1]


def test_a_label_that_is_free(store: StoreDirectory) -> None:
    store.new_recording("a")
    store.new_recording("b")
    assert store.free_label("a") == "a-2"
    assert store.free_label("a", but="a") == "a"
    assert store.free_label("c d", but="b") == "c-d"
    store.move("b", "c-d")
    assert store.labels() == ["a", "c-d"]
    assert store.has("c-d")
    assert not store.has("b")


HOLD = """
import sys
from pathlib import Path
from hybridlog_storage.directory import REMOVED, StoreDirectory
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


@pytest.mark.skipif(os.geteuid() == 0, reason="the next test does the same as another user")
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


AS_A_READER = """
import sys
from pathlib import Path
from hybridlog_storage.directory import StoreDirectory
from hybridlog_storage.errors import StoreError
store = StoreDirectory(Path(sys.argv[1]))
for step in (store.check_writable, lambda: store.new_recording("r")):
    try:
        step()
    except StoreError as error:
        print(error)
"""


@needs_root
def test_a_store_that_another_user_cannot_write() -> None:
    with open_place() as place:
        store = StoreDirectory.create(place / "store")
        done = User(place).python("-c", AS_A_READER, store.path)
        assert "read-only" in done.lines[0]
        assert "Not allowed" in done.lines[1]
        assert store.labels() == []
        for path in (store.path, store.path / "recordings"):
            path.chmod(0o777)
        assert User(place).python("-c", AS_A_READER, store.path).lines == []
        assert store.labels() == ["r"]
