"""What systems answer: the paper's questions about teleoperation, and reading messages back.

Every backend is filled with the same load as fast as it takes it, closed, opened again, and
asked in its own language, in a process of its own. All answers are known: of the questions from
the plan of the load, of what is read from the load's own payloads, which no backend has touched.
One that is wrong makes the sample a failure.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from operator import methodcaller
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Final
from zlib import crc32

import numpy as np

from benchmarks import usage
from benchmarks.backends.base import (
    IMU_COLUMNS,
    Backend,
    BackendFailedError,
    BackendMissingError,
)
from benchmarks.backends.conversion import typestore_of
from benchmarks.harness.logger import StoppedError, ended_by_signals
from benchmarks.harness.run import given_to
from benchmarks.loads.base import Load
from benchmarks.loads.hcr_like import hcr_like, true_answers
from benchmarks.samples import Sample, Scale
from benchmarks.side import SideError, Values, named, run_side, warm_cache
from benchmarks.studies.record import robot_log
from benchmarks.studies.runs import Context, run_directory

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

_TIMEOUT_S = 900.0
_SECOND_NS = 10**9
QUESTIONS: Final[dict[str, Callable[[Backend], Any]]] = {
    "Q1": methodcaller("closings"),
    "Q2": methodcaller("behind"),
    "Q3": methodcaller("in_region"),
    "Q4": methodcaller("grasps"),
    "Q2 positions": methodcaller("positions"),
}
"""By name; the first four are those of the paper's Table 1."""
QUERIES: dict[Scale, tuple[int, float, int]] = {"full": (4, 10.0, 5), "tiny": (1, 1.0, 1)}
"""Sessions, minutes of each (at least 1), and how often a question is asked: for the first time
since the backend was opened, and again after one of those."""
READING: dict[Scale, tuple[int, int]] = {"full": (30, 3), "tiny": (2, 1)}
"""Seconds of the load, and repetitions of each task, at other places each."""

_Opener = Callable[[], AbstractContextManager[Backend]]
"""Opens the backend that was filled."""


def queries(context: Context) -> None:
    """Ask all of all."""
    sessions, minutes, repetitions = QUERIES[context.scale]
    about, seed = {"sessions": sessions, "minutes": minutes}, context.seed
    load = context.load(
        "questions",
        {**about, "seed": seed},
        lambda place: hcr_like(place, seed=seed, sessions=sessions, minutes=minutes),
    )
    truth = true_answers(load)
    asked = [name for name, kind in context.backends.items() if kind.answers]
    for name, values, results in _turns(context, "ask", asked, load, repetitions):
        for question in QUESTIONS:
            for repetition in range(repetitions):
                wanted = Sample("queries", {"question": question, **about}, name, repetition)
                result = results.get(question, [None] * repetitions)[repetition]
                context.journal.add(_judged(wanted, values, result, truth[question]))


def reading(context: Context) -> None:
    """Read all from all."""
    seconds, repetitions = READING[context.scale]
    load = robot_log(context, seconds)
    truth = _true_readings(load, repetitions)
    asked = [name for name, kind in context.backends.items() if kind.reads]
    for name, values, results in _turns(context, "read", asked, load, repetitions):
        for task in TASKS:
            for repetition in range(repetitions):
                wanted = Sample("reading", {"task": task, "seconds": seconds}, name, repetition)
                result = results.get(task, [None] * repetitions)[repetition]
                context.journal.add(_judged(wanted, values, result, truth[task, repetition]))


# --- a turn ---------------------------------------------------------------------------


def _turns(
    context: Context, side: str, names: Sequence[str], load: Load, repetitions: int
) -> Iterator[tuple[str, Values, dict[str, list[Any]]]]:
    """Each backend's turn: its name, how it ended, and its results by question or task."""
    for name in names:
        values: Values = {"status": "missing", "reason": context.missing.get(name, "")}
        if name not in context.missing:
            with context.step(f"{side}: {name}"):
                values = _turn(context, side, context.backends[name], load, repetitions)
        if values["status"] == "missing":
            context.missing[name] = values["reason"]
        yield name, values, values.pop("results", {})


def _turn(context: Context, side: str, kind: type[Backend], load: Load, repetitions: int) -> Values:
    warm_cache(load.payloads)
    with run_directory(context.work) as directory:
        given = {**given_to(kind, load, directory), "repetitions": repetitions}
        try:
            return run_side(f"{__name__}:{side}", given, directory, _TIMEOUT_S)
        except SideError as error:
            return {"status": "failed", "reason": str(error)}


