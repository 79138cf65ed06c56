"""The logs that are published: four that are made, and real ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.loads.base import Load
from benchmarks.loads.logs import from_log, log_name
from hybridlog.cli.output import note
from hybridlog.formats.detect import open_source
from hybridlog_storage.errors import SourceError, UsageError

if TYPE_CHECKING:
    from benchmarks.studies.runs import Context

MADE = ("mit1", "mit2", "hcr1", "hcr2")
"""Those that stand for the logs of the paper's Figure 5."""
REAL_LOGS = Path(__file__).parents[2].parent / "shared" / "data" / "real"
"""Where real logs may lie beside a checkout."""
CHOSEN = (
    "tilt_laser.bag",
    "leg_tracker_negative_2.bag",
    "robot_localization_test3.bag",
    "luminar_pointcloud.bag",
    "ouster.mcap",
    "auv_ros2.mcap",
)
"""Those of them that are published unless others are asked for: lasers, many small
messages, large point clouds, many topics."""

_VERSION = 2
"""Goes up when a generator makes other messages from the same seed."""
_LEAST_HCR_S = 60.0
_LEAST_S = 0.1


@dataclass(frozen=True, slots=True)
class Replay:
    """A log to be published.

    Attributes:
        name: For tables; no two of a run have the same.
        case: What a sample says of it: its name, the seconds that are published at most,
            and the bytes of a real one, which tell two of one name apart.
        settings: All that the load depends on.
        seconds: About how long it takes at its own speed.
        make: Makes the load in an empty directory.
    """

    name: str
    case: dict[str, Any]
    settings: dict[str, Any]
    seconds: float
    make: Callable[[Path], Load]

    def load(self, context: Context) -> Load:
        """Its load, made once."""
        return context.load(self.name, self.settings, self.make)


def replays(
    seed: int, seconds: float, logs: Sequence[Path], made: Iterable[str] = MADE
) -> list[Replay]:
    """The logs of a study, in their order: those that are made, then the real ones.

    Args:
        seed: Of those that are made.
        seconds: Most of each that is published.
        logs: Files and directories; a directory stands for the log that it is, or for
            all logs that lie in it. One that is named twice is published once.
        made: Names of those that are made.
    """
    if not seconds > 0:
        raise ValueError(f"{seconds:g} s of a log are nothing; give more than 0 s")
    found = [_made(name, seed, seconds) for name in made]
    names = {replay.name for replay in found}
    # By what they are and not by how they are spelled, in the order of their first mention.
    for log in {log.resolve(): log for path in logs for log in logs_at(path)}.values():
        replay = _real(log, seconds, names)
        names.add(replay.name)
        found.append(replay)
    if not found:
        raise UsageError("No log is left to be published; name one with --logs.")
    return found


@dataclass(frozen=True, slots=True)
class LogSettings:
    """Which logs a study publishes, and to whom.

    Attributes:
        log_seconds: Most of each log that is published, in its own time.
        made: Names of the logs that are made.
        logs: Real logs, files and directories.
        chosen: Where `logs` is empty, some of those that lie beside the checkout, if there
            are any.
        backends: Names of those that take part; None for all.
    """

    log_seconds: float
    made: Sequence[str] = MADE
    logs: Sequence[Path] = ()
    chosen: bool = True
    backends: Sequence[str] | None = None

    def replays(self, seed: int) -> list[Replay]:
        """The logs."""
        logs = self.logs or (chosen_logs() if self.chosen else ())
        return replays(seed, self.log_seconds, logs, self.made)


def chosen_logs() -> list[Path]:
    """The real logs that lie beside the checkout and are published unless told otherwise."""
    return [path for path in (REAL_LOGS / name for name in CHOSEN) if path.exists()]


def logs_at(path: Path) -> list[Path]:
    """The log at a path, or all logs in a directory that is none itself."""
    try:
        open_source(path).close()
    except SourceError:
        inside = sorted(path.iterdir()) if path.is_dir() else []
        found = [child for child in inside if _is_log(child)]
        if not found:
            raise
        return found
    return [path]


def _is_log(path: Path) -> bool:
    try:
        open_source(path).close()
    except SourceError:
        return False
    return True


def _made(name: str, seed: int, seconds: float) -> Replay:
    if name not in MADE:
        raise ValueError(f"there is no log {name!r} to be made; there are {', '.join(MADE)}")
    # The second of a pair is another drive or user, and busier.
    is_second = name.endswith("2")
    settings = {"version": _VERSION, "seed": seed + is_second, "seconds": seconds}
    make = partial(
        _make_mit if name.startswith("mit") else _make_hcr,
        name=name,
        seed=seed + is_second,
        seconds=seconds,
        is_busy=is_second,
    )
    return Replay(name, _case(name, seconds), settings, seconds, make)


def _make_mit(directory: Path, *, name: str, seed: int, seconds: float, is_busy: bool) -> Load:
    from benchmarks.loads.mit_like import mit_like

    return mit_like(directory, seconds=seconds, seed=seed, kinect=is_busy, name=name)


def _make_hcr(directory: Path, *, name: str, seed: int, seconds: float, is_busy: bool) -> Load:
    from benchmarks.loads.hcr_like import cut, hcr_like

    minutes = max(seconds, _LEAST_HCR_S) / 60
    load = hcr_like(
        directory,
        seed=seed,
        sessions=1,
        minutes=minutes,
        cameras=True,
        state=is_busy,
        name=name,
    )
    return cut(load, seconds)


def _real(path: Path, seconds: float, taken: Iterable[str]) -> Replay:
    with open_source(path) as source:
        files = [
            (str(file.resolve()), stat.st_size, stat.st_mtime_ns)
            for file in source.files
            for stat in (file.stat(),)
        ]
        span = source.time_range
    lasts = seconds if span is None else min(seconds, max((span[1] - span[0]) / 1e9, _LEAST_S))
    name = _unlike(log_name(path), set(taken))
    size = sum(size for _, size, _ in files)
    return Replay(
        name,
        {**_case(name, seconds), "bytes": size},
        {"version": _VERSION, "files": files, "seconds": seconds},
        lasts,
        partial(_read, path, seconds=seconds),
    )


def _read(path: Path, directory: Path, *, seconds: float) -> Load:
    load = from_log(path, directory, seconds=seconds)
    if load.damage:
        note(f"benchmarks: {path} is damaged, the rest of it is published: {load.damage}")
    return load


def _case(name: str, seconds: float) -> dict[str, Any]:
    from benchmarks.studies.throughput import short

    return {"log": name, "seconds": short(seconds)}


def _unlike(name: str, taken: set[str]) -> str:
    """The name, with a number when it is taken."""
    number, found = 1, name
    while found in taken:
        number += 1
        found = f"{name}-{number}"
    return found
