"""One run of all benchmarks on one source, in a process of its own."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.memory import wait_for_mongods
from benchmarks.micro.isolation import INPUTS, OUTCOME, PACKAGES, SOURCE

ROOTS = ("", "storage")
"""Where the packages lie in a checkout, as editable installs have it."""

_TIDY_S = 30.0
_TOLD_CHARACTERS = 4000
_BENCH = "bench_"
_NO_TESTS = 5


class RunError(Exception):
    """A run has failed; the message says what can be done, or ends with what it wrote."""


@dataclass(frozen=True, slots=True)
class Timed:
    """One path in one run.

    Attributes:
        least: Seconds of the fastest round.
        median: Seconds of the median round.
        rounds: How many there were.
    """

    least: float
    median: float
    rounds: int


@dataclass(frozen=True, slots=True)
class Run:
    """What one run has found.

    Attributes:
        timed: By path, in the order of the files.
        skipped: By path, what the source lacks.
        failed: By path, how it failed.
    """

    timed: dict[str, Timed] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Settings:
    """How to run.

    Attributes:
        seconds: Time of a path, about; some have a fixed number of rounds.
        only: Expression of pytest's `-k`; empty for all paths.
    """

    seconds: float = 0.5
    only: str = ""


def copy_benchmarks(root: Path, place: Path) -> None:
    """Copy the benchmarks away from the source that they came with.

    Args:
        root: The checkout.
        place: Directory that is made.
    """
    (place / "benchmarks").mkdir(parents=True)
    shutil.copy(root / "benchmarks" / "__init__.py", place / "benchmarks")
    _copy(root / "benchmarks" / "micro", place / "benchmarks" / "micro")


def copy_source(root: Path, place: Path) -> None:
    """Copy a checkout's source as it is now, so that it may be edited meanwhile.

    Args:
        root: The checkout.
        place: Directory that is made.
    """
    for package in PACKAGES:
        for part in ROOTS:
            if (root / part / package).is_dir():
                _copy(root / part / package, place / part / package)


def run(benchmarks: Path, source: Path, inputs: Path, work: Path, settings: Settings) -> Run:
    """Run the benchmarks on one source.

    Args:
        benchmarks: Made by `copy_benchmarks`.
        source: A checkout, or made by `copy_source`.
        inputs: Directory of the inputs.
        work: Directory for stores and results; it is made and removed again.
        settings: How.

    Raises:
        RunError: The run did not come to its end, or measured another source.
    """
    work.mkdir()
    try:
        code, told = _wait_for(
            _command(benchmarks, work, settings),
            benchmarks,
            _environment(benchmarks, source, inputs, work),
            work / "told",
        )
        if code == _NO_TESTS:
            raise RunError(f"No path fits --only {settings.only!r}.")
        outcome = _read(work / "outcome.json")
        if outcome is None or code not in {0, 1}:
            raise RunError(f"The benchmarks of {source} failed:\n{told}")
        _check_source(outcome, source)
        return _found(outcome, _read(work / "times.json") or {})
    finally:
        # What still runs would disturb the next run.
        wait_for_mongods(work)
        shutil.rmtree(work, ignore_errors=True)


def _command(benchmarks: Path, work: Path, settings: Settings) -> list[str]:
    place = benchmarks / "benchmarks" / "micro"
    return [
        *(sys.executable, "-m", "pytest", "-q", "-c", str(place / "pytest.ini")),
        *("--rootdir", str(place), "--basetemp", str(work / "tmp")),
        *("--benchmark-quiet", "--benchmark-disable-gc"),
        f"--benchmark-max-time={settings.seconds}",
        f"--benchmark-json={work / 'times.json'}",
        *(["-k", settings.only] if settings.only else []),
        str(place),
    ]


def _environment(benchmarks: Path, source: Path, inputs: Path, work: Path) -> dict[str, str]:
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    return {
        **kept,
        # First on the path, so before what an editable install puts there.
        "PYTHONPATH": os.pathsep.join(map(str, [benchmarks, *(source / part for part in ROOTS)])),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONHASHSEED": "0",
        SOURCE: str(source),
        INPUTS: str(inputs),
        OUTCOME: str(work / "outcome.json"),
    }


def _wait_for(
    command: Sequence[str], cwd: Path, environment: dict[str, str], told: Path
) -> tuple[int, str]:
    """Run a command to its end; it ends with us, and tidies up.

    Returns:
        The exit code, and the end of what it wrote.
    """
    with told.open("wb") as output:
        process = subprocess.Popen(
            command,
            cwd=cwd,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            # Ctrl-C in a terminal would reach it a second time, while it tidies up.
            start_new_session=True,
        )
        try:
            code = process.wait()
        except BaseException:
            _stop(process)
            raise
    return code, told.read_text(errors="replace")[-_TOLD_CHARACTERS:].strip()


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End a run as Ctrl-C does, so that it closes its store."""
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_TIDY_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _read(path: Path) -> dict[str, Any] | None:
    try:
        value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return value


def _check_source(outcome: dict[str, Any], source: Path) -> None:
    """Refuse figures of another source than the one that was asked for."""
    wrong = list(outcome["strangers"])
    if outcome["hybridlog"] is None:
        wrong.append("there is no hybridlog in it")
    elif not Path(outcome["hybridlog"]).resolve().is_relative_to(source.resolve()):
        wrong.append(f"hybridlog: {outcome['hybridlog']}")
    if wrong:
        raise RunError(f"{source} was not what was measured: " + "; ".join(wrong))


def _found(outcome: dict[str, Any], times: dict[str, Any]) -> Run:
    found = Run()
    for benchmark in times.get("benchmarks", ()):
        stats = benchmark["stats"]
        found.timed[benchmark["name"].removeprefix(_BENCH)] = Timed(
            stats["min"], stats["median"], stats["rounds"]
        )
    for name, (kind, reason) in outcome["reasons"].items():
        path = name.removeprefix(_BENCH)
        (found.skipped if kind == "skipped" else found.failed)[path] = reason
        found.timed.pop(path, None)
    return found


def _copy(source: Path, target: Path) -> None:
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
