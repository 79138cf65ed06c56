"""How long `hybridlog --help` takes: what every command costs before it does anything."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.side import SideError
from benchmarks.speed.results import figure, values_of

if TYPE_CHECKING:
    from benchmarks.speed.bench import Bench

_RUNS = 10


def start(bench: Bench) -> None:
    """Starts of the command, one after the other."""
    beside = Path(sys.executable).with_name("hybridlog")
    program = str(beside) if beside.exists() else shutil.which("hybridlog")
    command = [program, "--help"] if program else [sys.executable, "-m", "hybridlog", "--help"]
    _run(command)  # compiles the modules
    for number in range(_RUNS):
        bench.keep("hybridlog", number, {"seconds": _run(command)})
    seconds = values_of(bench.samples, "hybridlog", "seconds")
    bench.find(figure(bench.study, "hybridlog --help", seconds, "s", target=0.2))


def _run(command: list[str]) -> float:
    """Seconds that a command takes.

    Raises:
        SideError: It failed.
    """
    started = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SideError(f"{' '.join(command)} failed:\n{done.stderr[-2000:].strip()}")
    return time.perf_counter() - started
