"""A run of the studies from the command line: what was asked, the journal, the report."""

from __future__ import annotations

import fcntl
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.samples import NAME, Journal
from hybridlog.cli.output import counted, note, parse_size, print_json, print_table
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend
    from benchmarks.report.model import Report
    from benchmarks.studies.runs import Context


class _Part(NamedTuple):
    """A part of a campaign.

    Attributes:
        module: With `STUDY`, `Settings`, `run` and `expected_seconds`.
        options: Those of the command line that its settings take.
    """

    module: str
    options: tuple[str, ...]


PARTS = {
    "throughput": _Part(
        "benchmarks.studies.throughput", ("sizes", "rates", "messages", "topics", "repetitions")
    ),
    "ceilings": _Part("benchmarks.studies.ceiling", ("sizes", "topics", "seconds", "repetitions")),
    "persistence": _Part(
        "benchmarks.studies.persistence", ("logs", "made", "log_seconds", "repetitions")
    ),
    "speed-up": _Part(
        "benchmarks.studies.speed_up", ("logs", "made", "log_seconds", "repetitions")
    ),
    "queries": _Part("benchmarks.studies.queries", ("repetitions",)),
    "reading": _Part("benchmarks.studies.reading", ("repetitions",)),
}
"""By the names of the command line, in the order in which they run."""

_LARGEST = 1 << 30
"""Bytes of a message: what takes more is no stream any more."""

_MAY_GROW = frozenset({"sizes", "rates", "backends", "repetitions", "logs", "made"})
"""Settings that say which runs there are, and nothing about what one run is."""


@dataclass(frozen=True, slots=True)
class Choices:
    """What was asked for on the command line; None is what each study thinks best.

    Attributes:
        parts: Keys of `PARTS`.
        out: Of journal and report.
        quick: Small cases.
        backends: Names, or beginnings of names, with commas between them; None for all.
        sizes: Message sizes, with commas between them.
        rates: Rates in Hz, with commas between them.
        messages: On each topic.
        topics: Number of topics.
        seconds: Of a trial that looks for a ceiling.
        logs: Files to publish instead of the real logs beside the checkout.
        made: Whether to publish the logs that are made, too.
        log_seconds: Most of each log that is published.
        speed: Times as fast as the logs were recorded.
        repetitions: Of every run.
        seed: Of all loads.
        work: For loads and data; None for a temporary directory.
        restart: Whether to set the journal aside that is there.
        report: Whether to write the report.
        as_json: Whether to print JSON.
    """

    parts: Sequence[str]
    out: Path
    quick: bool = False
    backends: Sequence[str] | None = None
    sizes: str | None = None
    rates: str | None = None
    messages: int | None = None
    topics: int | None = None
    seconds: float | None = None
    logs: Sequence[Path] = ()
    made: bool = True
    log_seconds: float | None = None
    speed: float = 1.0
    repetitions: int | None = None
    seed: int = 1
    work: Path | None = None
    restart: bool = False
    report: bool = True
    as_json: bool = False


class _Planned(NamedTuple):
    """A part with its settings."""

    name: str
    module: ModuleType
    settings: Any


def run(choices: Choices, command: Sequence[str]) -> int:
    """Do what is asked for and not yet done, then show and write what was found.

    Args:
        choices: What is asked for.
        command: How to ask for it again, word by word.

    Returns:
        0; 1 when a run failed or backends gave different answers.

    Raises:
        UsageError: An option is wrong, or the journal belongs to other settings.
        Stopped: The command was told to stop; what is done is kept.
    """
    from hybridlog.cli.signals import Stopped

    backends = _chosen_backends(choices.backends)
    planned = [_plan(name, choices) for name in choices.parts]
    if not planned:
        raise UsageError("Nothing is left to run: --only and --no-… exclude each other.")
    with ExitStack() as stack:
        stack.enter_context(_locked(choices.out))
        journal = _opened(choices)
        work = _work(choices.work, stack)
        header = _header(choices, planned, backends, command, work)
        _see_that_it_fits(journal, header, choices.out)
        try:
            _run_parts(planned, choices, _context(journal, work, backends, choices), header)
        except Stopped as stopped:
            again = [word for word in command if word != "--restart"]
            program = takewhile(lambda word: word not in {*PARTS, "all"}, command)
            drawing = [*program, "report", "--out", str(choices.out)]
            stopped.consequence = (
                f"{counted(_good(journal), 'run')} so far, kept in {journal.path}.\n"
                f"To go on: {_as_typed(again)}\n"
                f"To draw what is there: {_as_typed(drawing)}"
            )
            raise
        return _finish(journal, choices.out, write=choices.report, as_json=choices.as_json)