def _judged(
    wanted: Sample, values: Mapping[str, Any], result: Mapping[str, Any] | None, truth: object
) -> Sample:
    """A sample of an answer: failed when it is wrong or there is none."""
    measured = {name: v for name, v in values.items() if name not in {"status", "reason"}}
    if result is None:
        status = "failed" if values["status"] == "ok" else values["status"]
        reason = values["reason"] or "it gave no answer"
        return replace(wanted, status=status, values=measured, reason=reason)
    wrong = [answer for answer in result.get("answers", ()) if answer != truth]
    reason = f"it answered {wrong[0]}, and {truth} is right" if wrong else result.get("error", "")
    status = "failed" if reason else "ok"
    return replace(wanted, status=status, values={**measured, **result}, reason=reason)


# --- the process in which a backend is filled, opened again, and asked ------------------


def ask(*, load: str, backend: str, directory: str, repetitions: int) -> Values:
    """Fill a backend and ask it."""
    cold: dict[str, list[dict[str, Any]]] = {name: [] for name in QUESTIONS}
    warm: dict[str, list[dict[str, Any]]] = {name: [] for name in QUESTIONS}

    def use(reopened: _Opener, _load: Load) -> dict[str, Any]:
        for opening in range(repetitions):
            with reopened() as system:
                for name, question in QUESTIONS.items():
                    cold[name].append(_timed(partial(question, system)))
                    for _ in range(0 if opening else repetitions):
                        warm[name].append(_timed(partial(question, system)))
        pairs = {name: zip(cold[name], warm[name], strict=True) for name in QUESTIONS}
        return {name: [_joined_times(*pair) for pair in both] for name, both in pairs.items()}

    return _filled(load, backend, directory, use)


def _joined_times(first: dict[str, Any], again: dict[str, Any]) -> dict[str, Any]:
    for one in (first, again):
        if "error" in one:
            return one
    answers = [first["answer"], again["answer"]]
    return {"cold_ms": first["ms"], "ms": again["ms"], "answers": answers}


def read(*, load: str, backend: str, directory: str, repetitions: int) -> Values:
    """Fill a backend and read from it; see `ask`."""

    def use(reopened: _Opener, opened: Load) -> dict[str, Any]:
        with reopened() as system:
            return {
                name: [_caught(partial(task, system, opened, n)) for n in range(repetitions)]
                for name, task in TASKS.items()
            }

    return _filled(load, backend, directory, use)


def _filled(
    load: str, backend: str, directory: str, use: Callable[[_Opener, Load], dict[str, Any]]
) -> Values:
    for package in ("pandas", "pyarrow"):
        import_module(package)  # whoever needs it first must not pay for all
    opened, kind = Load.open(Path(load)), named(backend)
    values: Values = {"status": "ok", "reason": "", "spin_ms": usage.spin_ms()}
    with ended_by_signals():
        try:
            kind.check()
            with _open(kind, directory, opened) as system:
                started = time.perf_counter()
                _fill(system, opened)
                values["load_s"] = time.perf_counter() - started
            values["disk_bytes"] = usage.disk_bytes(Path(directory))
            values["results"] = use(partial(_open, kind, directory, opened), opened)
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


def _fill(system: Backend, load: Load) -> None:
    """Insert a whole load as fast as the backend takes it, and see it safe on the disk."""
    payloads = load.map()
    columns = (load.channel, load.log_time, load.offset, load.length)
    for channel, log_time, offset, length in zip(*(c.tolist() for c in columns), strict=True):
        system.insert(channel, log_time, bytes(payloads[offset : offset + length]))
    system.finish()


def _timed(question: Callable[[], Any]) -> dict[str, Any]:
    started = time.perf_counter()
    found = _caught(lambda: {"answer": question()})
    return found | {"ms": (time.perf_counter() - started) * 1e3}


