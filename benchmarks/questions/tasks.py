"""What is read back in the study of reading, and what must come out.

The right answers are decoded from the load's own payloads, which no backend has touched.
Times are chosen half way between two messages, so that a backend that keeps milliseconds
finds the same messages as one that keeps nanoseconds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any, Final, TypeVar
from zlib import crc32

import numpy as np

from benchmarks.backends.conversion import typestore_of
from benchmarks.questions.base import SECOND_NS, Reading

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from benchmarks.loads.base import Load

_T = TypeVar("_T")

SCAN: Final = "/scan"
IMU: Final = "/imu/data"
SLICES: Final = 20
"""In one repetition."""
MOMENTS: Final = 100
"""Messages that are looked up in one repetition."""


def slices(reading: Reading, load: Load, repetition: int) -> dict[str, Any]:
    """One second of the laser, decoded, 20 times."""
    spans = slice_spans(load, repetition)
    return _measured([partial(reading.slice, SCAN, *span) for span in spans], checksum)


def moments(reading: Reading, load: Load, repetition: int) -> dict[str, Any]:
    """The scan that was current at a time, 100 times."""
    times = moment_times(load, repetition)
    return _measured([partial(reading.last, SCAN, time) for time in times], checksum)


def table(reading: Reading, load: Load, repetition: int) -> dict[str, Any]:
    """All of the IMU as a frame."""
    return _measured([partial(reading.table, IMU)], table_checksum)


TASKS: Final[dict[str, Callable[[Reading, Load, int], dict[str, Any]]]] = {
    "1 s of scans": slices,
    "scan at a time": moments,
    "IMU to pandas": table,
}
"""By name."""


def true_answers(load: Load, repetitions: int) -> dict[tuple[str, int], list[int]]:
    """What each task must answer, by name and repetition."""
    times, scans = _decoded(load, SCAN, lambda message: message.ranges)
    _, rows = _decoded(load, IMU, _imu_row)
    whole = [1, crc32(np.array(rows, np.float64).tobytes()), len(rows)]
    found: dict[tuple[str, int], list[int]] = {}
    for repetition in range(repetitions):
        pieces = [
            np.array(scans[slice(*np.searchsorted(times, span))], np.float32)
            for span in slice_spans(load, repetition)
        ]
        at = [
            scans[int(np.searchsorted(times, time, "right")) - 1]
            for time in moment_times(load, repetition)
        ]
        found["1 s of scans", repetition] = _joined([checksum(piece) for piece in pieces])
        found["scan at a time", repetition] = _joined([checksum(scan) for scan in at])
        found["IMU to pandas", repetition] = whole
    return found


def slice_spans(load: Load, repetition: int) -> list[tuple[int, int]]:
    """Seconds of log time, `[begin, end)`, ns; shorter when the load is."""
    edges = _edges(load)
    rng = np.random.default_rng([load.seed, repetition, 1])
    last = max(int(np.searchsorted(edges, edges[-1] - SECOND_NS, "right")), 1)
    begins = rng.integers(0, last, SLICES)
    ends = np.minimum(np.searchsorted(edges, edges[begins] + SECOND_NS), len(edges) - 1)
    return [(int(edges[b]), int(edges[e])) for b, e in zip(begins, ends, strict=True)]


def moment_times(load: Load, repetition: int) -> list[int]:
    """Times at which a scan is current, ns."""
    rng = np.random.default_rng([load.seed, repetition, 2])
    chosen: list[int] = rng.choice(_edges(load)[1:], MOMENTS).tolist()
    return chosen


def checksum(ranges: NDArray[np.float32]) -> tuple[int, int]:
    """How many numbers, and a checksum; what is not finite counts as 0, as JSON lacks it."""
    plain = np.where(np.isfinite(ranges), ranges, np.float32(0)).astype("<f4")
    return plain.size, crc32(plain.tobytes())


def table_checksum(frame: pd.DataFrame) -> tuple[int, int]:
    """How many rows, and a checksum of what is compared."""
    columns = frame[list(Reading.columns)].to_numpy(np.float64)
    return len(frame), crc32(np.ascontiguousarray(columns).tobytes())


def _measured(
    jobs: Sequence[Callable[[], _T]], summary: Callable[[_T], tuple[int, int]]
) -> dict[str, Any]:
    """Do jobs one after the other; what they give is summed up outside of the time."""
    times: list[float] = []
    answers: list[tuple[int, int]] = []
    for job in jobs:
        started = time.perf_counter()
        found = job()
        times.append((time.perf_counter() - started) * 1e3)
        answers.append(summary(found))
    return {"ms": median(times), "answer": _joined(answers)}


def _joined(answers: Sequence[tuple[int, int]]) -> list[int]:
    """Several answers as one: how many, a checksum of checksums, numbers in all."""
    if len(answers) == 1:
        return [1, answers[0][1], answers[0][0]]
    checks = np.array([check for _, check in answers], "<u4")
    return [len(answers), crc32(checks.tobytes()), sum(count for count, _ in answers)]


def _edges(load: Load) -> NDArray[np.int64]:
    """Times half way between two scans."""
    rows = _rows(load, SCAN)
    times = np.sort(load.log_time[rows])
    middles: NDArray[np.int64] = times[:-1] + np.diff(times) // 2
    return middles


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
