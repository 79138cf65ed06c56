"""What a person sees: on a terminal there are bars and tables, elsewhere there are not."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import places

from .running import COMMAND, environment, open_bytes

CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b[()][A-Z0-9]")


def on_terminal(
    *arguments: object,
    width: int = 80,
    typed: bytes = b"",
    meanwhile: Callable[[subprocess.Popen[bytes], int], None] | None = None,
) -> tuple[int, str]:
    """Run a command on a terminal of its own; returns its exit code and all it printed.

    Args:
        arguments: Of the command.
        width: Columns of the terminal.
        typed: What the person types at once.
        meanwhile: Called again and again with the process and the terminal.
    """
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        # The terminal has to be the one that Ctrl-C comes from.
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # noqa: PLW1509
        env=environment(TERM="xterm-256color"),
    )
    os.close(theirs)
    if typed:
        os.write(ours, typed)
    shown = b""
    deadline = time.monotonic() + 120
    try:
        while time.monotonic() < deadline:
            if meanwhile is not None:
                meanwhile(process, ours)
            if select.select([ours], [], [], 0.01)[0]:
                try:
                    data = os.read(ours, 1 << 16)
                except OSError:  # the other end is closed
                    break
                shown += data
                if not data:
                    break
        return process.wait(60), shown.decode("utf-8", "replace")
    finally:
        os.close(ours)
        if process.poll() is None:
            process.kill()
            process.wait()


def plain(text: str) -> str:
    return CONTROL.sub("", text).replace("\r\n", "\n")


@pytest.mark.mongo
def test_a_bar_with_share_and_rate_and_then_the_line(logs: Path, tmp_path: Path) -> None:
    code, shown = on_terminal(
        "record", logs / "robot.bag", "--level", "15", "--store", tmp_path / "s", width=120
    )
    assert code == 0
    bars = plain(shown).split("\r")
    assert any(re.search(r"record \d+%  .*B/s  robot\.bag: \d+ messages", b) for b in bars)
    # The bar goes away; the line stays.
    last = plain(shown[shown.rindex("\x1b[J") :])
    assert "B/s" not in last
    assert re.search(r"robot: \d+ messages, ", last)


def test_no_bar_elsewhere_or_when_quiet(logs: Path, tmp_path: Path) -> None:
    code, shown = on_terminal("record", logs / "small.bag", "-q", "--store", tmp_path / "s")
    assert (code, shown) == (0, "")
    ended = subprocess.run(
        [*COMMAND, "record", str(logs / "odd.mcap"), "--store", str(tmp_path / "s")],
        capture_output=True,
        env=environment(),
        check=True,
    )
    assert b"\x1b" not in ended.stdout + ended.stderr
    assert b"\r" not in ended.stderr


TABLES = (
    ("ls",),
    ("info", "odd"),
    ("info", "-t", "scan"),
    ("check", "-r", "odd"),
    ("stats", "imu/data", "-r", "robot"),
    ("info", "--losses"),
    ("info", "--sizes", "both"),
    ("info", "--attachments"),
    ("intervals", "scan", "-r", "robot", "--where", "ranges.min < 5"),
    ("diff", "robot", "torn"),
    ("tf", "-r", "robot"),
    ("sql", "select topic, type, messages from topics"),
    ("keep", "--max-age", "9y", "--dry-run"),
    ("keep", "--pins"),
)


@pytest.mark.parametrize("width", [60, 80, 160])
def test_tables_keep_within_the_screen(width: int, store: Path) -> None:
    for command in TABLES if width == 80 else TABLES[:5]:
        code, shown = on_terminal(*command, "--store", store, width=width)
        assert code == (12 if command[0] == "diff" else 0), shown
        table = plain(shown)
        # Definitions are printed as they are.
        rows = table if "-t" not in command else table[table.index("\nfield") :]
        assert max(map(len, rows.splitlines()), default=0) <= width
        assert "\x1b[31m" not in shown
        assert "\x07" not in shown


def test_an_answer_is_a_table_when_it_fits(store: Path) -> None:
    command = ("fetch", "-t", "scan", "-r", "robot", "--fields", "angle_min,scan_time")
    code, shown = on_terminal(*command, "--store", store, width=80)
    assert code == 0
    lines = plain(shown).splitlines()
    assert lines[0].split() == ["log_time", "angle_min", "scan_time"]
    assert re.match(r"\d{4}-\d\d-\d\dT[\d:.]+Z  ", lines[1])
    assert len([line for line in lines if re.match(r"\d{4}-", line)]) == 20
    assert any("--limit shows more" in line for line in lines)


def test_an_answer_is_a_block_a_message_when_it_does_not(store: Path) -> None:
    code, shown = on_terminal("fetch", "-t", "scan", "-r", "robot", "-n", "2", "--store", store)
    assert code == 0
    text = plain(shown)
    assert len(re.findall(r"(?m)^\d{4}-\S+Z$", text)) == 2
    assert len(re.findall(r"(?m)^  header\.frame_id +\S", text)) == 2
    assert re.search(r"ranges +\[\S+, \S+, … \d+ in all\]", text)


def test_binary_formats_are_kept_off_the_terminal(store: Path) -> None:
    for form in ("mcap", "parquet", "raw"):
        code, shown = on_terminal("fetch", "-t", "scan", "-F", form, "--store", store)
        assert code == 2
        assert "-o" in shown


def test_rm_asks(fresh: Path) -> None:
    code, shown = on_terminal("rm", "small", "--store", fresh, typed=b"n\n")
    assert code == 1
    assert "Nothing is deleted." in shown
    assert places.names(fresh) == ["small"]
    code, shown = on_terminal("rm", "small", "--store", fresh, typed=b"y\n")
    assert code == 0
    assert places.names(fresh) == []


def test_ctrl_c(logs: Path, fresh: Path) -> None:
    pressed = []

    def press(process: subprocess.Popen[bytes], _terminal: int) -> None:
        if not pressed and open_bytes(fresh) > 100_000:
            pressed.append(True)
            process.send_signal(signal.SIGINT)

    code, shown = on_terminal(
        "record", logs / "robot.bag", "--level", "19", "--store", fresh, meanwhile=press
    )
    assert code == 130
    assert "interrupted: undone" in plain(shown).replace("\n", " ")
    # The cursor that the bar has hidden is back.
    assert shown.rindex("\x1b[?25h") > shown.rindex("\x1b[?25l")
    assert places.names(fresh) == ["small"]
