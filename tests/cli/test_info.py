"""`hybridlog ls`, `info`, `schema`."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import hybridlog as hl
from hybridlog.cli.output import quoted
from hybridlog.wording import parse_size
from hybridlog_storage.messages import Channel, Schema
from tests.independent import read_bag

from .odd_log import HOSTILE_NAME
from .running import run

HEADER = b"=" * 80 + b"\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"


def test_ls(logs: Path, store: Path) -> None:
    done = run("ls", store=store)
    assert done.lines[0].split() == [
        "recording", "start", "duration", "topics", "messages", "stored", "note",
    ]  # fmt: skip
    rows = {line.split()[0]: line for line in done.lines[1:]}
    assert set(rows) == {"robot", "odd", "torn"}
    assert "place=lab" in rows["robot"]
    assert "source damaged" in rows["torn"]
    assert f" {len(read_bag(logs / 'robot.bag'))} " in rows["robot"]
    assert done.err == ""


def test_info(logs: Path, store: Path) -> None:
    seen = read_bag(logs / "robot.bag")
    (found,) = run("info", "robot", "--json", store=store).json
    counted = {c["topic"]: (c["messages"], c["payload_bytes"]) for c in found["channels"]}
    for topic in {m.topic for m in seen}:
        mine = [m for m in seen if m.topic == topic]
        assert counted[topic] == (len(mine), sum(len(m.payload) for m in mine))
    scan = next(c for c in found["channels"] if c["topic"] == "/base/scan")
    assert scan["skew_ns"]["min"] <= scan["skew_ns"]["mean"] <= scan["skew_ns"]["max"]
    assert 10 < scan["rate_hz"] < 40
    assert found["coverage"] == "complete"

    text = run("info", "robot", store=store, HYBRIDLOG_MONGO_URI="embedded").out
    assert "coverage   complete" in text
    assert "/base/scan" in text
    assert "sensor_msgs/LaserScan" in text
    assert "latched" in text
    assert re.search(r"^index +embedded *$", text, re.MULTILINE)
    assert re.search(rf"^id +{found['id']} *$", text, re.MULTILINE)
    assert re.fullmatch("[0-9]{8}-robot-[0-9a-f]{16}", found["id"])


def test_info_without_a_name_shows_all_and_the_losses(store: Path) -> None:
    done = run("info", store=store)
    for name in ("robot", "odd", "torn"):
        assert f"recording  {name}" in done.out
    assert "lost, source damaged: torn.bag at byte" in done.out
    assert done.err == ""


def test_stamps_that_were_not_set_are_no_delay(tmp_path: Path) -> None:
    kind = Schema("test_msgs/A", "ros1msg", b"Header header\n" + HEADER)
    stamps = {"/never": [0, 0], "/late": [0, 5], "/all": [5, 5]}
    with (
        hl.open(tmp_path / "s", create=True, mongo="none") as store,
        store.start("mine") as recording,
    ):
        for topic, seconds in stamps.items():
            channel = Channel(topic, "ros1", kind)
            for sec in seconds:
                payload = struct.pack("<4I", 0, sec, 0, 0)
                recording.write(channel, payload, log_time=7 * 10**9)
    told = {
        line.split()[0]: line for line in run("info", "mine", store=tmp_path / "s").lines if line
    }
    assert "  not set" in told["/never"]
    assert "  2s" in told["/late"]
    assert told["/late"].endswith("  1 stamp not set")
    assert "  2s" in told["/all"]
    found = run("info", "mine", "--json", store=tmp_path / "s").json[0]["channels"]
    given = {one["topic"]: (one["skew_ns"] and one["skew_ns"]["mean"]) for one in found}
    assert given == {"/never": None, "/late": 2e9, "/all": 2e9}
    assert {one["topic"]: one["unset_stamps"] for one in found}["/late"] == 1
    with hl.open(tmp_path / "s", mongo="none") as store:
        rows = store.sql("select topic, mean_skew, unset_stamps from topics order by all").rows()
        assert rows == [("/all", 2e9, 0), ("/late", 2e9, 1), ("/never", None, 2)]


def test_schema(store: Path) -> None:
    done = run("info", "-t", "scan", store=store)
    assert done.lines[0].startswith("/base/scan  sensor_msgs/LaserScan  (ros1")
    assert any(line.split()[:2] == ["ranges", "float32[]"] for line in done.lines)
    assert "ranges.min, ranges.max, ranges.mean, ranges.n" in done.out
    assert "float32[] ranges" in done.out

    (found,) = run("info", "-t", "/base/scan", "--recording", "robot", "--json", store=store).json
    fields = {f["path"]: f["type"] for f in found["fields"]}
    assert fields["header.stamp"] == "time"
    assert fields["angle_min"] == "float32"


def test_control_characters_are_shown_not_obeyed(store: Path) -> None:
    shown = ""
    for command in (("info", "odd"), ("fetch", "-t", "*x", "-F", "table"), ("fetch", "-t", "r/x")):
        done = run(*command, store=store, code=None)
        assert "\x1b" not in done.out + done.err
        assert "\x07" not in done.out + done.err
        shown += done.out
    assert "/\\x1b[31mred\\x07\\n/x" in shown
    assert "\\x1b[2Jboo" in shown
    found = run("info", "odd", "--json", store=store)
    assert HOSTILE_NAME in {c["topic"] for c in found.json[0]["channels"]}
    assert "\x1b" not in found.out


def test_sizes_and_names_as_they_are_typed() -> None:
    assert parse_size("100TB") == 10**14
    assert parse_size("1 TiB") == 1 << 40
    assert quoted("b\udcff\x1b") == "'b\\xff\\x1b'"
