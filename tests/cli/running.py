"""Runs the command line as a user does: in this process, or in one of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

from hybridlog.cli import output
from hybridlog.cli.app import _run as run_app
from tests import places
from tests.cli.within import Answer

COMMAND = [sys.executable, "-m", "hybridlog"]
BACKGROUND = ("sh", "-c", 'trap "" INT; exec "$@"', "sh")
"""A wrapper: SIGINT is ignored, as for background jobs of scripts."""
NOT_INHERITED = ("HYBRIDLOG_STORE", "COLUMNS", "PYTHONUNBUFFERED")
_LIMIT_S = 120


def environment(**extra: str) -> dict[str, str]:
    """No store or MongoDB by accident, and output as users have it, whatever the terminal is."""
    kept = {k: v for k, v in os.environ.items() if k not in NOT_INHERITED}
    return {**kept, "LC_ALL": "C.UTF-8", **extra}


def run(
    *arguments: object,
    store: Path | None = None,
    code: int | None = 0,
    before: Callable[[], None] | None = None,
    width: int = 0,
    typed: str = "",
    **env: str,
) -> Answer:
    """Run a command to its end, as its process would.

    Args:
        arguments: Of the command.
        store: What HYBRIDLOG_STORE says.
        code: The exit code that is expected; None for any.
        before: Called in a process of its own, which then runs the command.
        width: Columns of the terminal that it is on; 0 for none.
        typed: What the person types there.
        env: Variables.
    """
    if store is not None:
        env["HYBRIDLOG_STORE"] = str(store)
    words = [os.fsdecode(a) if isinstance(a, bytes) else str(a) for a in arguments]
    if width:
        env["COLUMNS"] = str(width)
    done = _within(words, env, typed) if before is None else _apart(words, env, before)
    assert "Traceback" not in done.err, done.err
    if code is not None:
        assert done.code == code, (done.code, done.out[-2000:], done.err[-2000:])
    return done


def _within(words: list[str], env: dict[str, str], typed: str) -> Answer:
    variables = {**dict.fromkeys(NOT_INHERITED), "LC_ALL": "C.UTF-8", **env}
    with (
        CliRunner().isolation(typed, env=variables) as (out, err, _),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(sys, "argv", ["hybridlog", *words])
        output.begin(None)  # as in a new process
        if "COLUMNS" in env:
            patch.setattr(sys.stdout, "isatty", lambda: True)
            patch.setattr(sys.stdin, "isatty", lambda: True)
        for stream in (sys.stdout, sys.stderr):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
        code = run_app()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        raw, said = out.getvalue(), err.getvalue()
    return Answer(raw.decode("utf-8", "replace"), said.decode("utf-8", "replace"), code, raw)


def _apart(words: list[str], env: dict[str, str], before: Callable[[], None]) -> Answer:
    ended = subprocess.run(
        [*COMMAND, *words],
        stdin=subprocess.DEVNULL,
        preexec_fn=before,
        capture_output=True,
        env=environment(**env),
        timeout=_LIMIT_S,
        check=False,
    )
    said = (ended.stdout.decode("utf-8", "replace"), ended.stderr.decode("utf-8", "replace"))
    return Answer(*said, ended.returncode, ended.stdout)


def complete(words: str) -> list[str]:
    """What bash would offer for the last word."""
    typed = {"COMP_WORDS": f"hybridlog {words}", "COMP_CWORD": str(len(words.split()))}
    done = run(_HYBRIDLOG_COMPLETE="bash_complete", **typed)
    assert done.err == ""
    return [line.partition(",")[2] for line in done.lines if line]


@contextmanager
def started(
    *arguments: object, output: Path, wrapper: Sequence[str] = ()
) -> Iterator[subprocess.Popen[bytes]]:
    """A running command, killed if it has not ended; both of its streams go to a file."""
    with output.open("ab") as file:
        process = subprocess.Popen(
            [*wrapper, *COMMAND, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment(),
        )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def open_bytes(store: Path) -> int:
    """Bytes in segments that are being written."""
    total = 0
    for path in places.files(store, "*.mcap.open"):
        try:
            total += path.stat().st_size
        except FileNotFoundError:
            continue
    return total
