"""`hybridlog fetch`."""

from __future__ import annotations

import subprocess
from pathlib import Path

from .running import COMMAND, environment, run

SCAN = ("fetch", "-t", "/base/scan", "-r", "robot")


def test_a_wrong_predicate_is_pointed_at(store: Path) -> None:
    done = run(*SCAN, "--where", "ranges.min << 0.5", store=store, code=2)
    message, text, caret = done.err.splitlines()
    assert message.startswith("hybridlog: ")
    assert text.strip() == "ranges.min << 0.5"
    assert text[caret.index("^")] == "<"


def test_nothing_is_overwritten_without_force(store: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("mine")
    refused = run(*SCAN, "-o", path, store=store, code=2)
    assert "--force" in refused.err
    assert path.read_text() == "mine"
    # A failure leaves what was there, and nothing else.
    run(*SCAN, "--between", "2000-01-01", "2001-01-01", "-o", path, "--force", store=store, code=2)
    assert path.read_text() == "mine"
    run(*SCAN, "-o", path, "--force", store=store)
    assert path.read_text().startswith('"log_time"')
    assert [p.name for p in tmp_path.iterdir()] == ["x.csv"]


def test_no_directory_is_deleted(store: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    raw = (*SCAN, "-n", "2", "-F", "raw", "--force", "-o", mine)
    run(*raw, store=store)
    assert len(list(mine.rglob("*.bin"))) == 2
    assert "is not empty" in run(*raw, store=store, code=2).err
    run(*SCAN, "-o", mine, "-F", "csv", "--force", store=store, code=2)
    assert len(list(mine.rglob("*.bin"))) == 2


def test_a_full_disk_behind_standard_output(store: Path) -> None:
    for command in (["fetch", "-t", "scan", "-F", "csv"], ["ls", "--json"]):
        with Path("/dev/full").open("wb") as full:
            ended = subprocess.run(
                [*COMMAND, *command, "--store", str(store)],
                stdout=full,
                stderr=subprocess.PIPE,
                env=environment(),
                check=False,
            )
        assert ended.returncode == 7
        assert b"No space left" in ended.stderr
        assert b"[Errno" not in ended.stderr
        assert b"Traceback" not in ended.stderr
    shell = ["sh", "-c", 'exec "$@" >&-', "sh", *COMMAND, "ls", "--store", str(store)]
    ended = subprocess.run(shell, stderr=subprocess.PIPE, env=environment(), check=False)
    assert (ended.returncode, b"standard output cannot" in ended.stderr) == (1, True)


def test_damage_that_has_cost_no_message(logs: Path, tmp_path: Path) -> None:
    whole = (logs / "odd.mcap").read_bytes()
    (tmp_path / "open.mcap").write_bytes(whole[:-8])  # the recorder did not close it
    run("record", tmp_path / "open.mcap", store=tmp_path / "s", code=4)
    answer = run("fetch", "-t", "json", store=tmp_path / "s")
    assert "complete" not in answer.err
    info = run("info", store=tmp_path / "s").out
    assert "coverage   complete, although its source was damaged in 1 place" in info
    assert "source damaged: open.mcap" in info
    assert "messages lost" not in info


def test_remarks_follow_the_closing_line(store: Path) -> None:
    done = run("fetch", "-t", "/long", "--where", "data > 0", "--count", store=store)
    assert "messages could not be tested: no definition that fits" in done.err
    silent = run("fetch", "-t", "/long", "--where", "data > 0", "--count", "-q", store=store)
    assert (silent.out, silent.err) == (done.out, "")
    events = ("--where", "/long: data > 9", "--before", "1s")
    done = run("fetch", "-t", "/json", *events, "--count", store=store)
    assert "messages could not be tested" in done.err
    done = run("fetch", "-t", "odom", "-r", "odd", "--count", store=store, code=2)
    assert "there is no topic 'odom'" in done.err
