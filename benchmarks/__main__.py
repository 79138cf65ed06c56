"""`python -m benchmarks`: measures all that the results show, and writes their page.

Imports nothing heavy: `--help` answers at once.
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from benchmarks.samples import NAME, Journal
from benchmarks.side import SideError
from hybridlog.cli.app import of_os_error
from hybridlog.cli.output import note, printable
from hybridlog_storage.errors import HybridlogError, UsageError

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend
    from benchmarks.studies.runs import Context

ROOT = Path(__file__).parents[1]
PAGE = "benchmarks.md"
UNTIL = {"full": 49.0, "tiny": 0.0}
"""Minutes until which the repetition of a search is begun."""
PARTS = ("tasks", "queries", "reading", "live", "logs", "record")
_EPILOG = """\
parts:
  tasks    commands, SQL, many recordings
  queries  the paper's questions to every system
  reading  slices, messages at a time and whole tables from every system
  live     recording a running robot
  logs     the log of a robot, played faster until something is lost
  record   streams of messages: the largest load of which nothing is lost

It takes less than an hour and 20 GB of disk. --docs writes docs/benchmarks.md, its samples
and the table of README.md.

exit codes: 0 done; 1 something failed, or answers differ; 2 wrong usage; 130 Ctrl-C.
"""


def pieces() -> list[tuple[str, Callable[[Context], None], bool]]:
    """All of a run in its order: the part, what is done as a whole, whether it repeats a search."""
    from benchmarks.studies import answers, live, record, tasks

    found: list[tuple[str, Callable[[Context], None], bool]] = [
        *(("tasks", partial(tasks.run, group=group), False) for group in tasks.GROUPS),
        ("queries", answers.queries, False),
        ("reading", answers.reading, False),
        *(("live", partial(live.run, name=name), False) for name in live.CASES),
    ]
    for n in (0, 1):
        found.append(("logs", partial(record.play, repetition=n), n > 0))
        found += [
            ("record", partial(record.stream, size=size, repetition=n), n > 0)
            for size in record.SIZES
        ]
    return found


def main(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        chosen = _parser().parse_args(arguments)
        if chosen.render:
            return _write(Journal(chosen.out), chosen)
        return _run(chosen, ["python", "-m", "benchmarks", *arguments])
    except HybridlogError as error:
        print(f"benchmarks: {printable(str(error))}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:  # the processes of a run are ended, and the journal is closed
        print("\nbenchmarks: interrupted.", file=sys.stderr)
        return 130
    except OSError as error:
        text = printable(f"{error}. What was measured before stays.")
        print(f"benchmarks: {text}", file=sys.stderr)
        return of_os_error(error)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m benchmarks",
        description="Measure hybridlog beside databases and files, and write the page about it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    parser.set_defaults(scale="full")
    add("--tiny", dest="scale", action="store_const", const="tiny", help="only see that it works")
    add("--only", action="append", choices=PARTS, help="only this part; repeatable")
    add("-b", "--backends", metavar="NAME,…", help="only these systems")
    add("-o", "--out", type=Path, default=Path("benchmark-results"), metavar="DIR")
    add("--work", type=Path, metavar="DIR", help="where loads and data go, until the end")
    add("--seed", type=int, default=1, metavar="N", help="of all loads (1)")
    add("--docs", action="store_true", help="write the page and README.md of this checkout")
    add("--render", action="store_true", help="measure nothing: write what the journal shows")
    return parser


def _run(chosen: argparse.Namespace, command: list[str]) -> int:
    from benchmarks.studies.runs import Context, describe

    backends, is_broken = _backends(chosen.backends), False
    with TemporaryDirectory(prefix="hybridlog-bench-", dir=chosen.work) as directory:
        work = Path(directory)
        about = {"scale": chosen.scale, "seed": chosen.seed, "command": command}
        journal = Journal(chosen.out, {**about, **describe(work)})
        context = Context(work, backends, journal, chosen.scale, chosen.seed, _missing(backends))
        try:
            for part, run, is_extra in pieces():
                is_late = is_extra and context.minutes > UNTIL[chosen.scale]
                if is_late or part not in (chosen.only or PARTS):
                    continue
                try:
                    run(context)
                except (HybridlogError, SideError, RuntimeError, ValueError, ImportError) as error:
                    # The others go on.
                    context.say(f"{part} FAILED: {printable(str(error))}")
                    is_broken = True
        except KeyboardInterrupt:
            context.say(f"What was measured is in {journal.path}.")
            raise
        return max(_write(journal, chosen), int(is_broken))


def _backends(names: str | None) -> dict[str, type[Backend]]:
    from benchmarks.backends.registry import BACKENDS

    chosen = [name.strip() for name in names.split(",")] if names is not None else list(BACKENDS)
    for name in chosen:
        if name not in BACKENDS:
            raise UsageError(f"There is no backend {name!r}; there are {', '.join(BACKENDS)}.")
    return {name: kind for name, kind in BACKENDS.items() if name in chosen}


def _missing(backends: Mapping[str, type[Backend]]) -> dict[str, str]:
    """Backends that cannot be used here, and why."""
    from benchmarks.backends.base import BackendMissingError

    found = {}
    for name, kind in backends.items():
        try:
            kind.check()
        except BackendMissingError as error:
            note(f"benchmarks: {name} is left out: {error}")
            found[name] = str(error)
    return found


def _write(journal: Journal, chosen: argparse.Namespace) -> int:
    """Write the page; returns 1 if anything failed."""
    from benchmarks import page

    text, table = page.page(journal), page.readme(journal)
    for name, content in ((PAGE, text), ("readme.md", table + "\n")):
        (chosen.out / name).write_text(content, encoding="utf-8")
    if chosen.docs:
        (ROOT / "docs" / PAGE).write_text(text, encoding="utf-8")
        results = ROOT / "docs" / "benchmarks-results"
        results.mkdir(exist_ok=True)
        shutil.copyfile(journal.path, results / NAME)
        readme = ROOT / "README.md"
        old = re.escape(page.BEGIN) + ".*" + re.escape(page.END)
        new, count = re.subn(old, lambda _: table, readme.read_text("utf-8"), flags=re.DOTALL)
        if count != 1:
            raise UsageError(f"{readme} lacks {page.BEGIN} or {page.END}.")
        readme.write_text(new, encoding="utf-8")
    failed = page.Results(journal).failed
    for one in failed:
        print(f"FAILED {one.study}, {one.backend}: {printable(one.reason)}")
    note(f"benchmarks: wrote {chosen.out / PAGE}{', the page and README.md' * chosen.docs}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
