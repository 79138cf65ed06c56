"""`python -m benchmarks STUDY …`: runs studies, keeps a journal, writes a report.

Imports nothing heavy: `--help` answers at once.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import shlex
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, fields, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.samples import NAME, Journal
from hybridlog.cli import signals
from hybridlog.cli.app import of_os_error
from hybridlog.cli.output import note, parse_size, print_table, printable
from hybridlog_storage.errors import HybridlogError, UsageError
from hybridlog_storage.stopping import anywhere, at_safe_points

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend
    from benchmarks.studies.runs import Context

PARTS = {
    "throughput": "benchmarks.studies.throughput",
    "ceilings": "benchmarks.studies.ceiling",
    "persistence": "benchmarks.studies.persistence",
    "speed-up": "benchmarks.studies.speed_up",
    "queries": "benchmarks.studies.queries",
    "reading": "benchmarks.studies.reading",
}
"""Modules with `STUDY`, `Settings` and `run`, in the order of a run."""
STUDIES = {
    "throughput": ("throughput", "ceilings"),
    "persistence": ("persistence", "speed-up"),
    "queries": ("queries", "reading"),
    "all": tuple(PARTS),
}
_OPTIONS = ("sizes", "rates", "messages", "topics", "seconds", "logs", "log_seconds", "repetitions")
"""Options that change a setting of that name in each part that has it."""
_MAY_GROW = frozenset({"sizes", "rates", "backends", "repetitions", "logs", "made"})
"""Settings that say which runs there are, and nothing about what one run is."""
_LARGEST = 1 << 30
_EPILOG = """\
studies:
  throughput   study 1: what is kept of uniform streams; then each backend's ceiling
  persistence  study 2: what is kept of logs; then played faster until something is lost
  queries      study 3: the same questions to every system; then slices and whole tables
  all          the three
  report       draw the report again, from the journal
  live         recording a running robot under load, beside `rosbag record`

