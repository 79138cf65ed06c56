"""`hybridlog record`."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import pytest

from tests import places
from tests.independent import read_bag
from tests.json_schemas import misfit, schema_of

from .running import run


def test_a_line_says_what_is_recorded(logs: Path, tmp_path: Path) -> None:
    done = run("record", logs / "small.bag", "--store", tmp_path / "s")
    many = len(read_bag(logs / "small.bag"))
    assert re.fullmatch(rf"small: {many} messages, [\d.]+ [kM]B, from \S+small.bag\n", done.out)
    assert done.err == ""


@pytest.mark.mongo
def test_json_is_exact(logs: Path, tmp_path: Path) -> None:
    done = run("record", logs / "small.bag", "--store", tmp_path / "s", "--json").json
    seen = read_bag(logs / "small.bag")
    stored = sum(p.stat().st_size for p in places.folder(tmp_path / "s", "small").glob("*.mcap"))
    assert done["messages"] == done["messages_indexed"] == len(seen)
    assert done["bytes_in"] == (logs / "small.bag").stat().st_size
    assert done["stored_bytes"] == stored
    assert done["damage"] == []
    assert not misfit(done, schema_of(["record"]))


def test_choices(logs: Path, tmp_path: Path) -> None:
    seen = read_bag(logs / "small.bag")
    start = min(m.log_time for m in seen)
    run(
        *("record", logs / "small.bag", "--name", "my run/1"),
        *("--set-tag", "a=b=c", "--set-tag", "d="),
        *("--topic", "imu/*", "--topic", "scan", "--exclude", "re:.*scan"),
        *("--between", "+1s", "+2s", "--compression", "lz4"),
        store=tmp_path / "s",
    )
    wanted = [m for m in seen if m.topic == "/imu/data" and 10**9 <= m.log_time - start < 2 * 10**9]
    found = run("info", "--json", store=tmp_path / "s").json[0]
    assert found["name"] == "my run-1"
    assert found["tags"] == {"a": "b=c", "d": ""}
    assert [(c["topic"], c["messages"]) for c in found["channels"]] == [("/imu/data", len(wanted))]

    from mcap.reader import make_reader

    with places.segment(tmp_path / "s", found["name"]).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {c.compression for c in summary.chunk_indexes} <= {"lz4", ""}


@pytest.mark.mongo
def test_what_cannot_be_indexed_is_said(logs: Path, tmp_path: Path) -> None:
    done = run("record", logs / "odd.mcap", "--json", store=tmp_path / "s")
    for topic in ("/code", "/recursive", "/no_definition", "/cbor"):
        assert f"{topic}: not indexed beyond time" in done.err
    assert "/long: 3 messages do not fit their definition" in done.err
    assert "__import__" in done.err
    assert done.json["messages_indexed"] == 36


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--set-tag", "a"), "KEY=VALUE"),
        (("--topic", r"re:(a)\1"), "refused"),
        (("--between", "x", "y"), "not a time"),
        (("--between", "+2s", "+1s"), "the range is empty"),
        (("--between", "2000-01-01", "2000-01-02"), "it spans"),
        (("--topic", "/nothing"), "/imu/data"),
        (("--mongo", "http://x"), "connection string"),
        (("--level", "40"), "level"),
    ],
)
def test_wrong_options(logs: Path, tmp_path: Path, options: tuple[str, ...], words: str) -> None:
    done = run("record", logs / "small.bag", *options, store=tmp_path / "s", code=2)
    assert words in done.err
    assert done.out == ""
    assert not (tmp_path / "s").exists() or places.names(tmp_path / "s") == []


def test_a_log_that_gives_nothing_makes_no_store(tmp_path: Path) -> None:
    files = {
        "empty.bag": b"",
        "text.mcap": b"hello, this is no log",
        "magic.bag": b"#ROSBAG V2.0\n",
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        done = run("record", tmp_path / name, "--json", store=tmp_path / "s", code=3)
        assert name in done.err
        refused = done.json
        assert (refused["path"], refused["exit_code"]) == (str(tmp_path / name), 3)
    run("record", *(tmp_path / name for name in files), store=tmp_path / "s", code=3)
    run("record", tmp_path, store=tmp_path / "s", code=3)
    assert not (tmp_path / "s").exists()


def test_a_damaged_log_says_where(logs: Path, tmp_path: Path) -> None:
    done = run("record", logs / "torn.bag", "--json", store=tmp_path / "s", code=4)
    assert "torn.bag is damaged" in done.err
    (damage,) = done.json["damage"]
    assert damage["file"].endswith("torn.bag")
    assert 0 < damage["offset"] <= (logs / "torn.bag").stat().st_size
    run("verify", store=tmp_path / "s")


def test_names_that_are_no_utf_8(logs: Path, tmp_path: Path) -> None:
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.mcap"))
    shutil.copy(logs / "odd.mcap", odd)
    tag = os.fsdecode(b"who=Ren\xe9")
    run("record", odd, "--set-tag", tag, "-q", store=tmp_path / "s")
    (found,) = run("ls", "--json", store=tmp_path / "s").json
    assert found["name"] == "caf\\xe9"
    assert found["tags"] == {"who": "Ren\\xe9"}
    assert "all is well" in run("verify", store=tmp_path / "s").out
