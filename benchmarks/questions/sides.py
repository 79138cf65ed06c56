"""The process in which one backend is filled, opened again, and asked.

Sides, run by `benchmarks.harness.child.run_child`. Each result is written to a file as
soon as it is known, so that those of a side that is ended are kept.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from benchmarks.backends.base import Backend, BackendFailedError, BackendMissingError
from benchmarks.harness import usage
from benchmarks.harness.logger import StoppedError, ended_by_signals
from benchmarks.loads.base import Load
from benchmarks.questions import tasks
from benchmarks.questions.base import QUESTIONS, SLOW_S, Asker, Reading
from benchmarks.side import Values

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel


def ask(
    *,
    load: str,
    backend: str,
    directory: str,
    rows: dict[str, str],
    questions: Sequence[str],
    repetitions: int,
    results: str,
) -> Values:
    """Fill a backend and ask it.

    A result is a JSON line: `row`, `question`, `index_bytes`, and `cold_ms` (the first
    time, after the backend was opened again), `ms` (a list, the times after that) and
    `answer`; or `error`.

    Args:
        load: The load's directory.
        backend: `module:class`.
        directory: For the backend's data.
        rows: Names, and the class that asks each, `module:class`.
        questions: Keys of `QUESTIONS`.
        repetitions: How often each is asked after the first time.
        results: File for the results.

    Returns:
        `status`, `reason`, and of the filling: `load_s`, `disk_bytes`, `spin_ms`.
    """

    def use(system: Backend, channels: Sequence[Channel], out: TextIO) -> None:
        for row, kind in rows.items():
            asker: Asker = _named(kind)(system, channels)
            try:
                size = asker.index_bytes()
                for question in questions:
                    found = _timed(partial(QUESTIONS[question], asker), repetitions)
                    _tell(out, {"row": row, "question": question, "index_bytes": size, **found})
            finally:
                asker.close()

    return _filled(load, backend, directory, results, use)


def read(
    *,
    load: str,
    backend: str,
    directory: str,
    rows: dict[str, str],
    repetitions: int,
    results: str,
) -> Values:
    """Fill a backend and read from it; see `ask`. Results have `task` and `repetition`.

    The times of a repetition are of other places than those of the one before.
    """
    opened = Load.open(Path(load))

    def use(system: Backend, channels: Sequence[Channel], out: TextIO) -> None:
        for row, kind in rows.items():
            reading: Reading = _named(kind)(system, channels)
            try:
                for name, task in tasks.TASKS.items():
                    for repetition in range(repetitions):
                        found = _caught(partial(task, reading, opened, repetition))
                        _tell(out, {"row": row, "task": name, "repetition": repetition, **found})
                        is_slow = found.get("total_ms", 0.0) > SLOW_S * 1e3
                        if "error" in found or (is_slow and repetition == 0):
                            break
            finally:
                reading.close()

    return _filled(load, backend, directory, results, use)


def _filled(
    load: str,
    backend: str,
    directory: str,
    results: str,
    use: Callable[[Backend, Sequence[Channel], TextIO], None],
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
            with _open(kind, directory, opened) as system:
                use(system, opened.channels, out)
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

    def asked() -> dict[str, Any]:
        started = time.perf_counter()
        answer = question()
        return {"ms": (time.perf_counter() - started) * 1e3, "answer": answer}

    first = _caught(asked)
    if "error" in first:
        return first
    found: dict[str, Any] = {"cold_ms": first["ms"], "ms": [], "answer": first["answer"]}
    while len(found["ms"]) < repetitions and first["ms"] <= SLOW_S * 1e3:
        again = _caught(asked)
        if "error" in again:
            return again
        if again["answer"] != first["answer"]:
            return {"error": f"it answered {first['answer']}, then {again['answer']}"}
        found["ms"].append(again["ms"])
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
