"""The guided tour: every command is printed, run for real, and its answer checked.

`steps` is the tour as data, which documentation and tests use as well.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from hybridlog.demo.config import DEFAULT_DURATION_S, DEFAULT_SEED
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

BAG, STORE, SLICE, TRUTH = "robot.bag", "robot-logs", "scan.npz", "truth.json"
"""Names of what the tour makes in its directory."""

SNIPPET = f"""\
import hybridlog as hl

with hl.open("{STORE}") as store:
    frame = store.topic("imu/data").to_pandas()
print(frame.shape)
print(frame[["angular_velocity.z", "linear_acceleration.x"]].describe())
"""
"""The Python part of the tour."""

_MISMATCH = 1


@dataclass(frozen=True, slots=True)
class Check:
    """What a step's standard output must say.

    Attributes:
        fact: Key in the simulation's truth (`BagSummary.truth`).
        reading: `number`: the output is that number. `lines`: it has so many lines.
        said: What is counted, in words.
    """

    fact: Literal["gripper_closings", "near_scans", "errors"]
    reading: Literal["number", "lines"]
    said: str


@dataclass(frozen=True, slots=True)
class Step:
    """One command of the tour.

    Attributes:
        title: What it shows.
        program: `hybridlog`; `demo`: the bag's writer; `python`: a snippet.
        arguments: As typed after the program's name; for `python` the code alone.
        check: What its answer must be.
        makes: A file that must be there afterwards, empty for none.
    """

    title: str
    program: Literal["hybridlog", "demo", "python"]
    arguments: tuple[str, ...]
    check: Check | None = None
    makes: str = ""

    @property
    def shown(self) -> str:
        """The command as one types it."""
        if self.program == "python":
            return f"python -c '\n{self.arguments[0]}'"
        name = "hybridlog" if self.program == "hybridlog" else "python -m hybridlog.demo"
        return f"{name} {shlex.join(self.arguments)}"

    @property
    def argv(self) -> list[str]:
        """The command as it is run: the same, with this Python."""
        # -P: the tour's directory is no place to import from.
        python = [sys.executable, "-P"]
        if self.program == "python":
            return [*python, "-c", *self.arguments]
        module = "hybridlog" if self.program == "hybridlog" else "hybridlog.demo"
        return [*python, "-m", module, *self.arguments]


def steps(duration_s: float = DEFAULT_DURATION_S, seed: int = DEFAULT_SEED) -> tuple[Step, ...]:
    """The tour, in order."""
    store = ("--store", STORE)
    # A second out of the middle; a short recording has none after ten seconds.
    start = min(10.0, duration_s / 2)
    between = ("--between", f"+{start:g}s", f"+{start + 1:g}s")
    return (
        Step(
            "A robot drives through a floor plan; rosbags writes its log",
            "demo",
            (BAG, "--duration", f"{duration_s:g}", "--seed", str(seed), "--truth", TRUTH),
            makes=BAG,
        ),
        Step("Record it", "hybridlog", ("record", BAG, *store)),
        Step("What is in the store?", "hybridlog", ("ls", *store)),
        Step("What did the robot say?", "hybridlog", ("info", *store)),
        Step(
            "How often was the gripper closed?",
            "hybridlog",
            (
                "fetch",
                "--topic",
                "r_gripper_controller/command",
                "--where",
                "position == 0",
                "--count",
                *store,
            ),
            Check("gripper_closings", "number", "gripper closings"),
        ),
        Step(
            "How many scans saw something nearer than half a metre?",
            "hybridlog",
            ("fetch", "--topic", "scan", "--where", "ranges.min < 0.5", "--count", *store),
            Check("near_scans", "number", "near scans"),
        ),
        Step(
            "Which errors did the diagnostics report?",
            "hybridlog",
            (
                "fetch",
                "--topic",
                "diagnostics",
                "--where",
                "status.level >= 2",
                "--fields",
                "status[].name,status[].message",
                "--format",
                "jsonl",
                *store,
            ),
            Check("errors", "lines", "messages with an error"),
        ),
        Step(
            "One second of the laser, as numpy arrays in a file",
            "hybridlog",
            ("fetch", "--topic", "scan", *between, "--format", "npz", "-o", SLICE, *store),
            makes=SLICE,
        ),
        Step(
            "Where was the robot in that second, and how fast?",
            "hybridlog",
            (
                "fetch",
                "--topic",
                "odom",
                *between,
                "--fields",
                "pose.pose.position.x,pose.pose.position.y,twist.twist.linear.x",
                "--every",
                "10",
                *store,
            ),
        ),
        Step("A pandas frame", "python", (SNIPPET,)),
    )


COMMANDS: tuple[str, ...] = tuple(step.shown for step in steps())
"""Every command of the default tour as one types it."""


def run(
    directory: Path,
    duration_s: float = DEFAULT_DURATION_S,
    seed: int = DEFAULT_SEED,
    *,
    keep: bool = True,
) -> int:
    """Take the tour.

    Args:
        directory: Where the bag, the store and the slice are made; created if needed.
        duration_s: Seconds of the robot's life.
        seed: Of the simulation.
        keep: Leave everything there, to ask more of it. Without it, what the tour made
            is removed at the end, but not after a failure.

    Returns:
        0, or the exit code of the step that failed; 1 when an answer is not what the
        simulation knows it to be.

    Raises:
        UsageError: Something of the tour's is in `directory` already, or the directory
            cannot be made.
    """
    made = [directory / name for name in (BAG, STORE, SLICE, TRUTH)]
    for path in made:
        if path.exists():
            raise UsageError(f"{path} exists already; remove it or choose another directory")
    fresh = not directory.exists()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"cannot make {directory}: {error.strerror}; choose another directory"
        ) from error
    _say(f"The tour runs in {directory}\n")
    for step in steps(duration_s, seed):
        code = _take(step, directory)
        if code:
            _say(f"The tour stops here; what it made is left in {directory}\n")
            return code
    if keep:
        _say(f"\nEverything is left in {directory}; ask more with --store {directory / STORE}\n")
        return 0
    _await_mongod(directory / STORE)
    for path in made:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    if fresh and not any(directory.iterdir()):
        directory.rmdir()
    return 0


def _await_mongod(store: Path) -> None:
    """The embedded mongod stays for some seconds after its last user, and writes."""
    record = store / "mongod" / "mongod.json"
    until = time.monotonic() + 60
    while record.exists() and time.monotonic() < until:
        time.sleep(0.1)


def _take(step: Step, directory: Path) -> int:
    _say(f"\n# {step.title}\n$ {step.shown}\n")
    try:
        code, output = _execute(step, directory)
    except OSError as error:
        _complain(f"`{step.shown}` could not be started: {error.strerror}")
        return _MISMATCH
    if code:
        _complain(f"`{step.shown}` failed with exit code {code}")
        # A child that died of a signal has a negative code, which no shell can pass on.
        return code if code > 0 else 128 - code
    if step.makes and not _filled(directory / step.makes):
        _complain(f"`{step.shown}` ended well but left no {step.makes}")
        return _MISMATCH
    return _confirm(step, step.check, directory, output) if step.check else 0


def _execute(step: Step, directory: Path) -> tuple[int, str]:
    """Run a step; its output is passed on, and kept when it has to be checked."""
    if step.check is None:
        return subprocess.run(step.argv, cwd=directory, check=False).returncode, ""  # noqa: S603
    # The error stream goes straight through: its last line says what the answer cost.
    done = subprocess.run(  # noqa: S603
        step.argv, cwd=directory, check=False, stdout=subprocess.PIPE, encoding="utf-8"
    )
    _say(done.stdout)
    return done.returncode, done.stdout


def _confirm(step: Step, check: Check, directory: Path, output: str) -> int:
    lines = [line for line in output.splitlines() if line.strip()]
    answer: int | None = len(lines)
    if check.reading == "number":
        digits = lines[-1].strip() if lines else ""
        answer = int(digits) if digits.isascii() and digits.isdigit() else None
    try:
        expected = int(json.loads((directory / TRUTH).read_text("utf-8"))[check.fact])
    except (OSError, ValueError, KeyError, TypeError) as error:
        _complain(f"{directory / TRUTH} cannot be read: {error}")
        return _MISMATCH
    if answer != expected:
        _complain(
            f"wrong answer to `{step.shown}`: {output.strip()!r},"
            f" but the simulation counted {check.said}: {expected}"
        )
        return _MISMATCH
    _say(f"(as the simulation counted, {check.said}: {expected})\n")
    return 0


def _filled(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _say(text: str) -> None:
    # Flushed, so that it comes before what the next command prints.
    sys.stdout.write(text)
    sys.stdout.flush()


def _complain(text: str) -> None:
    sys.stdout.flush()
    sys.stderr.write(f"error: {text}\n")
    sys.stderr.flush()
