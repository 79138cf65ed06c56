"""The process in which one backend is filled, opened again, and asked.

Sides, run by `benchmarks.side.run_side`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks import usage
from benchmarks.backends.base import Backend, BackendFailedError, BackendMissingError
from benchmarks.harness.logger import StoppedError, ended_by_signals
from benchmarks.loads.base import Load
from benchmarks.questions import tasks
from benchmarks.questions.base import QUESTIONS
from benchmarks.side import Values, named

_Opener = Callable[[], AbstractContextManager[Backend]]
"""Opens the backend that was filled."""


def ask(*, load: str, backend: str, directory: str, asker: str, repetitions: int) -> Values:
    """Fill a backend and ask it.

    Args:
        load: The load's directory.
        backend: `module:class`.
        directory: For the backend's data.
        asker: The class that asks, `module:class`.
        repetitions: How often each question is asked after the first time, and how often the
            backend is opened, to ask for the first time.

    Returns:
        `status`, `reason`, `results`, and of the filling: `load_s`, `disk_bytes`, `spin_ms`.
        A result of a question is `cold_ms` (a list, the first time after the backend was
        opened), `ms` (a list, the times after the first of those) and `answer`; or `error`.
    """
    results: dict[str, dict[str, Any]] = {}

    def use(reopened: _Opener) -> None:
        for opening in range(repetitions):
            with reopened() as system, closing(named(asker)(system)) as asking:
                for name, question in QUESTIONS.items():
                    known = results.setdefault(name, {"cold_ms": [], "ms": []})
                    _ask(partial(question, asking), known, "cold_ms")
                    for _ in range(0 if opening else repetitions):
                        _ask(partial(question, asking), known, "ms")

    return _filled(load, backend, directory, use) | {"results": results}


def _ask(question: Callable[[], Any], known: dict[str, Any], measure: str) -> None:
    """Ask once more, unless it was in vain before."""
    if "error" in known:
        return
    started = time.perf_counter()
    found = _caught(lambda: {"answer": question()})
    known[measure].append((time.perf_counter() - started) * 1e3)
    expected = known.get("answer")
    known |= found
    if expected is not None and known["answer"] != expected:
        known["error"] = f"it answered {expected}, then {known['answer']}"


def read(*, load: str, backend: str, directory: str, asker: str, repetitions: int) -> Values:
    """Fill a backend and read from it; see `ask`. A task has a list of results.

    The times of a repetition are of other places than those of the one before.
    """
    opened = Load.open(Path(load))
    results: dict[str, list[dict[str, Any]]] = {}

    def use(reopened: _Opener) -> None:
        with reopened() as system, closing(named(asker)(system)) as reading:
            for name, task in tasks.TASKS.items():
                results[name] = [
                    _caught(partial(task, reading, opened, repetition))
                    for repetition in range(repetitions)
                ]

    return _filled(load, backend, directory, use) | {"results": results}


def _filled(load: str, backend: str, directory: str, use: Callable[[_Opener], None]) -> Values:
    for package in ("pandas", "pyarrow"):
        import_module(package)  # whoever needs it first must not pay for all
    opened = Load.open(Path(load))
    kind = named(backend)
    values: Values = {"status": "ok", "reason": "", "spin_ms": usage.spin_ms()}
    with ended_by_signals():
        try:
            kind.check()
            with _open(kind, directory, opened) as system:
                started = time.perf_counter()
                fill(system, opened)
                values["load_s"] = time.perf_counter() - started
            values["disk_bytes"] = usage.disk_bytes(Path(directory))
            use(partial(_open, kind, directory, opened))
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


def _caught(function: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a function gives, or the driver's error, whatever its class."""
    try:
        return function()
    except StoppedError:
        raise
    except Exception as error:
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"}
