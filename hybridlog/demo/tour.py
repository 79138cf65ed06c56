"""The guided tour of the demo bag: prints and runs every command, and checks its answer."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path, PurePath
from typing import NamedTuple

from hybridlog_storage.errors import NO_SPACE, DiskFullError, UsageError

BAG, STORE, SLICE = "robot.bag", "robot-logs", "scan.npz"
"""Names of the files that the tour makes in its directory."""
_PACKAGED = Path(__file__).with_name(BAG)
_COUNTED = _PACKAGED.with_suffix(".json")
"""The bag, and what the simulation counted when it was written."""

_SNIPPET = f"""\
import hybridlog as hl

with hl.open("{STORE}") as store:
    frame = store.topic("imu/data").to_pandas()
print(frame.shape)
print(frame[["angular_velocity.z", "linear_acceleration.x"]].describe())
"""
_STEPS = """\
Record its log
hybridlog record {bag} {store}
What is in the store?
hybridlog ls {store}
What did the robot say?
hybridlog info {store}
How often was the gripper closed?
{fetch} r_gripper_controller/command --where 'position == 0' --count {store} # gripper_closings
How many scans saw something nearer than half a metre?
{fetch} scan --where 'ranges.min < 0.5' --count {store} # near_scans
Which errors did the diagnostics report?
{fetch} diagnostics --where 'status.level >= 2' --fields {errors} --format jsonl {store} # errors
One second of the laser, as numpy arrays in a file
{fetch} scan {second} --format npz -o {slice} {store} # makes {slice}
Where was the robot in that second, and how fast?
{fetch} odom {second} --fields {pose} --every 10 {store}
"""
"""Titles and commands, each with the fact that is the answer or the file that it makes."""


class Step(NamedTuple):
    """One command of the tour, as typed, and the file that it makes.

    `fact` is the key of the right answer in what the simulation counted: a number that the
    command prints with `--count`, else its number of lines.
    """

    title: str
    command: str
    fact: str = ""
    makes: str = ""

    @property
    def argv(self) -> list[str]:
        """The command to run: with this Python, which imports nothing from here."""
        program, *words = shlex.split(self.command)
        module = ["-m", "hybridlog"] if program == "hybridlog" else []
        return [sys.executable, "-P", *module, *words]


def steps() -> list[Step]:
    """The tour, in order."""
    text = _STEPS.format(
        bag=BAG,
        slice=SLICE,
        fetch="hybridlog fetch --topic",
        second="--between +10s +11s",
        errors="'status[].name,status[].message'",
        pose="pose.pose.position.x,pose.pose.position.y,twist.twist.linear.x",
        store=f"--store {STORE}",
    )
    lines, found = text.splitlines(), []
    for title, line in zip(lines[::2], lines[1::2], strict=True):
        command, _, note = line.partition(" # ")
        makes = note.removeprefix("makes ") if note.startswith("makes ") else ""
        found.append(Step(title, command, "" if makes else note, makes))
    return [*found, Step("A pandas frame", f"python -c '\n{_SNIPPET}'")]


def run(directory: Path) -> int:
    """Run the tour, which leaves its bag and store in `directory`.

    Returns:
        0, or the exit code of the step that failed; 1 if an answer is wrong.

    Raises:
        UsageError: a file of the tour is in `directory` already, or the directory
            cannot be made or written to.
    """
    for path in (directory / name for name in (BAG, STORE, SLICE)):
        if path.exists():
            raise UsageError(f"{path} exists already; remove it or choose another directory")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(_PACKAGED, directory / BAG)
    except OSError as error:
        if error.errno in NO_SPACE:
            raise DiskFullError(f"no space left in {directory}; choose another disk") from error
        raise UsageError(
            f"cannot write to {directory}: {error.strerror}; choose another directory"
        ) from error
    _print(f"The tour runs in {directory}\n{BAG} is the log of a minute of a simulated robot\n")
    for step in steps():
        _print(f"\n# {step.title}\n$ {step.command}\n")
        code, fault = _take(step, directory)
        if code:
            _print(f"The tour stops here; its files remain in {directory}\n")
            sys.stderr.write(f"error: `{step.command}` {fault}\n")
            return code
    _print(
        f"\nAll files remain in {directory}; look at them: {_program()} view --store "
        f"{shlex.quote(str(directory / STORE))}\n"
    )
    return 0


def _program() -> str:
    """The command for this program: its path if the environment is not activated."""
    if shutil.which("hybridlog"):
        return "hybridlog"
    started = sys.argv[0]
    return started if PurePath(started).name == "hybridlog" else "python -m hybridlog"


def _take(step: Step, directory: Path) -> tuple[int, str]:
    """Run a step; returns an exit code and, if it is not 0, the fault."""
    # The error stream is not captured: its last line has the cost of the answer.
    stdout = subprocess.PIPE if step.fact else None
    done = subprocess.run(  # noqa: S603
        step.argv, cwd=directory, check=False, stdout=stdout, encoding="utf-8"
    )
    _print(done.stdout or "")
    if done.returncode:
        # A child that was killed by a signal has a negative code, which shells cannot return.
        code = done.returncode if done.returncode > 0 else 128 - done.returncode
        return code, f"failed with exit code {done.returncode}"
    made = directory / step.makes
    if step.makes and not (made.is_file() and made.stat().st_size):
        return 1, f"left no {step.makes}"
    if step.fact:
        right = json.loads(_COUNTED.read_text("utf-8"))[step.fact]
        lines = done.stdout.split("\n")[:-1]
        answer = lines[-1:] if "--count" in step.command else [str(len(lines))]
        fact = f"{step.fact.replace('_', ' ')}: {right}"
        if answer != [str(right)]:
            return (
                1,
                f"gave the wrong answer {done.stdout.strip()!r}; the simulation counted {fact}",
            )
        _print(f"(as the simulation counted, {fact})\n")
    return 0, ""


def _print(text: str) -> None:
    # Flushed, so that it precedes the output of the next command.
    sys.stdout.write(text)
    sys.stdout.flush()
