"""`hybridlog demo`: a guided tour of the demo bag, which prints and runs its commands."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

from hybridlog import demo
from hybridlog.cli.options import Options, argument, command
from hybridlog_storage.errors import UsageError

BAG, STORE, SLICE = "robot.bag", "robot-logs", "scan.npz"
"""Names of the files that the tour makes in its directory."""

_SNIPPET: Final = f"""\
import hybridlog as hl

with hl.open("{STORE}") as store:
    frame = store.topic("imu/data").to_pandas()
print(frame.shape)
print(frame[["angular_velocity.z", "linear_acceleration.x"]].describe())
"""
_AT: Final = f"--store {STORE}"
_FETCH: Final = "hybridlog fetch --topic"
_SECOND: Final = "--between +10s +11s"
_ERRORS: Final = "'status[].name,status[].message'"
_POSE: Final = "pose.pose.position.x,pose.pose.position.y,twist.twist.linear.x"
STEPS: Final = {
    "Record its log": f"hybridlog record {BAG} {_AT}",
    "What is in the store?": f"hybridlog ls {_AT}",
    "What did the robot say?": f"hybridlog info {_AT}",
    "How often was the gripper closed?": (
        f"{_FETCH} r_gripper_controller/command --where 'position == 0' --count {_AT}"
    ),
    "How many scans saw something nearer than half a metre?": (
        f"{_FETCH} scan --where 'ranges.min < 0.5' --count {_AT}"
    ),
    "Which errors did the diagnostics report?": (
        f"{_FETCH} diagnostics --where 'status.level >= 2' --fields {_ERRORS} --format jsonl {_AT}"
    ),
    "One second of the laser, as numpy arrays in a file": (
        f"{_FETCH} scan {_SECOND} --format npz -o {SLICE} {_AT}"
    ),
    "Where was the robot in that second, and how fast?": (
        f"{_FETCH} odom {_SECOND} --fields {_POSE} --every 10 {_AT}"
    ),
    "A pandas frame": f"python -c '\n{_SNIPPET}'",
}
"""Commands by title, in order."""


class _Given(Options):
    directory: Path = argument(
        "Directory for the bag and the store of the demo.",
        "[DIRECTORY]",
        default=Path("hybridlog-demo"),
    )


@command(_Given)
def demo_command(given: _Given) -> int:
    """Take a tour: record the log of a simulated robot, query it."""
    return run(given.directory)


def run(directory: Path) -> int:
    """Run the tour, which leaves its bag and store in `directory`.

    Returns the exit code of the step that failed, or 0. Raises UsageError where a file of the tour
    is there already.
    """
    for path in (directory / name for name in (BAG, STORE, SLICE)):
        if path.exists():
            raise UsageError(f"{path} exists already; remove it or choose another directory")
    directory.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(Path(demo.__file__).with_name(BAG), directory / BAG)
    _print(f"The tour runs in {directory}\n{BAG} is the log of a minute of a simulated robot\n")
    for title, typed in STEPS.items():
        _print(f"\n# {title}\n$ {typed}\n")
        code = subprocess.run(program(typed), cwd=directory, check=False).returncode  # noqa: S603
        if code:
            _print(f"The tour stops here; its files remain in {directory}\n")
            return abs(code)
    place = shlex.quote(str(directory / STORE))
    _print(f"\nAll files remain in {directory}; look at them: hybridlog view --store {place}\n")
    return 0


def program(typed: str) -> list[str]:
    """A command as it is run: with this Python, which imports nothing from here."""
    name, *words = shlex.split(typed)
    module = ["-m", "hybridlog"] if name == "hybridlog" else []
    return [sys.executable, "-P", *module, *words]


def _print(text: str) -> None:
    # Flushed, so that it precedes the output of the next command.
    sys.stdout.write(text)
    sys.stdout.flush()