def draw(out: Path, *, as_json: bool) -> int:
    """Write the report of a journal that is there, and show it.

    Returns:
        0; 1 when the journal has failed runs or different answers.

    Raises:
        UsageError: There is no journal.
    """
    _see_that_it_is_no_file(out)
    if not (out / NAME).is_file():
        raise UsageError(f"{out} holds no results ({NAME}); --out DIR says where they are.")
    return _finish(_read(out), out, write=True, as_json=as_json)


def list_backends(*, as_json: bool) -> None:
    """Print each backend: name, kind, what it is, whether it can run here, else the cure."""
    from benchmarks.backends.registry import BACKENDS

    found = [(kind, _missing_reason(kind)) for kind in BACKENDS.values()]
    if as_json:
        print_json(
            [
                {"name": one.name, "kind": one.kind, "about": one.about, "missing": reason}
                for one, reason in found
            ]
        )
        return
    print_table(
        (("name", "whole"), ("kind", "whole"), ("runs here", "left"), ("about", "left")),
        [(one.name, one.kind, reason or "yes", one.about) for one, reason in found],
    )


# --- before the run -------------------------------------------------------------------


def _chosen_backends(asked: Sequence[str] | None) -> dict[str, type[Backend]]:
    from benchmarks.backends.registry import BACKENDS

    words = [word.strip() for part in asked or () for word in part.split(",")]
    names = {_completed(word, list(BACKENDS)) for word in words if word}
    if asked and not names:
        raise UsageError("--backends names none; --list-backends shows them.")
    return {name: kind for name, kind in BACKENDS.items() if not names or name in names}


def _completed(word: str, names: Sequence[str]) -> str:
    """The name that a word is, or is the beginning of.

    Raises:
        UsageError: There is none, or several.
    """
    if word in names:
        return word
    found = [name for name in names if name.startswith(word)]
    if len(found) == 1:
        return found[0]
    if found:
        raise UsageError(f"{word!r} may be {', '.join(found)}: write one of them.")
    close = get_close_matches(word, names, n=2)
    hint = f"did you mean {' or '.join(close)}?" if close else f"there are {', '.join(names)}."
    raise UsageError(f"There is no backend {word!r}; {hint}")


def _plan(name: str, choices: Choices) -> _Planned:
    """A part with its own settings, where the command line says otherwise changed."""
    part = PARTS[name]
    module = import_module(part.module)
    usual = module.Settings.usual(quick=choices.quick)
    asked: dict[str, Any] = {
        "sizes": _numbers(choices.sizes, "--sizes", _message_size),
        "rates": _numbers(choices.rates, "--rates", _rate),
        "messages": choices.messages,
        "topics": choices.topics,
        "seconds": choices.seconds,
        "logs": _existing(choices.logs),
        "made": None if choices.made else (),
        "log_seconds": choices.log_seconds,
        "repetitions": choices.repetitions,
    }
    changed = {option: asked[option] for option in part.options if asked[option] is not None}
    return _Planned(name, module, replace(usual, **changed))


def _numbers(text: str | None, option: str, parse: Any) -> list[Any] | None:
    if text is None:
        return None
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words:
        raise UsageError(f"{option} is empty.")
    numbers = sorted({parse(word) for word in words})
    if numbers[0] <= 0:
        raise UsageError(f"{option}: {numbers[0]} is not above 0.")
    return numbers


def _message_size(text: str) -> int:
    from benchmarks.loads.streams import MIN_SIZE

    size = parse_size(text)
    if 0 < size < MIN_SIZE:
        raise UsageError(f"{text}: a message of a stream has {MIN_SIZE} bytes at least.")
    if size > _LARGEST:
        raise UsageError(f"{text}: a message of a stream has {_LARGEST >> 20} MiB at most.")
    return size


