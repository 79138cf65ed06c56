"""`python -m benchmarks`: measures all that the results show, and writes their page.

Imports nothing heavy: `--help` answers at once.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

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
BUDGET: Mapping[Scale, float] = {"full": 55.0, "quick": 18.0, "tiny": 0.0}
"""Minutes; a search is repeated only where that fits."""
_EPILOG = """\
parts:
  tasks    commands, SQL, many recordings, the page and a bucket
  queries  the paper's questions to every system
  reading  slices, messages at a time and whole tables from every system
  live     recording a running robot, beside `rosbag record` where that is installed
  logs     the log of a robot, played faster until something is lost
  record   streams of messages: the largest load of which nothing is lost

It takes less than an hour and 20 GB of disk; --quick takes 20 minutes. The same command goes on
where it stopped, and does again what failed. --docs writes docs/benchmarks.md, its samples and
the table of README.md.

exit codes: 0 done; 1 something failed, or answers differ; 2 wrong usage; 130 Ctrl-C.
"""


class Piece(NamedTuple):
    """A part of a run that is done as a whole.

    Attributes:
        part: The part that it belongs to.
        name: For people.
        minutes: It may take, by scale.
        run: Does it.
        is_extra: It repeats a search, and is left out when there is no time for it.
    """

    part: str
    name: str
    minutes: Mapping[Scale, float]
    run: Callable[[Context], None]
    is_extra: bool = False


def pieces() -> list[Piece]:
    """All of a run, in its order."""
    from benchmarks.live import cases
    from benchmarks.studies import logs, queries, reading, record, tasks

    def minutes(full: float, quick: float) -> Mapping[Scale, float]:
        return {"full": full, "quick": quick, "tiny": 0.1}

    def task(group: str) -> Piece:
        times = {"commands": (5.0, 2.0), "many": (2.5, 1.8)}.get(group, (0.5, 0.3))
        return Piece("tasks", group, minutes(*times), lambda context: tasks.run(context, group))

    def case(name: str) -> Piece:
        times = {"robot": (2.7, 0.8), "kills": (2.0, 0.4), "database": (1.3, 0.6)}
        each = minutes(*times.get(name, (0.8, 0.4)))
        return Piece("live", name, each, lambda context: cases.run(context, name))

    def play(repetition: int) -> Piece:
        each = minutes(4.5, 1.8)
        again = repetition > 0
        return Piece("logs", "logs", each, lambda c: logs.run(c, repetition), is_extra=again)

    def stream(size: int, repetition: int) -> Piece:
        each = minutes(6.0, 2.7)
        name = f"record {size // 1000} kB"
        again = repetition > 0
        return Piece(
            "record", name, each, lambda c: record.run(c, size, repetition), is_extra=again
        )

    return [
        *map(task, tasks.GROUPS),
        Piece("queries", "queries", minutes(5.0, 1.5), queries.run),
        Piece("reading", "reading", minutes(2.5, 1.0), reading.run),
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
            command = ["python", "-m", "benchmarks", *arguments]
            return _draw(chosen) if chosen.render else _run(chosen, command)
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
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument(
        "--quick", dest="scale", action="store_const", const="quick", help="in 20 minutes"
    )
    scale.add_argument(
        "--tiny", dest="scale", action="store_const", const="tiny", help="only see that it works"
    )
    parser.set_defaults(scale="full")
    add("--only", action="append", choices=PARTS, help="only this part; repeatable")
    add("-b", "--backends", metavar="NAME,…", help="only these systems")
    add("-o", "--out", type=Path, default=Path("benchmark-results"), metavar="DIR")
    add("--work", type=Path, metavar="DIR", help="where loads are kept and data goes")
    add("--restart", action="store_true", help="set the journal aside that is there")
    add("--seed", type=int, default=1, metavar="N", help="of all loads (1)")
    add("--docs", action="store_true", help="write the page and README.md of this checkout")
    add("--render", action="store_true", help="measure nothing: write what the journal shows")
    return parser


# --- a run ----------------------------------------------------------------------------


def _run(chosen: argparse.Namespace, command: list[str]) -> int:
    backends = _backends(chosen.backends)
    planned = [piece for piece in pieces() if not chosen.only or piece.part in chosen.only]
    scale: Scale = chosen.scale
    with ExitStack() as stack:
        stack.enter_context(_locked(chosen.out))
        journal = _journal(chosen)
        work = _work(chosen.work, stack)
        header = _header(chosen, command, work)
        _check_settings(journal, header, chosen.out)
        first = [(piece.name, piece.minutes[scale]) for piece in planned if not piece.is_extra]
        progress = Progress([*first, ("repetitions", 0.0)])
        context = _context(journal, work, backends, chosen, progress)
        done = sum(sample.status == "ok" for sample in journal.samples.values())
        if done:
            note(f"benchmarks: going on with {journal.path}: {done} samples are there")
        journal.begin(header)
        try:
            failures = _pieces(context, planned, BUDGET[scale])
        except signals.Stopped as stopped:
            again = shlex.join(word for word in command if word != "--restart")
            stopped.consequence = f"What was measured is in {journal.path}.\nTo go on: {again}"
            raise
        return max(_write(journal, chosen), int(failures))


def _pieces(context: Context, planned: Sequence[Piece], budget: float) -> bool:
    """Do the pieces of a run; returns whether any broke off."""
    is_broken, number = False, 0
    for piece in planned:
        if piece.is_extra:
            if context.progress.minutes + piece.minutes[context.scale] > budget:
                continue
            number = len(context.progress.pieces) - 1
        context.progress.begin(number)
        try:
            piece.run(context)
        except (HybridlogError, SideError, RuntimeError, ValueError, ImportError) as error:
            # The others go on; the same command tries this one again.
            context.progress.say(f"{piece.name} FAILED: {printable(str(error))}")
            is_broken = True
        number += 1
    return is_broken


def _backends(names: str | None) -> dict[str, type[Backend]]:
    from benchmarks.backends.registry import BACKENDS

    chosen = [name.strip() for name in names.split(",")] if names is not None else list(BACKENDS)
    for name in chosen:
        if name not in BACKENDS:
            raise UsageError(f"There is no backend {name!r}; there are {', '.join(BACKENDS)}.")
    return {name: kind for name, kind in BACKENDS.items() if name in chosen}


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Nobody else writes into a directory of results while the block runs."""
    is_new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(out, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise UsageError(f"{out} cannot be used: {error.strerror}.") from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UsageError(f"Another run is writing into {out}: name another --out.") from None
        yield
    finally:
        os.close(descriptor)
        if is_new:
            with suppress(OSError):  # something was written
                out.rmdir()


def _journal(chosen: argparse.Namespace) -> Journal:
    path = chosen.out / NAME
    if chosen.restart and path.exists():
        aside = chosen.out / f"samples.{len(list(chosen.out.glob('samples*.jsonl')))}.jsonl"
        path.rename(aside)
        note(f"benchmarks: beginning anew; what was there is {aside}")
    return _read(chosen.out)


def _read(out: Path) -> Journal:
    try:
        return Journal(out)
    except ValueError as error:
        raise UsageError(f"{out / NAME} is no journal of these benchmarks ({error}).") from None


def _work(asked: Path | None, stack: ExitStack) -> Path:
    if asked is None:
        return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hybridlog-bench-")))
    asked.mkdir(parents=True, exist_ok=True)
    return asked.resolve()


def _header(chosen: argparse.Namespace, command: list[str], work: Path) -> dict[str, Any]:
    from benchmarks.machine import describe

    about = {"scale": chosen.scale, "seed": chosen.seed, "command": command}
    return {**about, **describe(work)}


def _check_settings(journal: Journal, header: Mapping[str, Any], out: Path) -> None:
    """Refuse to add runs that are another measurement than those of the journal."""
    for old in journal.headers if journal.samples else ():
        for name in ("scale", "seed"):
            if old[name] != header[name]:
                raise UsageError(
                    f"The results in {out} were taken with {name} {old[name]}, now it is "
                    f"{header[name]}. Give the same options again to go on, --out DIR for a "
                    "second set, or --restart to begin anew."
                )


def _context(
    journal: Journal,
    work: Path,
    backends: Mapping[str, type[Backend]],
    chosen: argparse.Namespace,
    progress: Progress,
) -> Context:
    from benchmarks.backends.base import BackendMissingError
    from benchmarks.studies.runs import Context

    missing = {}
    for name, kind in backends.items():
        try:
            kind.check()
        except BackendMissingError as error:
            missing[name] = str(error)
            note(f"benchmarks: {name} is left out: {error}")
    scale, seed = chosen.scale, chosen.seed
    return Context(work, backends, journal, scale, seed, progress, missing)


# --- the page -------------------------------------------------------------------------


def _draw(chosen: argparse.Namespace) -> int:
    if not (chosen.out / NAME).is_file():
        raise UsageError(f"{chosen.out} holds no results ({NAME}); --out DIR says where they are.")
    return _write(_read(chosen.out), chosen)


def _write(journal: Journal, chosen: argparse.Namespace) -> int:
    from benchmarks import page

    if not journal.headers:
        raise UsageError("Nothing has been measured yet.")
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
