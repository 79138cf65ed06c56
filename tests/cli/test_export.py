"""`hybridlog export`."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pyarrow.parquet
import pytest

from tests.independent import read_bag, read_mcap

from .running import run


@pytest.mark.parametrize("form", ["mcap", "bag"])
def test_whole_recordings_are_exact(form: str, logs: Path, store: Path, tmp_path: Path) -> None:
    path = tmp_path / f"x.{form}"
    done = run("export", path, "-r", "robot", store=store)
    found = (read_mcap if form == "mcap" else read_bag)(path)
    assert sorted(found) == sorted(read_bag(logs / "robot.bag"))
    assert f"{path}: {len(found)} messages" in done.err
    refused = run("export", path, "-r", "robot", store=store, code=2)
    assert "--force" in refused.err


@pytest.mark.parametrize("form", ["parquet", "csv"])
def test_tables_get_one_file_a_topic(form: str, logs: Path, store: Path, tmp_path: Path) -> None:
    directory = tmp_path / "new" / "tables"
    topics = {"/imu/data": "imu__data", "/base/scan": "base__scan"}
    options = [word for topic in topics for word in ("-t", topic)]
    run("export", directory, "-F", form, "-r", "robot", *options, store=store)
    assert {p.name for p in directory.iterdir()} == {f"{n}.{form}" for n in topics.values()}
    seen = read_bag(logs / "robot.bag")
    for topic, name in topics.items():
        rows = sum(m.topic == topic for m in seen)
        path = directory / f"{name}.{form}"
        if form == "parquet":
            assert pyarrow.parquet.read_metadata(path).num_rows == rows
        else:
            assert len(path.read_text().splitlines()) == rows + 1


def test_what_is_no_table_is_said_and_left_out(store: Path, tmp_path: Path) -> None:
    done = run("export", tmp_path / "x", "-F", "csv", "-r", "odd", store=store)
    for topic in ("/code", "/recursive", "/cbor", "/no_definition"):
        assert f"{topic} cannot be made a table" in done.err
    assert "0 messages (left out: 3 messages do not fit their definition)" in done.err
    # Three topics whose names fall together without the rule have files of their own.
    assert len(list((tmp_path / "x").glob("a__b*.csv"))) == 3
    run("export", tmp_path / "y", "-F", "csv", "-t", "/code", store=store, code=10)
    assert not (tmp_path / "y").exists()


def test_between(logs: Path, store: Path, tmp_path: Path) -> None:
    run(
        *("export", tmp_path / "x.mcap", "-r", "robot", "-t", "/imu/data"),
        *("--between", "+1s", "+2s", "--quiet"),
        store=store,
    )
    seen = read_bag(logs / "robot.bag")
    start = min(m.log_time for m in seen) + 10**9
    wanted = [m for m in seen if m.topic == "/imu/data" and start <= m.log_time < start + 10**9]
    assert read_mcap(tmp_path / "x.mcap") == wanted


def test_a_topic_beside_the_range_is_said_and_left_out(store: Path, tmp_path: Path) -> None:
    odd = next(r for r in run("ls", "--json", store=store).json if r["recording"] == "odd")
    between = ("--between", f"{odd['start_ns']}ns", f"{odd['last_ns'] + 1}ns")
    topics = ("-t", "/json", "-t", "/base/scan")
    done = run("export", tmp_path / "x", "-F", "csv", *topics, *between, store=store)
    assert [path.name for path in (tmp_path / "x").iterdir()] == ["json.csv"]
    assert "/base/scan: Nothing was recorded between" in done.err
    nothing = ("--between", "1999-01-01", "1999-01-02")
    run("export", tmp_path / "y", "-F", "csv", *topics, *nothing, store=store, code=2)
    assert not (tmp_path / "y").exists()


def test_wrong_targets(store: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    nameless = run("export", tmp_path / "x", store=store, code=2)
    assert "end it in .mcap or .bag, or name a directory" in nameless.err
    run("export", tmp_path / "x.csv", store=store, code=2)
    with contextlib.chdir(tmp_path):
        assert "for a pipe" in run("export", "-", "-F", "mcap", store=store, code=2).err
    run("export", tmp_path / "file", "-F", "csv", "--force", store=store, code=2)
    run("export", tmp_path, "-F", "mcap", "--force", store=store, code=2)
    assert (tmp_path / "file").read_text() == "mine"