def _rate(text: str) -> float:
    try:
        rate = float(text.removesuffix("Hz").strip())
    except ValueError:
        raise UsageError(f"{text!r} is no rate: write 4, 16 or 64.") from None
    if not 1e-3 <= rate < 1e6:
        raise UsageError(f"{text} Hz is no rate that a topic can have.")
    return rate


def _existing(logs: Sequence[Path]) -> tuple[Path, ...] | None:
    for log in logs:
        if not log.exists():
            raise UsageError(f"{log}: there is no such file.")
    return tuple(log.resolve() for log in logs) or None


def _see_that_it_is_no_file(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file; --out names a directory.")


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Nobody else writes into a directory of results while the block runs."""
    _see_that_it_is_no_file(out)
    is_new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(out, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise UsageError(f"{out} cannot be used: {error.strerror}.") from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UsageError(
                f"Another run is writing into {out}: wait for it, or name another --out."
            ) from None
        yield
    finally:
        os.close(descriptor)
        if is_new:
            with suppress(OSError):  # something was written
                out.rmdir()


def _opened(choices: Choices) -> Journal:
    path = choices.out / NAME
    if choices.restart and path.exists():
        number = 1
        while (aside := path.with_name(f"{path.stem}.{number}{path.suffix}")).exists():
            number += 1
        path.rename(aside)
        note(f"benchmarks: beginning anew; what was there is {aside}")
    return _read(choices.out)


def _read(out: Path) -> Journal:
    try:
        return Journal(out)
    except ValueError as error:
        raise UsageError(
            f"{out / NAME} is no journal of these studies ({error}). Without that line it may be "
            "one; --restart sets it aside, --out names another directory."
        ) from None
    except OSError as error:
        raise UsageError(f"{out / NAME} cannot be read: {error.strerror}.") from None


def _header(
    choices: Choices,
    planned: Sequence[_Planned],
    backends: Mapping[str, type[Backend]],
    command: Sequence[str],
    work: Path,
) -> dict[str, Any]:
    from benchmarks.machine import describe

    settings: dict[str, dict[str, Any]] = {
        part.module.STUDY: _plain(part.settings) for part in planned
    }
    if "persistence" in settings:
        settings["persistence"]["speed"] = choices.speed
    return {
        "benchmark": "studies",
        "parts": [part.name for part in planned],
        "quick": choices.quick,
        "seed": choices.seed,
        "settings": settings,
        "backends": {
            name: {"kind": kind.kind, "about": kind.about} for name, kind in backends.items()
        },
        "command": list(command),
        **describe(work),
    }


def _plain(settings: Any) -> dict[str, Any]:
    """Settings as a journal gives them back: its tuples are lists, its paths text."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(settings), default=str))
    return plain


def _see_that_it_fits(journal: Journal, header: Mapping[str, Any], out: Path) -> None:
    """One report must not be drawn from runs that are not the same measurement.

    Raises:
        UsageError: The journal has runs with other settings; the message names them.
    """
    if not journal.samples:
        return
    new = _sense(header)
    for old in map(_sense, journal.headers):
        for name in new:
            if name in old and old[name] != new[name]:
                raise UsageError(
                    f"The results in {out} were taken with {name} {_shown(old[name])}, now it is "
                    f"{_shown(new[name])}; they do not go into one report. Give the same options "
                    "again to go on, --out DIR for a second set, or --restart to begin anew."
                )


def _sense(header: Mapping[str, Any]) -> dict[str, Any]:
    """What makes a run the measurement that it is, by the name of its option."""
    found = {name: header[name] for name in ("quick", "seed") if name in header}
    for study, values in header.get("settings", {}).items():
        for name, value in values.items():
            if name not in _MAY_GROW:
                found[f"{study} {name}"] = value
    return found


def _shown(value: object) -> str:
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)


def _work(asked: Path | None, stack: ExitStack) -> Path:
    if asked is None:
        return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hybridlog-bench-")))
    try:
        asked.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{asked} cannot be used: {error.strerror}.") from None
    return asked.resolve()


