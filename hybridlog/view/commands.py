"""Runs commands on a store, each in a process of its own: its memory and its time have bounds."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from tempfile import TemporaryFile
from typing import IO, Final

from hybridlog_storage.errors import ResourceError, UsageError
from hybridlog_storage.stopping import check_wanted

MAX_PRINTED: Final = 16 << 20
"""Bytes that a command may print."""
MAX_REMARKS: Final = 64 << 10
"""Bytes of its remarks that are read."""
_POLL_S: Final = 0.05


def run(
    place: str, command: str, options: Sequence[str], *words: str, seconds: float
) -> tuple[bytes, list[str]]:
    """What a command prints about the store at a place, and its remarks.

    It ends when nobody waits for the answer. One that fails, takes longer or prints too much is
    refused.
    """
    program = [sys.executable, "-m", "hybridlog", command, f"--store={place}", *options]
    with (
        TemporaryFile() as printed,
        TemporaryFile() as remarks,
        subprocess.Popen(  # noqa: S603 - our own program
            [*program, "--", *words],
            cwd="/",  # nothing in an answer says where this one runs
            env={**os.environ, "HYBRIDLOG_READ_ONLY": "1"},
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=remarks,
            start_new_session=True,  # Ctrl-C ends this process, which ends that one
        ) as child,
    ):
        try:
            _wait(child, printed, time.monotonic() + seconds)
        except TimeoutError:
            raise ResourceError(
                f"The answer took longer than {seconds:g} s, so it was given up: narrow the "
                "question down."
            ) from None
        finally:
            child.kill()
        printed.seek(0)
        remarks.seek(0)
        said = remarks.read(MAX_REMARKS).decode(errors="replace")
        if child.returncode < 0:
            raise ResourceError(
                "The process that answers has ended, likely for want of memory: ask for less at a "
                "time, or on the command line."
            )
        if child.returncode:
            raise UsageError(said.strip().removeprefix("hybridlog: "))
        return printed.read(), said.splitlines()


def _wait(child: subprocess.Popen[bytes], printed: IO[bytes], until: float) -> None:
    while child.poll() is None:
        check_wanted()
        if time.monotonic() > until:
            raise TimeoutError
        if os.fstat(printed.fileno()).st_size > MAX_PRINTED:
            raise ResourceError("The answer is too large: name fewer columns or fields.")
        with suppress(subprocess.TimeoutExpired):
            child.wait(_POLL_S)
