"""`hybridlog tf`."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from .running import run

ROBOT = ("tf", "-r", "robot")


def rows(store: Path, *args: str) -> list[dict[str, str]]:
    return [*csv.DictReader(io.StringIO(run(*ROBOT, *args, "-F", "csv", "-q", store=store).out))]


def test_the_tree(store: Path) -> None:
    frames = {row["frame"]: row for row in rows(store)}
    assert frames["base_link"]["parent"] == "odom"
    assert frames["base_laser_link"]["is_static"] == "true"
    assert frames["map"]["parent"] == ""
    lines = run(*ROBOT, "-F", "table", store=store).out.splitlines()
    assert [line for line in lines if line.startswith("    base_link ")]


def test_transforms_at_times(store: Path) -> None:
    at = rows(store, "odom", "base_link", "--at", "+1s", "--at", "+2s")
    assert len(at) == 2
    steps = rows(store, "odom", "base_link", "--step", "1s", "--between", "+1s", "+2.5s")
    assert [row["x"] for row in steps] == [row["x"] for row in at]
    last = rows(store, "odom", "base_link")
    assert len(last) == 1


def test_at_the_messages_of_a_topic(store: Path) -> None:
    """Their headers name the frame that is transformed from."""
    given = rows(store, "odom", "-t", "scan")
    assert given == rows(store, "odom", "base_laser_link", "-t", "scan")
    some = rows(store, "odom", "-t", "scan", "--between", "+1s", "+2s")
    assert 0 < len(some) < len(given)


def test_times_without_a_transform(store: Path) -> None:
    found = run(*ROBOT, "odom", "base_link", "--at", "+1s", "--at", "+99s", store=store)
    one, other = map(json.loads, found.out.splitlines())
    assert one["x"] is not None
    assert other["x"] is None
    assert "1 time without a transform: after the last transform of base_link" in found.err
    first = run(
        *ROBOT, *("odom", "base_link", "--at", "+1s", "--at", "+99s", "-n", "1"), store=store
    )
    assert "without a transform" not in first.err


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("odom", "base_link", "--at", "+99s"), "There is no transform from base_link to odom"),
        (("odom", "wheel"), "There is no frame 'wheel'; there are map, odom"),
        (("odom",), "name TARGET and SOURCE"),
        (("--at", "+1s"), "--at is for TARGET"),
        (("odom", "base_link", "--at", "+1s", "--step", "1s"), "exclude each other"),
        (("odom", "base_link", "--step", "1ns"), "more than 10,000,000 times"),
        (("odom", "base_link", "--step", "0s"), "more than 10,000,000 times"),
        (("odom", "base_link", "--between", "+1s", "+2s"), "--between needs"),
    ],
)
def test_what_is_refused(store: Path, args: tuple[str, ...], said: str) -> None:
    assert said in run(*ROBOT, *args, store=store, code=2).err
