"""The process in which one backend is filled, opened again, and asked.

Sides, run by `benchmarks.side.run_side`. Each result is written to a file as
soon as it is known, so that those of a side that is ended are kept.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from benchmarks import usage
from benchmarks.backends.base import Backend, BackendFailedError, BackendMissingError
from benchmarks.harness.logger import StoppedError, ended_by_signals
from benchmarks.loads.base import Load
from benchmarks.questions import tasks
from benchmarks.questions.base import QUESTIONS, SLOW_S, SLOW_TIMES
from benchmarks.side import Values

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

_Opener = Callable[[], AbstractContextManager[Backend]]
"""Opens the backend that was filled."""


def ask(
    *,
    load: str,
    backend: str,
    directory: str,
    row: str,
    asker: str,
    questions: Sequence[str],
    repetitions: int,
    results: str,
) -> Values:
    """Fill a backend and ask it.

    A result is a JSON line: `row`, `question`, and `cold_ms` (a list, the
    first time after the backend was opened again), `ms` (a list, the times after the first
    of those) and `answer`; or `error`. A later line takes the place of an earlier one of the
    same question. What was slow is asked `SLOW_TIMES` in all, each time for the first time.

    Args:
        load: The load's directory.
        backend: `module:class`.
        directory: For the backend's data.
        row: Name of the backend.
        asker: The class that asks, `module:class`.
        questions: Keys of `QUESTIONS`.
        repetitions: How often each is asked after the first time, and how often the
            backend is opened, to ask for the first time.
        results: File for the results.

    Returns:
        `status`, `reason`, and of the filling: `load_s`, `disk_bytes`, `spin_ms`.
    """

    def use(reopened: _Opener, channels: Sequence[Channel], out: TextIO) -> None:
        known: dict[str, dict[str, Any]] = {}
        for opening in range(repetitions):
            with reopened() as system, closing(_named(asker)(system, channels)) as asking:
                for name in questions:
                    question = partial(QUESTIONS[name], asking)
                    if not opening:
                        found = _timed(question, repetitions)
                        known[name] = {"row": row, "question": name}
                    elif "error" in known[name] or _has_enough(known[name]):
                        continue
                    else:
                        found = _first_again(question, known[name])
                    known[name] |= found
                    _tell(out, known[name])

    return _filled(load, backend, directory, results, use)


def read(
    *,
    load: str,
    backend: str,
    directory: str,
    row: str,
    asker: str,
    repetitions: int,
    results: str,
) -> Values:
    """Fill a backend and read from it; see `ask`. Results have `task` and `repetition`.

    The times of a repetition are of other places than those of the one before.
    """
    opened = Load.open(Path(load))

    def use(reopened: _Opener, channels: Sequence[Channel], out: TextIO) -> None:
        with reopened() as system, closing(_named(asker)(system, channels)) as reading:
            for name, task in tasks.TASKS.items():
                for repetition in range(repetitions):
                    found = _caught(partial(task, reading, opened, repetition))
                    _tell(out, {"row": row, "task": name, "repetition": repetition, **found})
                    if not repetition:
                        is_slow = found.get("total_ms", 0.0) > SLOW_S * 1e3
                    if "error" in found or (is_slow and repetition + 1 >= SLOW_TIMES):
                        break

    return _filled(load, backend, directory, results, use)


def _filled(
    load: str,
    backend: str,
    directory: str,
    results: str,
    use: Callable[[_Opener, Sequence[Channel], TextIO], None],
) -> Values:
    for package in ("pandas", "pyarrow"):
        import_module(package)  # whoever needs it first must not pay for all
    opened = Load.open(Path(load))
    kind = _named(backend)
    values: Values = {"status": "ok", "reason": "", "spin_ms": usage.spin_ms()}
    with ended_by_signals(), Path(results).open("w", encoding="utf-8") as out:
        try:
            kind.check()
            with _open(kind, directory, opened) as system:
                started = time.perf_counter()
                fill(system, opened)
                values["load_s"] = time.perf_counter() - started
            values["disk_bytes"] = usage.disk_bytes(Path(directory))
            use(partial(_open, kind, directory, opened), opened.channels, out)
        except BackendMissingError as error:
            values |= {"status": "missing", "reason": str(error)}
        except (BackendFailedError, StoppedError) as error:
            values |= {"status": "failed", "reason": str(error)}
    return values


@contextmanager
def _open(kind: type[Backend], directory: str, load: Load) -> Iterator[Backend]:
    system = kind(Path(directory))
    try:
        system.open(load.channels)
        yield system
    finally:
        system.close()


def fill(system: Backend, load: Load) -> None:
    """Insert a whole load as fast as the backend takes it, and see it safe on the disk."""
    payloads = load.map()
    rows = zip(
        load.channel.tolist(),
        load.log_time.tolist(),
        load.offset.tolist(),
        load.length.tolist(),
        strict=True,
    )
    for channel, log_time, offset, length in rows:
        system.insert(channel, log_time, bytes(payloads[offset : offset + length]))
    system.finish()


def _timed(question: Callable[[], Any], repetitions: int) -> dict[str, Any]:
    """Ask once, and again if that was not slow."""
    first = _asked(question)
    if "error" in first:
        return first
    found: dict[str, Any] = {"cold_ms": [first["ms"]], "ms": [], "answer": first["answer"]}
    while len(found["ms"]) < repetitions and first["ms"] <= SLOW_S * 1e3:
        again = _asked(question, first["answer"])
        if "error" in again:
            return again
        found["ms"].append(again["ms"])
    return found


def _has_enough(known: dict[str, Any]) -> bool:
    """Whether a question was slow, and asked as often as such a one is."""
    return not known["ms"] and len(known["cold_ms"]) >= SLOW_TIMES


def _first_again(question: Callable[[], Any], known: dict[str, Any]) -> dict[str, Any]:
    """Ask for the first time since the backend was opened, once more."""
    first = _asked(question, known["answer"])
    return first if "error" in first else {"cold_ms": [*known["cold_ms"], first["ms"]]}


def _asked(question: Callable[[], Any], expected: Any = None) -> dict[str, Any]:
    """`ms` and `answer`, or `error`: one, too, when another answer was expected."""

    def ask() -> dict[str, Any]:
        started = time.perf_counter()
        answer = question()
        return {"ms": (time.perf_counter() - started) * 1e3, "answer": answer}

    found = _caught(ask)
    if expected is not None and found.get("answer", expected) != expected:
        return {"error": f"it answered {expected}, then {found['answer']}"}
    return found


def _caught(function: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a function gives, or the driver's error, whatever its class."""
    try:
        return function()
    except StoppedError:
        raise
    except Exception as error:
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"}


def _tell(out: TextIO, result: dict[str, Any]) -> None:
    out.write(json.dumps(result) + "\n")
    out.flush()


def _named(name: str) -> Any:
    module, _, kind = name.partition(":")
    return getattr(import_module(module), kind)
