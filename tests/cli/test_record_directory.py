"""`hybridlog record DIR`, once and with `--watch`."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.cli.signals import Stopped
from hybridlog_storage import stopping
from hybridlog_storage.errors import DatabaseError
from tests import places
from tests.calls import Calls
from tests.formats.test_find import METADATA, mcap
from tests.waiting import wait_for

from .running import run, started


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture
def top(tmp_path: Path) -> Path:
    """Four logs: one alone, one split, and a bag of two files."""
    path = tmp_path / "logs"
    mcap(path / "a.mcap", 1)
    mcap(path / "split" / "run_0.mcap", 2)
    mcap(path / "split" / "run_1.mcap", 3)
    mcap(path / "split" / "other.mcap", 4)
    mcap(path / "bag" / "x_0.mcap", 5)
    mcap(path / "bag" / "x_1.mcap", 6)
    (path / "bag" / "metadata.yaml").write_text(METADATA.format(files="x_0.mcap, x_1.mcap"))
    return path


def record(store: Path, *words: object) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of `record`."""
    done = run("record", *words, store=store, code=None)
    return done.code, done.out, done.err


def counts(store: Path) -> dict[str, int]:
    with hl.open(store) as opened:
        return {one.name: one.messages for one in opened.session.look().summaries}


def test_all_logs_below_a_directory_are_recorded_once(top: Path, store: Path) -> None:
    code, out, err = record(store, top)
    assert code == 0
    assert counts(store) == {"a": 1, "run": 5, "other": 4, "bag": 11}
    assert {line.partition(":")[0] for line in out.splitlines()} == {"a", "bag", "other", "run"}
    assert err.endswith("4 logs recorded, 0 in the store already, 0 not recorded.\n")
    mcap(top / "new" / "late.mcap", 7)
    code, out, err = record(store, top, "--json")
    assert code == 0
    assert [("known" in one, one.get("messages")) for one in map(json.loads, out.splitlines())] == [
        (True, None), (True, None), (False, 7), (True, None), (True, None),
    ]  # fmt: skip
    assert err.endswith("1 log recorded, 4 in the store already, 0 not recorded.\n")
    # A part of a log that is there is there, too, and so is a log of parts that are.
    assert "is in the store already, as 'run'" in record(store, top / "split" / "run_1.mcap")[2]
    assert record(store, top / "bag")[0] == 8
    assert len(counts(store)) == 5


def test_one_error_does_not_stop_the_others(top: Path, store: Path) -> None:
    (top / "aa.bag").write_text("no bag")
    (top / "empty.mcap").touch()
    mcap(top / "torn.mcap", 3, whole=False)
    inner = top / "inner"
    inner.mkdir()
    (inner / "hybridlog.toml").touch()
    mcap(places.new_folder(inner, "r") / "000000.mcap")
    code, _, err = record(store, top, "-q")
    assert code == 3  # of the first error
    assert counts(store) == {"a": 1, "run": 5, "other": 4, "bag": 11, "torn": 3}
    assert err.count("aa.bag: not a log of a known kind") == 1


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Sets what happens between the looks of a watch; then it is stopped."""

    def set_steps(*steps: Callable[[], object]) -> None:
        waiting: Iterator[Callable[[], object]] = iter(steps)

        def pause(_seconds: float) -> None:
            step = next(waiting, None)
            if step is None:
                raise Stopped(signal.SIGINT)
            step()

        monkeypatch.setattr(stopping, "pause", pause)

    return set_steps


def nothing() -> None:
    """Only time passes."""


def test_a_watched_bag_grows(tmp_path: Path, store: Path, looks: Callable[..., None]) -> None:
    bag = tmp_path / "logs" / "bag"
    mcap(bag / "bag_0.mcap", 2, whole=False)
    mcap(bag.parent / "old.mcap", 1)
    looks(
        nothing,
        lambda: (mcap(bag / "bag_0.mcap", 2), mcap(bag / "bag_1.mcap", 3, whole=False)),
        nothing,
        nothing,
        lambda: (
            mcap(bag / "bag_1.mcap", 3),
            (bag / "metadata.yaml").write_text(METADATA.format(files="bag_0.mcap, bag_1.mcap")),
            mcap(bag.parent / "going.mcap", 9, whole=False),
        ),
        nothing,
        nothing,
    )
    code, out, err = record(store, bag.parent, "--watch")
    assert code == 0
    assert [line.partition(",")[0] for line in out.splitlines()] == [
        "old: 1 message", "bag_0: 2 messages", "bag_1: 3 messages",
    ]  # fmt: skip
    assert f"Watching {bag.parent}. Ctrl-C ends it." in err
    assert f"Not complete: {bag.parent / 'going.mcap'}." in err
    assert err.endswith("3 logs recorded, 0 in the store already, 0 not recorded.\n")
    # The next watch, and a search, find all of it in the store.
    looks(nothing, lambda: (bag.parent / "going.mcap").write_text("no log"), nothing, nothing)
    code, out, err = record(store, bag.parent, "--watch", "--json", "--settle", "0s")
    assert [set(json.loads(line)) for line in out.splitlines()[:2]] == [{"path", "known"}] * 2
    assert counts(store) == {"old": 1, "bag_0": 2, "bag_1": 3}


def test_a_watch_goes_on_after_errors(
    top: Path, store: Path, looks: Callable[..., None], calls: Calls
) -> None:
    (top / "bad.db3").write_bytes(b"SQLite format 3\0" + bytes(84))
    away = iter([True, True])

    def sometimes(*_: object, **__: object) -> None:
        if next(away, False):
            raise DatabaseError("MongoDB is on holiday.")

    calls(hl.Store, "record", sometimes)
    looks(nothing, nothing, nothing)
    code, _, err = record(store, top, "--watch", "--settle", "0s")
    assert code == 6
    assert counts(store) == {"a": 1, "run_0": 2, "run_1": 3, "other": 4, "bag": 11}
    assert err.count("MongoDB is on holiday.") == 1
    assert "2 not recorded" in err
    assert "bad.db3" in err


def test_a_signal_ends_a_watch_normally(top: Path, store: Path) -> None:
    out = store.parent / "out"
    words = ("record", top, "--watch", "--settle", "0s", "--store", store)
    with started(*words, output=out) as process:
        wait_for(lambda: len(re.findall("messages?, ", out.read_text())) == 5)
        process.terminate()
        assert process.wait(60) == 0
    assert "5 logs recorded" in out.read_text()
    assert "Traceback" not in out.read_text()
