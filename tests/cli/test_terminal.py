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

from .running import COMMAND, environment, open_bytes, run

CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b[()][A-Z0-9]")


def on_terminal(
    *arguments: object,
    width: int = 80,
    meanwhile: Callable[[subprocess.Popen[bytes], int], None] | None = None,
) -> tuple[int, str]:
    """Run a command on a terminal of its own; returns its exit code and all it printed.

    Args:
        arguments: Of the command.
        width: Columns of the terminal.
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


def test_no_bar_when_quiet(logs: Path, tmp_path: Path) -> None:
    code, shown = on_terminal("record", logs / "small.bag", "-q", "--store", tmp_path / "s")
    assert (code, shown) == (0, "")


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
    for command in TABLES:
        table = run(*command, store=store, width=width, code=None).out
        # Definitions are printed as they are.
        rows = table if "-t" not in command else table[table.index("\nfield") :]
        assert max(map(len, rows.splitlines()), default=0) <= width
        assert "\x1b" not in table
        assert "\x07" not in table


def test_an_answer_is_a_table_when_it_fits(store: Path) -> None:
    command = ("fetch", "-t", "scan", "-r", "robot", "--fields", "angle_min,scan_time")
    done = run(*command, store=store, width=80)
    assert done.lines[0].split() == ["log_time", "angle_min", "scan_time"]
    assert re.match(r"\d{4}-\d\d-\d\dT[\d:.]+Z  ", done.lines[1])
    assert len(done.lines) == 21
    assert "--limit shows more" in done.err


def test_an_answer_is_a_block_a_message_when_it_does_not(store: Path) -> None:
    text = run("fetch", "-t", "scan", "-r", "robot", "-n", "2", store=store, width=80).out
    assert len(re.findall(r"(?m)^\d{4}-\S+Z$", text)) == 2
    assert len(re.findall(r"(?m)^  header\.frame_id +\S", text)) == 2
    assert re.search(r"ranges +\[\S+, \S+, … \d+ in all\]", text)


def test_binary_formats_are_kept_off_the_terminal(store: Path) -> None:
    for form in ("mcap", "parquet", "raw"):
        assert "-o" in run("fetch", "-t", "scan", "-F", form, store=store, width=80, code=2).err


def test_rm_asks(fresh: Path) -> None:
    done = run("rm", "small", store=fresh, width=80, typed="n\n", code=1)
    assert "Nothing is deleted." in done.err
    assert places.names(fresh) == ["small"]
    run("rm", "small", store=fresh, width=80, typed="y\n")
    assert places.names(fresh) == []


def test_a_bar_with_share_and_rate_until_ctrl_c(logs: Path, fresh: Path) -> None:
    pressed = []

    def press(process: subprocess.Popen[bytes], _terminal: int) -> None:
        if not pressed and open_bytes(fresh) > 100_000:
            pressed.append(True)
            process.send_signal(signal.SIGINT)

    code, shown = on_terminal(
        *("record", logs / "robot.bag", "--level", "12", "--store", fresh),
        width=120,
        meanwhile=press,
    )
    assert code == 130
    bars = plain(shown).split("\r")
    assert any(re.search(r"record \d+%  .*B/s  robot\.bag: \d+ messages", bar) for bar in bars)
    assert "interrupted: undone" in plain(shown).replace("\n", " ")
    # The cursor that the bar has hidden is back.
    assert shown.rindex("\x1b[?25h") > shown.rindex("\x1b[?25l")
    assert places.names(fresh) == ["small"]
