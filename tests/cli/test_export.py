"""`hybridlog export`."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import hybridlog as hl
from hybridlog_storage.messages import Channel

from .running import run


def test_what_is_no_table_is_said_and_left_out(store: Path, tmp_path: Path) -> None:
    done = run("export", tmp_path / "x", "-F", "csv", "-r", "odd", store=store)
    for topic in ("/code", "/recursive", "/cbor", "/no_definition"):
        assert f"{topic} cannot be made a table" in done.err
    assert "long.csv: 0 messages of /long, " in done.err
    assert "3 messages do not fit their definition: not in this answer" in done.err
    # Three topics whose names fall together without the rule have files of their own.
    assert len(list((tmp_path / "x").glob("a__b*.csv"))) == 3
    run("export", tmp_path / "y", "-F", "csv", "-t", "/code", store=store, code=10)
    assert not (tmp_path / "y").exists()


def test_names_that_differ_in_case_alone_are_files_on_any_disk(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        with store.start("run") as recording:
            for topic in ("/Scan", "/scan", "/SCAN"):
                channel = Channel(topic, "json", None, {})
                recording.write(channel, json.dumps({"on": topic}).encode(), log_time=10**18)
    run("export", tmp_path / "x", "-F", "csv", store=tmp_path / "store")
    files = {path.name.casefold(): path.read_text() for path in (tmp_path / "x").iterdir()}
    assert len(files) == 3
    assert all(f"/{name}" in "".join(files.values()) for name in ("Scan", "scan", "SCAN"))


def test_a_topic_beside_the_range_is_said_and_left_out(store: Path, tmp_path: Path) -> None:
    odd = next(r for r in run("ls", "--json", store=store).json if r["name"] == "odd")
    between = ("--between", f"{odd['first_ns']}ns", f"{odd['last_ns'] + 1}ns")
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
    assert "add --format, or end it in .mcap, .bag." in nameless.err
    run("export", tmp_path / "x.csv", store=store, code=2)
    with contextlib.chdir(tmp_path):
        assert "for a pipe" in run("export", "-", "-F", "mcap", store=store, code=2).err
    run("export", tmp_path / "file", "-F", "csv", "--force", store=store, code=2)
    run("export", tmp_path, "-F", "mcap", "--force", store=store, code=2)
    assert (tmp_path / "file").read_text() == "mine"