def _context(
    journal: Journal, work: Path, backends: Mapping[str, type[Backend]], choices: Choices
) -> Context:
    from benchmarks.progress import Steps
    from benchmarks.studies.runs import Context

    missing = {name: reason for name, kind in backends.items() if (reason := _missing_reason(kind))}
    for name, reason in missing.items():
        note(f"benchmarks: {name} is left out: {reason}")
    return Context(
        work=work,
        backends=backends,
        journal=journal,
        steps=Steps(0.0, None, None),
        quick=choices.quick,
        seed=choices.seed,
        missing=missing,
    )


def _missing_reason(kind: type[Backend]) -> str:
    from benchmarks.backends.base import BackendMissingError

    try:
        kind.check()
    except BackendMissingError as error:
        return str(error)
    return ""


# --- the run --------------------------------------------------------------------------


def _run_parts(
    planned: Sequence[_Planned], choices: Choices, context: Context, header: Mapping[str, Any]
) -> None:
    from benchmarks.progress import short, steps

    journal = context.journal
    contexts = [
        replace(context, speed=choices.speed if part.name == "persistence" else 1.0)
        for part in planned
    ]
    seconds = [
        float(part.module.expected_seconds(_present(its), part.settings))
        for part, its in zip(planned, contexts, strict=True)
    ]
    before = _good(journal)
    if before:
        note(
            f"benchmarks: going on with {journal.path}: {counted(before, 'run')} "
            f"{'is' if before == 1 else 'are'} there and not done again"
        )
    if any(seconds):
        told = ", ".join(
            f"{part.name} {short(one)}" for part, one in zip(planned, seconds, strict=True) if one
        )
        note(f"benchmarks: about {short(sum(seconds))} to go ({told}); Ctrl-C keeps what is done")
    if any(
        part.module.expected_seconds(its, part.settings)
        for part, its in zip(planned, contexts, strict=True)
    ):
        journal.begin(header)
    with steps(sum(seconds)) as progress:
        for number, (part, its) in enumerate(zip(planned, contexts, strict=True), 1):
            its.steps = progress
            part.module.run(its, part.settings)
            progress.reach(sum(seconds[:number]))


def _present(context: Context) -> Context:
    """The same without the backends that are missing: those take no time."""
    kinds = {name: k for name, k in context.backends.items() if name not in context.missing}
    return replace(context, backends=kinds)


def _good(journal: Journal) -> int:
    return sum(sample.status == "ok" for sample in journal.samples.values())


# --- after the run --------------------------------------------------------------------


def _finish(journal: Journal, out: Path, *, write: bool, as_json: bool) -> int:
    from benchmarks.report.book import Book
    from benchmarks.report.build import report
    from benchmarks.report.terminal import show
    from benchmarks.report.write import write as write_report

    found = report(journal)
    files: tuple[Path, ...] = ()
    if write:
        files, hint = write_report(found, out)
        if hint:
            note(f"benchmarks: {hint}")
    if as_json:
        print_json(_as_json(found, journal, files))
    else:
        show(found, Book(journal))
        for path in files:
            note(f"benchmarks: wrote {path}")
    sys.stdout.flush()
    return 1 if found.failed or found.differing else 0


def _as_json(found: Report, journal: Journal, files: Sequence[Path]) -> dict[str, Any]:
    samples = journal.samples.values()
    return {
        "journal": str(journal.path),
        "report": [str(path) for path in files],
        "quick": found.quick,
        "warnings": list(found.warnings),
        "findings": list(found.findings),
        "differing": list(found.differing),
        "samples": {
            status: sum(sample.status == status for sample in samples)
            for status in ("ok", "missing", "failed")
        },
        "missing": {one.backend: one.reason for one in samples if one.status == "missing"},
        "failed": [
            {
                "study": one.study,
                "case": dict(one.case),
                "backend": one.backend,
                "repetition": one.repetition,
                "reason": one.reason,
            }
            for one in samples
            if one.status == "failed"
        ],
    }


def _as_typed(words: Sequence[str]) -> str:
    import shlex

    return shlex.join(words)
