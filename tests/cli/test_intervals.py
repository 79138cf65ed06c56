"""`hybridlog intervals`, `changes`, and `fetch` near messages of other topics."""

from __future__ import annotations

from pathlib import Path

import pytest

from .running import run

GRIPPER = ("-t", "r_gripper_controller/command", "-r", "robot")


def test_intervals_as_a_table(store: Path) -> None:
    asked = ("intervals", "-t", "odom", "-r", "robot", "--where", "twist.twist.linear.x > -9")
    done = run(*asked, store=store)
    assert done.lines[0].split() == ["recording", "begin", "end", "duration", "messages"]
    assert len(done.lines) == 2
    assert run(*asked, "--count", "-q", store=store).out == "1\n"
    assert run(*asked, "--at-least", "1min", store=store).out == ""
    none = run(*asked, "--at-least", "1min", store=store)
    assert none.err.startswith("No interval.")
    assert run(*asked, "--at-least", "1min", "--json", store=store).json == []
    assert run(*asked, "--between", "+1s", "+2s", "--json", store=store).json[0]["messages"] > 10
    assert len(run(*asked, "--max-gap", "1ms", "--json", store=store).json) > 100


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("fetch", "-t", "odom", "--before", "5s"), "--before is for --where: add that"),
        (("fetch", "-t", "odom", "--where", "rosout: level > 1"), "needs a time within"),
        (
            ("fetch", "-t", "odom", "--where", "rosout: level > 1", "--after", "1s", "--at", "0"),
            "cannot be combined with it",
        ),
        (
            ("fetch", "-t", "odom", "--count", "-o", "x.csv"),
            "--count and --output exclude each other",
        ),
        (
            ("fetch", "-t", "odom", "--count", "-F", "csv"),
            "--count and --format exclude each other",
        ),
        (("intervals", *GRIPPER, "--changes", "position,"), "commas"),
        (("intervals", *GRIPPER, "--changes", "position", "--tolerance", "-1"), "tolerance"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_what_is_refused(store: Path, arguments: tuple[str, ...], said: str) -> None:
    done = run(*arguments, store=store, code=2)
    assert said in done.err
    assert done.out == ""
