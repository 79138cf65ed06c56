"""`python -m benchmarks live`: runs the cases and shows what they found."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.live.cases import CASES, Row
from benchmarks.live.recorders import rosbag
from benchmarks.machine import describe
from benchmarks.side import SideError
from benchmarks.studies.runs import step


def main(arguments: list[str]) -> int:
    """Run the cases.

    Returns:
        0; 1 when something was missing without a word, or a recorder failed; 2 for wrong
        arguments.
    """
    chosen = _parser().parse_args(arguments)
    names = [name for name in CASES if not chosen.only or name in chosen.only]
    header: dict[str, Any] = {"benchmark": "live", "quick": chosen.quick, **describe(chosen.work)}
    rows: list[Row] = []
    if rosbag() is None:
        print("There is no rosbag here: hybridlog runs alone (python3-rosbag).", file=sys.stderr)
    failed = False
    with ExitStack() as stack:
        if chosen.work is None:
            work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hybridlog-live-")))
        else:
            work = chosen.work.resolve()
        for name in names:
            try:
                _run(name, work / "live", rows, quick=chosen.quick)
            except SideError as error:
                print(f"{name} failed: {error}", file=sys.stderr)
                failed = True
    table = markdown(header, rows)
    if chosen.out is not None:
        chosen.out.mkdir(parents=True, exist_ok=True)
        lines = [json.dumps(header), *(json.dumps(row._asdict()) for row in rows)]
        (chosen.out / "live.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(table)
    return int(failed or not all(row.holds for row in rows if row.recorder == "hybridlog"))


def _run(name: str, work: Path, rows: list[Row], *, quick: bool) -> None:
    case = CASES[name]
    with step(f"{name}: {case.about}"):
        rows.extend(case.run(work, quick))


def markdown(header: dict[str, Any], rows: list[Row]) -> str:
    """A table of all rows, with the machine below."""
    parts = ["| case | recorder | what came of it |", "|---|---|---|"]
    for row in rows:
        about = CASES[row.case].about if row.case in CASES else row.case
        parts.append(f"| {about} | {row.recorder} | {row.text} |")
    quick = " Quick run: short loads." if header["quick"] else ""
    stolen = max((row.values.get("stolen_s", 0.0) for row in rows), default=0.0)
    parts += [
        "",
        f"{header['cpu']}, {header['cores']} cores, {header['memory_gib']} GiB, "
        f"{header['disk']}; {header['system']}; Python {header['python']}, "
        f"MongoDB {header['mongod']}; revision {header['revision']}; {header['started']}; "
        f"the host took {stolen:g} s of processor time away during the worst case.{quick}",
    ]
    return "\n".join(parts)


def _parser() -> argparse.ArgumentParser:
    about = "\n".join(f"  {name:10} {case.about}" for name, case in CASES.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks live",
        description=(
            "Records a ROS 1 node under load, beside `rosbag record` where that is installed, "
            "and while things fail. Asks of hybridlog that what it lacks is in its ledger."
        ),
        epilog=f"cases:\n{about}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="short loads; about five minutes")
    parser.add_argument(
        "--only",
        action="append",
        choices=list(CASES),
        metavar="NAME",
        help="only this case; may be given several times",
    )
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="where recordings go; 30 GB must be free"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="write live.jsonl")
    return parser