exit codes: 0 done; 1 a run failed, or answers differ; 2 wrong usage; 3 a log cannot be read;
130 Ctrl-C. The same command goes on where it stopped. Try `all --quick` first.
"""


class Part(NamedTuple):
    """A part of a run with its settings."""

    name: str
    module: ModuleType
    settings: Any


def main(arguments: Sequence[str]) -> int:
    """Run a command; returns the exit code."""
    if arguments and arguments[0] == "live":
        return int(import_module("benchmarks.live.command").main(list(arguments[1:])))
    signals.install()
    try:
        # Wherever it stops, the processes of a run are ended and the journal is closed.
        with at_safe_points(), anywhere():
            return _do(_parser().parse_args(arguments), ["python", "-m", "benchmarks", *arguments])
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


def _do(chosen: argparse.Namespace, command: list[str]) -> int:
    if chosen.list_backends:
        return _list_backends()
    return _draw(chosen.out) if chosen.study == "report" else _run(chosen, command)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m benchmarks",
        description="Measure what databases, files and hybridlog keep of a robot's messages.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("study", nargs="?", choices=[*STUDIES, "report"], default="all", metavar="STUDY")
    add("--only", action="append", choices=list(PARTS), help="only this part; repeatable")
    add("--quick", action="store_true", help="few messages, the ends of each axis: minutes")
    add("-b", "--backends", metavar="NAME,…", help="only these")
    add("--list-backends", action="store_true", help="and whether they can run here")
    add("-o", "--out", type=Path, default=Path("benchmark-results"), metavar="DIR")
    add("--work", type=Path, metavar="DIR", help="where loads are kept and data goes")
    add("--restart", action="store_true", help="set the journal aside that is there")
    add("--seed", type=_count, default=1, metavar="N", help="of all loads (1)")
    add("-n", "--repetitions", type=_count, metavar="N", help="of every run")
    add("--sizes", type=_sizes, metavar="SIZE,…", help="of messages, such as 5kB,640kB")
    add("--rates", type=_rates, metavar="HZ,…", help="of a topic, such as 4,64")
    add("--messages", type=_count, metavar="N", help="of a topic (500)")
    add("--topics", type=_count, metavar="N", help="(20)")
    add("--seconds", type=_seconds, metavar="S", help="of a trial that looks for a ceiling")
    add("-l", "--logs", type=Path, action="append", metavar="FILE", help="publish this log")
    add("--no-made", action="store_true", help="publish no logs that are made")
    add("--log-seconds", type=_seconds, metavar="S", help="most of each log (60)")
    add("--speed", type=_seconds, default=1.0, metavar="N", help="times as fast as recorded")
    return parser


def _count(text: str) -> int:
    number = int(text)
    if not 0 < number <= 10**7:
        raise argparse.ArgumentTypeError("1 to 10000000")
    return number


def _seconds(text: str) -> float:
    number = float(text)
    if not 1e-3 <= number < 1e6:
        raise argparse.ArgumentTypeError(f"{text} is not between 0.001 and 1000000")
    return number


def _rates(text: str) -> list[float]:
    return sorted({_seconds(word.strip().removesuffix("Hz")) for word in text.split(",")})


def _sizes(text: str) -> list[int]:
    from benchmarks.loads.streams import MIN_SIZE

    try:
        found = sorted({parse_size(word.strip()) for word in text.split(",")})
    except UsageError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if not MIN_SIZE <= found[0] <= found[-1] <= _LARGEST:
        raise argparse.ArgumentTypeError(f"a message has {MIN_SIZE} to {_LARGEST} bytes")
    return found


def _backends(names: str | None) -> dict[str, type[Backend]]:
    from benchmarks.backends.registry import BACKENDS

    chosen = [name.strip() for name in names.split(",")] if names is not None else list(BACKENDS)
    for name in chosen:
        if name not in BACKENDS:
            raise UsageError(f"There is no backend {name!r}; there are {', '.join(BACKENDS)}.")
    return {name: kind for name, kind in BACKENDS.items() if name in chosen}


def _missing_reason(kind: type[Backend]) -> str:
    from benchmarks.backends.base import BackendMissingError

    try:
        kind.check()
    except BackendMissingError as error:
        return str(error)
    return ""


def _list_backends() -> int:
    found = [(name, _missing_reason(k) or "yes", k.about) for name, k in _backends(None).items()]
    print_table((("name", "whole"), ("runs here", "left"), ("about", "left")), found)
    return 0


# --- a run ----------------------------------------------------------------------------


def _run(chosen: argparse.Namespace, command: list[str]) -> int:
    backends = _backends(chosen.backends)
    planned = [_part(name, chosen) for name in STUDIES[chosen.study]]
    planned = [part for part in planned if not chosen.only or part.name in chosen.only]
    if not planned:
        raise UsageError(f"--only leaves nothing of {chosen.study}.")
    with ExitStack() as stack:
        stack.enter_context(_locked(chosen.out))
        journal = _journal(chosen)
        work = _work(chosen.work, stack)
        header = _header(chosen, planned, command, work)
        _check_settings(journal, header, chosen.out)
        context = _context(journal, work, backends, chosen)
        done = sum(sample.status == "ok" for sample in journal.samples.values())
        if done:
            note(f"benchmarks: going on with {journal.path}: {done} runs are not done again")
        journal.begin(header)
        try:
            for part in planned:
                speed = chosen.speed if part.name == "persistence" else 1.0
                part.module.run(replace(context, speed=speed), part.settings)
        except signals.Stopped as stopped:
            again = shlex.join(word for word in command if word != "--restart")
            done = sum(sample.status == "ok" for sample in journal.samples.values())
            drawing = shlex.join([*command[:3], "report", "--out", str(chosen.out)])
            stopped.consequence = (
                f"{done} runs so far.\nTo go on: {again}\nTo draw what is there: {drawing}"
            )
            raise
        return _report(journal, chosen.out)


def _part(name: str, chosen: argparse.Namespace) -> Part:
    """A part with its own settings, changed by the options that it has."""
    module = import_module(PARTS[name])
    settings = module.Settings.usual(quick=chosen.quick)
    asked = {option: getattr(chosen, option) for option in _OPTIONS}
    for log in chosen.logs or ():
        if not log.exists():
            raise UsageError(f"{log}: there is no such file.")
    asked["logs"] = tuple(log.resolve() for log in chosen.logs or ()) or None
    asked["made"] = () if chosen.no_made else None
    names = {field.name for field in fields(settings)}
    changed = {k: value for k, value in asked.items() if value is not None and k in names}
    if name in {"queries", "reading"}:
        changed.pop("seconds", None)  # the length of their load, not of a trial
    return Part(name, module, replace(settings, **changed))


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
        raise UsageError(f"{out / NAME} is no journal of these studies ({error}).") from None


def _work(asked: Path | None, stack: ExitStack) -> Path:
    if asked is None:
        return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hybridlog-bench-")))
    asked.mkdir(parents=True, exist_ok=True)
    return asked.resolve()


def _header(
    chosen: argparse.Namespace, planned: Sequence[Part], command: list[str], work: Path
) -> dict[str, Any]:
    from benchmarks.machine import describe

    # A journal gives tuples back as lists, and paths as text.
    settings = {part.module.STUDY: asdict(part.settings) for part in planned}
    settings = json.loads(json.dumps(settings, default=str))
    if "persistence" in settings:
        settings["persistence"]["speed"] = chosen.speed
    about = {"quick": chosen.quick, "seed": chosen.seed, "settings": settings, "command": command}
    return {"benchmark": "studies", **about, **describe(work)}


def _check_settings(journal: Journal, header: Mapping[str, Any], out: Path) -> None:
    """Refuse to add runs that are another measurement than those of the journal."""

    def sense(of: Mapping[str, Any]) -> dict[str, Any]:
        found = {name: of[name] for name in ("quick", "seed") if name in of}
        for study, values in of.get("settings", {}).items():
            kept = {f"{study} {k}": v for k, v in values.items() if k not in _MAY_GROW}
            found.update(kept)
        return found

    new = sense(header)
    for old in map(sense, journal.headers if journal.samples else ()):
        for name, value in new.items():
            if name in old and old[name] != value:
                raise UsageError(
                    f"The results in {out} were taken with {name} {old[name]}, now it is {value}. "
                    "Give the same options again to go on, --out DIR for a second set, or "
                    "--restart to begin anew."
                )


def _context(
    journal: Journal,
    work: Path,
    backends: Mapping[str, type[Backend]],
    chosen: argparse.Namespace,
) -> Context:
    from benchmarks.studies.runs import Context

    missing = {name: reason for name, kind in backends.items() if (reason := _missing_reason(kind))}
    for name, reason in missing.items():
        note(f"benchmarks: {name} is left out: {reason}")
    quick, seed = chosen.quick, chosen.seed
    return Context(work, backends, journal, quick=quick, seed=seed, missing=missing)


# --- a report -------------------------------------------------------------------------


def _draw(out: Path) -> int:
    if not (out / NAME).is_file():
        raise UsageError(f"{out} holds no results ({NAME}); --out DIR says where they are.")
    return _report(_read(out), out)


def _report(journal: Journal, out: Path) -> int:
    from benchmarks.report import write

    report, path = write(journal, out)
    for text in report.findings:
        print(f"* {printable(text)}")
    for one in report.failed:
        print(f"FAILED {one.study}, {one.backend}: {printable(one.reason)}")
    note(f"benchmarks: wrote {path}")
    sys.stdout.flush()
    return 1 if report.failed or report.differing else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