def _caught(function: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a function gives, or the driver's error, whatever its class."""
    try:
        return function()
    except StoppedError:
        raise
    except Exception as error:
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"}


# --- what is read back ----------------------------------------------------------------

SCAN: Final = "/scan"
IMU: Final = "/imu/data"
_SLICES, _MOMENTS = 20, 100
"""Slices, and messages that are looked up, in one repetition."""


def _slices(system: Backend, load: Load, repetition: int) -> dict[str, Any]:
    """One second of the laser, decoded, 20 times."""
    spans = _slice_spans(load, repetition)
    return _measured([partial(system.slice, SCAN, *span) for span in spans], _checksum)


def _moments(system: Backend, load: Load, repetition: int) -> dict[str, Any]:
    """The scan that was current at a time, 100 times."""
    times = _moment_times(load, repetition)
    return _measured([partial(system.last, SCAN, time) for time in times], _checksum)


def _table(system: Backend, _load: Load, _repetition: int) -> dict[str, Any]:
    """All of the IMU as a frame."""

    def summary(frame: pd.DataFrame) -> tuple[int, int]:
        columns = frame[list(IMU_COLUMNS)].to_numpy(np.float64)
        return len(frame), crc32(np.ascontiguousarray(columns).tobytes())

    return _measured([partial(system.table, IMU)], summary)


TASKS: Final[dict[str, Callable[[Backend, Load, int], dict[str, Any]]]] = {
    "1 s of scans": _slices,
    "scan at a time": _moments,
    "IMU to pandas": _table,
}
"""By name."""


def _measured(
    jobs: Sequence[Callable[[], Any]], summary: Callable[[Any], tuple[int, int]]
) -> dict[str, Any]:
    """Do jobs one after the other; what they give is summed up outside of the time."""
    times: list[float] = []
    answers: list[tuple[int, int]] = []
    for job in jobs:
        started = time.perf_counter()
        found = job()
        times.append((time.perf_counter() - started) * 1e3)
        answers.append(summary(found))
    return {"ms": median(times), "answers": [_joined(answers)]}


def _true_readings(load: Load, repetitions: int) -> dict[tuple[str, int], list[int]]:
    """What each task must answer, by name and repetition."""
    times, scans = _decoded(load, SCAN, lambda message: message.ranges)
    _, rows = _decoded(load, IMU, _imu_row)
    found: dict[tuple[str, int], list[int]] = {}
    for repetition in range(repetitions):
        pieces = [
            np.array(scans[slice(*np.searchsorted(times, span))], np.float32)
            for span in _slice_spans(load, repetition)
        ]
        places = np.searchsorted(times, _moment_times(load, repetition), "right") - 1
        found["1 s of scans", repetition] = _joined([*map(_checksum, pieces)])
        found["scan at a time", repetition] = _joined([_checksum(scans[n]) for n in places])
        whole = len(rows), crc32(np.array(rows, np.float64).tobytes())
        found["IMU to pandas", repetition] = _joined([whole])
    return found


def _slice_spans(load: Load, repetition: int) -> list[tuple[int, int]]:
    """Seconds of log time, `[begin, end)`, ns; shorter when the load is."""
    edges = _edges(load)
    rng = np.random.default_rng([load.seed, repetition, 1])
    last = max(int(np.searchsorted(edges, edges[-1] - _SECOND_NS, "right")), 1)
    begins = rng.integers(0, last, _SLICES)
    ends = np.minimum(np.searchsorted(edges, edges[begins] + _SECOND_NS), len(edges) - 1)
    return [(int(edges[b]), int(edges[e])) for b, e in zip(begins, ends, strict=True)]


def _moment_times(load: Load, repetition: int) -> list[int]:
    """Times at which a scan is current, ns."""
    rng = np.random.default_rng([load.seed, repetition, 2])
    chosen: list[int] = rng.choice(_edges(load)[1:], _MOMENTS).tolist()
    return chosen


def _edges(load: Load) -> NDArray[np.int64]:
    """Times half way between two scans: a system that keeps milliseconds finds the same."""
    times = np.sort(load.log_time[_rows(load, SCAN)])
    middles: NDArray[np.int64] = times[:-1] + np.diff(times) // 2
    return middles


def _checksum(ranges: NDArray[np.float32]) -> tuple[int, int]:
    """How many numbers, and a checksum; what is not finite counts as 0, as JSON lacks it."""
    plain = np.where(np.isfinite(ranges), ranges, np.float32(0)).astype("<f4")
    return plain.size, crc32(plain.tobytes())


def _joined(answers: Sequence[tuple[int, int]]) -> list[int]:
    """Several answers as one: how many, a checksum of checksums, numbers in all."""
    checks = np.array([check for _, check in answers], "<u4")
    return [len(answers), crc32(checks.tobytes()), sum(count for count, _ in answers)]


def _rows(load: Load, topic: str) -> NDArray[np.intp]:
    wanted = [n for n, channel in enumerate(load.channels) if channel.topic == topic]
    return np.flatnonzero(np.isin(load.channel, wanted))


def _decoded(
    load: Load, topic: str, value: Callable[[Any], Any]
) -> tuple[NDArray[np.int64], list[Any]]:
    """Log times, in order, and what is wanted of each message."""
    rows = _rows(load, topic)
    rows = rows[np.argsort(load.log_time[rows], kind="stable")]
    schema = load.channels[int(load.channel[rows[0]])].schema
    assert schema is not None
    types, name = typestore_of(schema)
    payloads = load.map()
    found = []
    for row in rows.tolist():
        start = int(load.offset[row])
        raw = bytes(payloads[start : start + int(load.length[row])])
        found.append(value(types.deserialize_ros1(raw, name)))
    return load.log_time[rows], found


def _imu_row(message: Any) -> list[float]:
    parts = (message.angular_velocity, message.linear_acceleration)
    return [getattr(part, axis) for part in parts for axis in "xyz"]
