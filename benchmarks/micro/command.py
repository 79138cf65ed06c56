"""`python -m benchmarks micro`: times the hot paths, alone or against another revision."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType

from benchmarks.machine import describe
from benchmarks.micro import inputs, revisions, running
from benchmarks.micro.compare import HotPath, compare, comparison_table, run_table
from benchmarks.micro.revisions import RevisionError
from benchmarks.micro.running import Run, RunError, Settings
from benchmarks.progress import steps

ROOT = Path(__file__).parents[2]

_QUICK_S = 0.05
# About; for the progress bar only.
_PATHS = 27
_SET_UP_S = 5
_STOPPED = 128


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two sources that were measured in turn.

    Attributes:
        revision: What the source was compared with, as it was named.
        commit: Its full name.
        paths: The findings.
    """

    revision: str
    commit: str
    paths: list[HotPath]


def main(arguments: list[str]) -> int:
    """Run the benchmarks.

    Returns:
        0; 1 when a run failed, a path does not run on the source as it is, or a path is
        slower than `--fail-above` allows; 2 for a revision that is not there; 128 and
        the signal when it was stopped.

    Raises:
        SystemExit: Wrong arguments.
    """
    chosen = _parse(arguments)
    settings = Settings(_QUICK_S if chosen.quick else chosen.seconds, chosen.only)
    try:
        with _stoppable():
            if chosen.against is None:
                return _give_run(measure(settings, ROOT), chosen)
            found = measure_against(chosen.against, settings, chosen.rounds, ROOT)
            return _give_comparison(found, chosen)
    except RevisionError as error:
        print(error, file=sys.stderr)
        return 2
    except RunError as error:
        print(error, file=sys.stderr)
        return 1
    except _StoppedError as stopped:
        print("interrupted", file=sys.stderr)
        return _STOPPED + stopped.number


def measure(settings: Settings, root: Path) -> Run:
    """Time the source as it is, once.

    Args:
        settings: How.
        root: The checkout.

    Raises:
        RunError: The run failed.
    """
    with _workspace(root) as work, steps(_weight(settings)) as progress:
        running.copy_source(root, work / "now")
        with progress.step("now", _weight(settings)):
            return _run(work, "now", settings)


def measure_against(revision: str, settings: Settings, rounds: int, root: Path) -> Comparison:
    """Time the source as it is and another revision in turn: A B B A.

    Args:
        revision: As git understands it; empty for the last commit.
        settings: How.
        rounds: How often four runs are made.
        root: The checkout.

    Raises:
        RevisionError: There is no such revision.
        RunError: A run failed.
    """
    revision = revision or revisions.last_commit(root)
    commit = revisions.commit_of(root, revision)
    runs: dict[str, list[Run]] = {"now": [], "before": []}
    with ExitStack() as stack:
        work = stack.enter_context(_workspace(root))
        stack.enter_context(revisions.worktree(root, commit, work / "before"))
        running.copy_source(root, work / "now")
        progress = stack.enter_context(steps(_weight(settings) * 4 * rounds))
        for side in ("now", "before", "before", "now") * rounds:
            with progress.step(side, _weight(settings)):
                runs[side].append(_run(work, side, settings))
    return Comparison(revision, commit, compare(runs["before"], runs["now"]))


@contextmanager
def _workspace(root: Path) -> Iterator[Path]:
    """A directory with the benchmarks and their inputs."""
    with tempfile.TemporaryDirectory(prefix="hybridlog-micro-") as name:
        work = Path(name).resolve()
        running.copy_benchmarks(root, work / "benchmarks")
        (work / "inputs").mkdir()
        inputs.make(work / "inputs")
        yield work


def _run(work: Path, side: str, settings: Settings) -> Run:
    return running.run(work / "benchmarks", work / side, work / "inputs", work / "run", settings)


def _weight(settings: Settings) -> float:
    return _SET_UP_S + _PATHS * settings.seconds


def _give_run(found: Run, chosen: argparse.Namespace) -> int:
    if chosen.json:
        _print_json({}, [{"kind": "path", "name": n, **asdict(t)} for n, t in found.timed.items()])
        for what, reasons in (("skipped", found.skipped), ("failed", found.failed)):
            for name, reason in reasons.items():
                print(json.dumps({"kind": what, "name": name, "reason": reason}))
    else:
        print(run_table(found))
    return 1 if found.failed else 0


def _give_comparison(found: Comparison, chosen: argparse.Namespace) -> int:
    limit: float | None = chosen.fail_above
    if chosen.json:
        header = {"against": found.revision, "commit": found.commit, "fail_above": limit}
        _print_json(header, [path.to_json() for path in found.paths])
    else:
        print(f"now against {found.revision} ({found.commit[:12]}); above 1x it is slower\n")
        print(comparison_table(found.paths, limit))
    slower = [path.name for path in found.paths if limit is not None and path.slower_than(limit)]
    broken = [path.name for path in found.paths if path.failed]
    if slower:
        print(f"slower than {limit:g} times: {', '.join(slower)}", file=sys.stderr)
    if broken:
        print(f"does not run now: {', '.join(broken)}", file=sys.stderr)
    return 1 if slower or broken else 0


def _print_json(header: Mapping[str, object], lines: Iterable[Mapping[str, object]]) -> None:
    for line in ({"kind": "run", "benchmark": "micro", **describe(), **header}, *lines):
        print(json.dumps(line, allow_nan=False))


class _StoppedError(BaseException):
    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def _stoppable() -> Iterator[None]:
    """Make Ctrl-C, `kill` and a closed terminal ways out that tidy up; the first one counts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    stopped = False

    def stop(number: int, _: FrameType | None) -> None:
        nonlocal stopped
        if not stopped:
            stopped = True
            raise _StoppedError(number)

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks micro",
        description="Times the hot paths of hybridlog, one at a time; with --against, as a "
        "ratio to another revision, the two in turn.",
    )
    parser.add_argument(
        "--against",
        nargs="?",
        const="",
        metavar="REV",
        help="compare with a revision; without REV the last commit: HEAD when the source has "
        "changes, else HEAD~1",
    )
    parser.add_argument(
        "--fail-above",
        type=_positive_number,
        metavar="RATIO",
        help="with --against: exit with 1 when a path takes so many times as long, such as 1.25",
    )
    parser.add_argument(
        "--only", default="", metavar="EXPR", help="paths by pytest's -k: 'transcode and imu'"
    )
    parser.add_argument(
        "--rounds", type=_positive, default=1, metavar="N", help="of four runs, A B B A (1)"
    )
    parser.add_argument(
        "--seconds",
        type=_positive_number,
        default=0.5,
        metavar="S",
        help="for a path in a run, about (0.5)",
    )
    parser.add_argument("--quick", action="store_true", help=f"{_QUICK_S} s for a path")
    parser.add_argument("--json", action="store_true", help="JSON lines instead of a table")
    chosen = parser.parse_args(arguments)
    if chosen.fail_above is not None and chosen.against is None:
        parser.error("--fail-above needs --against: a ratio is to another revision")
    return chosen


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("at least 1")
    return number


def _positive_number(text: str) -> float:
    number = float(text)
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError("more than 0")
    return number
