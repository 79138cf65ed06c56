"""Options that all commands of a kind share."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import hybridlog as hl
from hybridlog.cli.app import GROUPS
from hybridlog_storage.messages import Channel

from .within import answer

CHANNEL = Channel("/n", "json", None, {})
ABOUT_TOPICS = {"fetch", "intervals", "stats", "align"}


def test_a_topic_is_named(store: Path) -> None:
    for command in ABOUT_TOPICS:
        assert command in GROUPS["Ask"]
        more = ("--to", "scan") if command == "align" else ()
        assert "Missing TOPIC" in answer(command, *more, store=store, code=2).err


@pytest.mark.parametrize(
    "words",
    [
        ("intervals", "scan", "-r", "robot", "--where", "ranges.min < 5"),
        ("stats", "scan", "odom", "-r", "robot"),
        ("check", "scan", "odom", "-r", "robot"),
        ("diff", "robot", "torn"),
    ],
    ids=" ".join,
)
def test_rows_have_all_forms(words: tuple[str, ...], store: Path, tmp_path: Path) -> None:
    code = None if words[0] == "diff" else 0
    rows = answer(*words, "--json", store=store, code=code).json
    assert rows
    file = tmp_path / "rows.parquet"
    answer(*words, "-o", file, "-q", store=store, code=code)
    assert pq.read_table(file).num_rows == len(rows)
    lines = answer(*words, "-F", "jsonl", "-n", "1", store=store, code=code).lines
    assert len(lines) == 1
    assert _set(json.loads(lines[0])) == _set(rows[0])
    assert len(answer(*words, "-n", "1", "--json", store=store, code=code).json) == 1
    both = answer(*words, "--json", "-F", "csv", store=store, code=2).err
    assert "--format and --json exclude each other" in both
    # Rows without a place are not offered the formats of places.
    assert "tum" not in answer(words[0], "--help", store=store).out
    assert (
        "does not give the format"
        in answer(*words, "-o", tmp_path / "a.tum", store=store, code=2).err
    )


def _set(row: dict[str, object]) -> dict[str, object]:
    """The row without its nulls, which few of the forms have."""
    return {name: value for name, value in row.items() if value is not None}


def test_great_integers_beside_fractions(tmp_path: Path) -> None:
    with hl.open(tmp_path / "s", create=True, mongo="none") as store, store.start("r") as recording:
        recording.write(CHANNEL, b'{"whole": 9007199254740993, "half": 0.5}', log_time=1)
    shown = answer("stats", "n", "-F", "csv", store=tmp_path / "s").out
    assert "9007199254740993" in shown
    rows = answer("stats", "n", "--json", store=tmp_path / "s").json
    assert {row["field"]: row["max"] for row in rows} == {"half": 0.5, "whole": 9007199254740993}


def test_what_needs_another_option(store: Path) -> None:
    for words, said in (
        (("keep", "--pin", "-r", "*", "--before", "1s"), "--before is for --at or --when"),
        (("record", "a.bag", "--settle", "3s"), "--settle is for --watch"),
        (("fetch", "scan", "--in-frame", "x", "--count"), "exclude each other"),
    ):
        assert said in answer(*words, store=store, code=2).err
