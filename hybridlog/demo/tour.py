"""The guided tour of the demo bag: prints and runs every command."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from hybridlog_storage.errors import NO_SPACE, DiskFullError, UsageError

BAG, STORE, SLICE = "robot.bag", "robot-logs", "scan.npz"
"""Names of the files that the tour makes in its directory."""

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
{fetch} r_gripper_controller/command --where 'position == 0' --count {store}
How many scans saw something nearer than half a metre?
{fetch} scan --where 'ranges.min < 0.5' --count {store}
Which errors did the diagnostics report?
{fetch} diagnostics --where 'status.level >= 2' --fields {errors} --format jsonl {store}
One second of the laser, as numpy arrays in a file
{fetch} scan {second} --format npz -o {slice} {store}
Where was the robot in that second, and how fast?
{fetch} odom {second} --fields {pose} --every 10 {store}
"""
"""Titles and commands."""


class Step(NamedTuple):
    """One command of the tour, as typed."""

    title: str
    command: str

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
    lines = text.splitlines()
    last = Step("A pandas frame", f"python -c '\n{_SNIPPET}'")
    return [*map(Step, lines[::2], lines[1::2]), last]


def run(directory: Path) -> int:
    """Run the tour, which leaves its bag and store in `directory`.

    Returns:
        0, or the exit code of the step that failed.

    Raises:
        UsageError: a file of the tour is in `directory` already, or the directory
            cannot be made or written to.
    """
    for path in (directory / name for name in (BAG, STORE, SLICE)):
        if path.exists():
            raise UsageError(f"{path} exists already; remove it or choose another directory")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(Path(__file__).with_name(BAG), directory / BAG)
    except OSError as error:
        if error.errno in NO_SPACE:
            raise DiskFullError(f"no space left in {directory}; choose another disk") from error
        raise UsageError(
            f"cannot write to {directory}: {error.strerror}; choose another directory"
        ) from error
    _print(f"The tour runs in {directory}\n{BAG} is the log of a minute of a simulated robot\n")
    for step in steps():
        _print(f"\n# {step.title}\n$ {step.command}\n")
        code = subprocess.run(step.argv, cwd=directory, check=False).returncode  # noqa: S603
        if code:
            _print(f"The tour stops here; its files remain in {directory}\n")
            sys.stderr.write(f"error: `{step.command}` failed with exit code {code}\n")
            # A child that was killed by a signal has a negative code, which shells cannot return.
            return code if code > 0 else 128 - code
    program = "hybridlog" if shutil.which("hybridlog") else f"{sys.executable} -m hybridlog"
    place = shlex.quote(str(directory / STORE))
    _print(f"\nAll files remain in {directory}; look at them: {program} view --store {place}\n")
    return 0


def _print(text: str) -> None:
    # Flushed, so that it precedes the output of the next command.
    sys.stdout.write(text)
    sys.stdout.flush()
