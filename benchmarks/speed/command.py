"""`python -m benchmarks speed`: runs the studies and shows what they found."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from benchmarks.documents import replace_section
from benchmarks.machine import describe
from benchmarks.progress import Steps, steps
from benchmarks.side import SideError
from benchmarks.speed import reading, record, start
from benchmarks.speed.bench import Bench, Settings
from benchmarks.speed.report import markdown, show
from benchmarks.speed.results import Outcome

DOCS = Path(__file__).parents[2] / "docs" / "benchmarks.md"


class _Study(NamedTuple):
    """One study.

    Attributes:
        run: What does it.
        about: What it measures.
        sides: Runs of sides in one repetition.
        once: Runs of sides besides.
        seconds: A run of a side takes about so long in a full and in a quick run.
    """

    run: Callable[[Bench], None]
    about: str
    sides: int
    once: int
    seconds: tuple[float, float]

    def runs(self, repetitions: int) -> int:
        """Runs of sides altogether."""
        return self.sides * repetitions + self.once


STUDIES = {
    "record_small": _Study(
        record.small, "record of small messages against the ways into MongoDB", 3, 2, (30, 4)
    ),
    "record_images": _Study(
        record.images, "record of 640 kB images against a copy by mcap", 3, 1, (5, 2)
    ),
    "slice": _Study(
        reading.slices, "a second of /scan out of ten minutes with two cameras", 2, 4, (6, 3)
    ),
    "to_pandas": _Study(reading.frames, "a million IMU messages as a frame", 3, 1, (25, 4)),
    "start": _Study(start.start, "hybridlog --help", 0, 0, (2, 2)),
}


def main(arguments: list[str]) -> int:
    """Run the study.

    Returns:
        0; 1 when a side failed or two sides differ, and with `--strict` when a target
        was missed; 2 for wrong arguments.
    """
    chosen = _parser().parse_args(arguments)
    names = [name for name in STUDIES if not chosen.only or name in chosen.only]
    with ExitStack() as stack:
        if chosen.work is None:
            work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hybridlog-speed-")))
        else:
            work = chosen.work.resolve()
            work.mkdir(parents=True, exist_ok=True)
        settings = Settings(chosen.quick, chosen.repetitions, chosen.seed, work)
        try:
            outcome = run(names, settings)
        except (SideError, AssertionError) as error:
            print(f"The benchmark failed: {error}", file=sys.stderr)
            return 1
    _give(outcome, chosen)
    missed = any(f.passed is False and not f.aim for f in outcome.findings)
    return 1 if missed and chosen.strict else 0


def run(names: list[str], settings: Settings) -> Outcome:
    """Run some studies.

    Raises:
        SideError: One side of a comparison failed.
        AssertionError: Two sides gave different answers.
    """
    outcome = Outcome(
        {
            "benchmark": "speed",
            "studies": names,
            "quick": settings.quick,
            "repetitions": settings.repetitions,
            "seed": settings.seed,
            **describe(),
        }
    )
    total = sum(
        STUDIES[name].runs(settings.repetitions) * STUDIES[name].seconds[settings.quick]
        for name in names
    )
    with steps(total) as progress:
        for name in names:
            _run_one(name, settings, outcome, progress)
    return outcome


def _run_one(name: str, settings: Settings, outcome: Outcome, progress: Steps) -> None:
    study = STUDIES[name]
    study.run(Bench(name, settings, outcome, progress, study.seconds[settings.quick]))


def _give(outcome: Outcome, chosen: argparse.Namespace) -> None:
    lines = [json.dumps(line) for line in outcome.lines()]
    if chosen.out is not None:
        chosen.out.mkdir(parents=True, exist_ok=True)
        (chosen.out / "speed.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
        (chosen.out / "speed.md").write_text(markdown(outcome) + "\n", encoding="utf-8")
    if chosen.write_docs:
        replace_section(DOCS, "results", markdown(outcome))
    if chosen.json:
        print("\n".join(lines))
    else:
        show(outcome, terminal=sys.stdout.isatty())


def _parser() -> argparse.ArgumentParser:
    about = "\n".join(f"  {name:14} {study.about}" for name, study in STUDIES.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks speed",
        description="Measures hybridlog against its speed targets, all ratios from one run.",
        epilog=f"studies:\n{about}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="small inputs; a few minutes")
    parser.add_argument(
        "--only",
        action="append",
        choices=list(STUDIES),
        metavar="NAME",
        help="only this study; may be given several times",
    )
    parser.add_argument(
        "--repetitions", type=_positive, default=3, metavar="N", help="of every side (3)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of all inputs (1)")
    parser.add_argument(
        "--work",
        type=Path,
        metavar="DIR",
        help="keep inputs here for the next run; without, a temporary directory",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="write speed.jsonl, speed.md")
    parser.add_argument("--json", action="store_true", help="JSON lines instead of a table")
    parser.add_argument("--strict", action="store_true", help="exit with 1 on a missed target")
    parser.add_argument(
        "--write-docs",
        action="store_true",
        help=f"put the table into {DOCS.parent.name}/{DOCS.name}",
    )
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("at least 1")
    return number
