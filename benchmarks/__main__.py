"""`python -m benchmarks`: measures all that the results show, and writes their page.

Imports nothing heavy: `--help` answers at once.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.progress import Progress
from benchmarks.samples import NAME, Journal, Scale
from benchmarks.side import SideError
from hybridlog.cli import signals
from hybridlog.cli.app import of_os_error
from hybridlog.cli.output import note, printable
from hybridlog_storage.errors import HybridlogError, UsageError
from hybridlog_storage.stopping import anywhere, at_safe_points

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend
    from benchmarks.studies.runs import Context

ROOT = Path(__file__).parents[1]
PAGE = "benchmarks.md"
README = "readme.md"
UNTIL: Mapping[Scale, float] = {"full": 49.0, "tiny": 0.0}
"""Minutes until which the repetition of a search is begun."""
_EPILOG = """\
parts:
  tasks    commands, SQL, many recordings and the page
  queries  the paper's questions to every system
  reading  slices, messages at a time and whole tables from every system
  live     recording a running robot
  logs     the log of a robot, played faster until something is lost
  record   streams of messages: the largest load of which nothing is lost

It takes less than an hour and 20 GB of disk. --docs writes docs/benchmarks.md, its samples
and the table of README.md.

exit codes: 0 done; 1 something failed, or answers differ; 2 wrong usage; 130 Ctrl-C.
"""


class Piece(NamedTuple):
    """A part of a run that is done as a whole.

    Attributes:
        part: The part that it belongs to.
        name: For people.
        run: Does it.
        is_extra: It repeats a search, and is left out when there is no time for it.
    """

    part: str
    name: str
    run: Callable[[Context], None]
    is_extra: bool = False


def pieces() -> list[Piece]:
    """All of a run, in its order."""
    from benchmarks.live import cases
    from benchmarks.studies import logs, queries, reading, record, tasks

    def task(group: str) -> Piece:
        return Piece("tasks", group, lambda context: tasks.run(context, group))

    def case(name: str) -> Piece:
        return Piece("live", name, lambda context: cases.run(context, name))

    def play(repetition: int) -> Piece:
        return Piece("logs", "logs", lambda c: logs.run(c, repetition), repetition > 0)

    def stream(size: int, repetition: int) -> Piece:
        name = f"record {size // 1000} kB"
        return Piece("record", name, lambda c: record.run(c, size, repetition), repetition > 0)

    return [
        *map(task, tasks.GROUPS),
        Piece("queries", "queries", queries.run),
        Piece("reading", "reading", reading.run),
        *map(case, cases.CASES),
        play(0),
        *(stream(size, 0) for size in record.SIZES),
        *(stream(size, 1) for size in record.SIZES),
        play(1),
    ]


PARTS = ("tasks", "queries", "reading", "live", "logs", "record")


def main(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    signals.install()
    try:
        # Wherever it stops, the processes of a run are ended and the journal is closed.
        with at_safe_points(), anywhere():
            chosen = _parser().parse_args(arguments)
            if chosen.render:
                return _write(Journal(chosen.out), chosen)
            return _run(chosen, ["python", "-m", "benchmarks", *arguments])
    except HybridlogError as error:
        print(f"benchmarks: {printable(str(error))}", file=sys.stderr)
        return error.exit_code
    except signals.Stopped as stopped:
        print(f"\nbenchmarks: interrupted. {stopped.consequence}".rstrip(), file=sys.stderr)
        return stopped.exit_code
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


# --- a run ----------------------------------------------------------------------------


def _run(chosen: argparse.Namespace, command: list[str]) -> int:
    from benchmarks.machine import describe
    from benchmarks.studies.runs import Context

    backends = _backends(chosen.backends)
    planned = [piece for piece in pieces() if not chosen.only or piece.part in chosen.only]
    with TemporaryDirectory(prefix="hybridlog-bench-", dir=chosen.work) as directory:
        work = Path(directory)
        about = {"scale": chosen.scale, "seed": chosen.seed, "command": command}
        journal = Journal(chosen.out, {**about, **describe(work)})
        context = Context(work, backends, journal, chosen.scale, chosen.seed, Progress())
        context.missing.update(_missing(backends))
        try:
            failures = _pieces(context, planned)
        except signals.Stopped as stopped:
            stopped.consequence = f"What was measured is in {journal.path}."
            raise
        return max(_write(journal, chosen), int(failures))


def _pieces(context: Context, planned: Sequence[Piece]) -> bool:
    """Do the pieces of a run; returns whether any broke off."""
    is_broken = False
    for piece in planned:
        if piece.is_extra and context.progress.minutes > UNTIL[context.scale]:
            continue
        try:
            piece.run(context)
        except (HybridlogError, SideError, RuntimeError, ValueError, ImportError) as error:
            # The others go on.
            context.progress.say(f"{piece.name} FAILED: {printable(str(error))}")
            is_broken = True
    return is_broken


def _backends(names: str | None) -> dict[str, type[Backend]]:
    from benchmarks.backends.registry import BACKENDS

    chosen = [name.strip() for name in names.split(",")] if names is not None else list(BACKENDS)
    for name in chosen:
        if name not in BACKENDS:
            raise UsageError(f"There is no backend {name!r}; there are {', '.join(BACKENDS)}.")
    return {name: kind for name, kind in BACKENDS.items() if name in chosen}


def _missing(backends: Mapping[str, type[Backend]]) -> Iterator[tuple[str, str]]:
    """Backends that cannot be used here, and why."""
    from benchmarks.backends.base import BackendMissingError

    for name, kind in backends.items():
        try:
            kind.check()
        except BackendMissingError as error:
            note(f"benchmarks: {name} is left out: {error}")
            yield name, str(error)


# --- the page -------------------------------------------------------------------------


def _write(journal: Journal, chosen: argparse.Namespace) -> int:
    from benchmarks import page

    text, table = page.page(journal), page.readme(journal)
    for name, content in ((PAGE, text), (README, table + "\n")):
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
    results_ = page.Results(journal)
    for one in results_.failed:
        print(f"FAILED {one.study}, {one.backend}: {printable(one.reason)}")
    note(f"benchmarks: wrote {chosen.out / PAGE}{', the page and README.md' * chosen.docs}")
    return int(bool(results_.failed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
