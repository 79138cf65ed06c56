"""Writes training sets in the format of LeRobot, version 3.0.

Each episode is a directory until all are there, so an interrupted export goes on with the
next one. Then they are put together: rows in Parquet files, pictures in MP4 files, and
descriptions in `meta`. `meta/info.json` is written last.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hybridlog import __version__
from hybridlog.arrays.video import pyav
from hybridlog.formats.slices import fingerprint
from hybridlog.formats.writing import failures
from hybridlog.query.pieces import pieces
from hybridlog.query.query import narrowed
from hybridlog.training.episodes import episodes
from hybridlog.training.feature_map import IMAGE_PREFIX
from hybridlog.training.lerobot_episodes import WrittenEpisode, write_episode, write_text
from hybridlog_storage.errors import PayloadError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from hybridlog.query.query import Query
    from hybridlog.training.feature_map import FeatureMap
    from hybridlog.training.lerobot_episodes import LerobotOptions

_QUANTILES: Final = (0.01, 0.1, 0.5, 0.9, 0.99)
_CHUNK_FILES: Final = 1000
_DATA_MB: Final = 100
_VIDEO_MB: Final = 200
_UNFINISHED: Final = ".episodes"
_PLAN: Final = "plan.json"
_DATA: Final = "data/chunk-{chunk:03d}/file-{file:03d}.parquet"
_VIDEO: Final = "videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
_TASKS: Final = {
    "index_columns": ["task"],
    "columns": [
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"}
    ],
}
"""Metadata for pandas: the text of a task is the index of its row, as LeRobot has it."""
_EPISODES: Final = "meta/episodes/chunk-{chunk:03d}/file-{file:03d}.parquet"
_INDEX: Final = {"dtype": "int64", "shape": [1], "names": None}


@dataclass(slots=True)
class LerobotReport:
    """A training set that was written.

    Attributes:
        path: Directory of the set.
        episodes: Number of episodes.
        frames: Number of frames.
        resumed: Episodes that an interrupted export had finished.
        held: Frames whose value of some topic is older than usual.
        dropped: Frames in no episode, since a topic has a gap there.
        missing: Frames that show an earlier picture, since their own cannot be shown.
        lost: Messages that are lost in the episodes.
        bytes: Size of the files.
    """

    path: Path
    episodes: int = 0
    frames: int = 0
    resumed: int = 0
    held: int = 0
    dropped: int = 0
    missing: int = 0
    lost: int = 0
    bytes: int = 0


def write_lerobot(
    query: Query,
    features: FeatureMap,
    path: str | Path,
    options: LerobotOptions,
    *,
    progress: Callable[[str, int], None] | None = None,
) -> LerobotReport:
    """Write the episodes of a question as a training set, into a directory of its own.

    The same export goes on where it was interrupted. `progress` is called with the name of an
    episode and the number of its frames.
    """
    pyav()
    features = features.resolved(query.source.now())
    selected = narrowed(query, *features.topics)
    plan = _plan(selected, features, options)
    root, report = Path(path), LerobotReport(Path(path))
    unfinished = root / _UNFINISHED
    if root.exists() and not unfinished.exists():
        raise UsageError(f"{root} is there already: name another directory, or add --force.")
    if not (unfinished / _PLAN).exists() or (unfinished / _PLAN).read_text() != plan:
        shutil.rmtree(unfinished, ignore_errors=True)  # of another set, which nobody finished
        unfinished.mkdir(parents=True)
        write_text(unfinished / _PLAN, plan)
    made: list[WrittenEpisode] = []
    dropped: Counter[str] = Counter()
    for piece in pieces(selected, options.episodes_by):
        for episode in episodes(piece, features, options.fps, options.on_gap, dropped):
            place = unfinished / f"{len(made):06d}"
            written = WrittenEpisode.read(place)
            report.resumed += written is not None
            if written is None:
                with failures(str(place)):
                    written = write_episode(query.source.now(), episode, features, options, place)
            made.append(written)
            if progress is not None:
                progress(episode.name, made[-1].length)
    if not made:
        shutil.rmtree(root)
        raise UsageError("There is no episode in these recordings, so nothing is written.")
    report.dropped = dropped.total()
    with failures(str(root)):
        _Assembly(root, made, features, options, json.loads(plan)).write(report)
    shutil.rmtree(unfinished)
    return report


def _plan(query: Query, features: FeatureMap, options: LerobotOptions) -> str:
    """Everything that determines the bytes of a set."""
    return json.dumps(
        {
            "hybridlog": __version__,
            "question": repr(query),
            "fingerprint": fingerprint(query),
            "map": features.to_yaml(),
            "fps": options.fps,
            "episodes_by": options.episodes_by,
            "task": options.task or options.task_topic,
            "codec": options.codec,
            "on_gap": options.on_gap,
        },
        indent=1,
    )


# The set.


@dataclass(slots=True)
class _Assembly:
    """Puts the episodes of a set together.

    Attributes:
        plan: Decides the bytes of the set.
        rows: Of the table of episodes.
        tasks: Numbers of the tasks.
    """

    root: Path
    made: Sequence[WrittenEpisode]
    features: FeatureMap
    options: LerobotOptions
    plan: Mapping[str, Any]
    rows: list[dict[str, Any]] = field(init=False)
    tasks: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        self.rows = [{} for _ in self.made]
        names = dict.fromkeys(one.about["task"] for one in self.made)
        self.tasks = {task: number for number, task in enumerate(names)}
        self._check()

    def _check(self) -> None:
        """Refuse episodes of different columns and sizes."""
        first = self.made[0]
        for other in self.made[1:]:
            for what, one, two in (
                ("sizes of pictures", first.pixels, other.pixels),
                ("columns", first.about["names"], other.about["names"]),
            ):
                if one != two:
                    raise UsageError(
                        f"{first.about['name']} and {other.about['name']} have other {what}: "
                        "choose recordings that are alike."
                    )

    def write(self, report: LerobotReport) -> None:
        """Write all files, `meta/info.json` last."""
        for name in ("data", "videos", "meta"):
            if (self.root / name).exists():
                shutil.rmtree(self.root / name)
        (self.root / "meta").mkdir()
        stats = self._write_data()
        for name in self.features.images:
            self._write_videos(name)
            counts = np.sum([one.counts[name] for one in self.made], axis=0)
            stats[f"{IMAGE_PREFIX}{name}"] = _colour_stats(counts)
        path = self._file(_EPISODES, 0)
        pq.write_table(pa.Table.from_pylist(self.rows), path, compression="snappy")
        tasks = pa.table({"task_index": [*self.tasks.values()], "task": [*self.tasks]})
        tasks = tasks.replace_schema_metadata({"pandas": json.dumps(_TASKS)})
        pq.write_table(tasks, self.root / "meta/tasks.parquet", compression="snappy")
        own = {**self.plan, "episodes": [one.about for one in self.made]}
        for file, value in (("stats", stats), ("hybridlog", own), ("info", self._info())):
            write_text(self.root / f"meta/{file}.json", json.dumps(value, indent=1))
        report.episodes = len(self.made)
        report.frames = sum(one.length for one in self.made)
        report.held = sum(sum(one.about["held"].values()) for one in self.made)
        report.missing = sum(sum(one.about["missing"].values()) for one in self.made)
        report.lost = sum(one.about["lost"] for one in self.made)
        report.bytes = sum(
            file.stat().st_size
            for file in self.root.rglob("*")
            if file.is_file() and _UNFINISHED not in file.parts
        )

    def _write_data(self) -> dict[str, Any]:
        """Write the rows; returns statistics of all."""
        begins = np.cumsum([0, *(one.length for one in self.made)]).tolist()
        found = [
            one.vectors() | self._own_columns(place, one, begins[place])
            for place, one in enumerate(self.made)
        ]
        tables = [pa.table({key: _column(array) for key, array in own.items()}) for own in found]
        for number, places in _by_file((table.nbytes for table in tables), _DATA_MB):
            path = self._file(_DATA, number)
            with pq.ParquetWriter(path, tables[0].schema, compression="snappy") as writer:
                for place in places:
                    writer.write_table(tables[place])
                    self.rows[place] = {
                        "episode_index": place,
                        "tasks": [self.made[place].about["task"]],
                        "length": self.made[place].length,
                        **_place_of("data", number),
                        **_place_of("meta/episodes", 0),
                        "dataset_from_index": begins[place],
                        "dataset_to_index": begins[place + 1],
                        **_flat_stats({key: _stats(one) for key, one in found[place].items()}),
                    }
        return {key: _stats(np.concatenate([own[key] for own in found])) for key in found[0]}

    def _file(self, form: str, number: int, key: str = "") -> Path:
        """The path of a file by its number; its folder is made."""
        chunk, file = divmod(number, _CHUNK_FILES)
        path = self.root / form.format(key=key, chunk=chunk, file=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _own_columns(self, place: int, one: WrittenEpisode, begin: int) -> dict[str, NDArray[Any]]:
        frames = np.arange(one.length, dtype=np.int64)
        return {
            "timestamp": (frames / self.options.fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(one.length, place, np.int64),
            "index": frames + begin,
            "task_index": np.full(one.length, self.tasks[one.about["task"]], np.int64),
        }

    def _write_videos(self, name: str) -> None:
        """Join the videos of the episodes; packets are copied."""
        fps, key = self.options.fps, f"{IMAGE_PREFIX}{name}"
        videos = [one.place / f"{name}.mp4" for one in self.made]
        for number, places in _by_file((path.stat().st_size for path in videos), _VIDEO_MB):
            with pyav().open(str(self._file(_VIDEO, number, key)), "w", format="mp4") as target:
                frames, track = 0, None
                for place in places:
                    begin = frames
                    with pyav().open(str(videos[place])) as file:
                        track = track or target.add_stream_from_template(file.streams.video[0])
                        for packet in file.demux(video=0):
                            if packet.dts is None:
                                continue
                            packet.stream, packet.time_base = track, Fraction(1, fps)
                            packet.pts = packet.dts = frames
                            packet.duration = 1
                            target.mux(packet)
                            frames += 1
                    one = self.made[place]
                    if frames - begin != one.length:
                        raise PayloadError(
                            f"{name}.mp4 has {frames - begin} frames, not {one.length}"
                        )
                    self.rows[place] |= {
                        **_place_of(f"videos/{key}", number),
                        f"videos/{key}/from_timestamp": begin / fps,
                        f"videos/{key}/to_timestamp": frames / fps,
                        **_flat_stats({key: _colour_stats(one.counts[name])}),
                    }

    def _info(self) -> dict[str, Any]:
        """The description of the set for LeRobot."""
        first, fps = self.made[0], self.options.fps
        features: dict[str, Any] = {}
        for name, array in first.vectors().items():
            names = first.about["names"][name]
            features[name] = {"dtype": "float32", "shape": [array.shape[1]], "names": names}
        for name, size in first.pixels.items():
            rows, columns = (number + number % 2 for number in size)
            features[f"{IMAGE_PREFIX}{name}"] = {
                "dtype": "video",
                "shape": [rows, columns, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.fps": fps,
                    "video.height": rows,
                    "video.width": columns,
                    "video.channels": 3,
                    "video.codec": self.options.codec,
                    "video.pix_fmt": "yuv420p",
                    "video.is_depth_map": False,
                    "has_audio": False,
                },
            }
        features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        features |= dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), _INDEX)
        return {
            "codebase_version": "v3.0",
            "robot_type": self.features.robot_type or "unknown",
            "total_episodes": len(self.made),
            "total_frames": sum(one.length for one in self.made),
            "total_tasks": len(self.tasks),
            "chunks_size": _CHUNK_FILES,
            "data_files_size_in_mb": _DATA_MB,
            "video_files_size_in_mb": _VIDEO_MB,
            "fps": fps,
            "splits": {"train": f"0:{len(self.made)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": features,
        }


def _by_file(sizes: Iterable[int], limit_mb: int) -> Iterator[tuple[int, list[int]]]:
    """Numbers of files, and the episodes of so many bytes that go into each."""
    total, files = 0, list[list[int]]()
    for place, size in enumerate(sizes):
        if not files or total + size > limit_mb << 20:
            total = 0
            files.append([])
        total += size
        files[-1].append(place)
    return enumerate(files)


def _place_of(what: str, number: int) -> dict[str, int]:
    chunk, file = divmod(number, _CHUNK_FILES)
    return {f"{what}/chunk_index": chunk, f"{what}/file_index": file}


def _column(array: NDArray[Any]) -> Any:
    if array.ndim == 1 or array.shape[1] == 1:
        return pa.array(array.ravel())
    return pa.FixedSizeListArray.from_arrays(pa.array(array.ravel()), array.shape[1])


def _stats(array: NDArray[Any]) -> dict[str, list[Any]]:
    """Statistics of the columns of an array."""
    values = np.asarray(array, np.float64).reshape(len(array), -1)
    found = {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
        "count": np.array([len(values)]),
    }
    for share, row in zip(_QUANTILES, np.quantile(values, _QUANTILES, axis=0), strict=True):
        found[_quantile(share)] = row
    return {name: value.tolist() for name, value in found.items()}


def _colour_stats(occurring: ArrayLike) -> dict[str, list[Any]]:
    """Statistics of colours from 0 to 1, of how often each value occurs in them."""
    counts = np.asarray(occurring, np.int64)
    levels, total = np.arange(256) / 255, counts.sum(1)
    mean = counts @ levels / total
    rows = {
        "min": levels[(counts > 0).argmax(1)],
        "max": levels[255 - (counts[:, ::-1] > 0).argmax(1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0)),
    }
    below = np.cumsum(counts, axis=1)
    for share in _QUANTILES:
        rows[_quantile(share)] = levels[(below >= share * total[:, None]).argmax(1)]
    found = {name: row.reshape(3, 1, 1).tolist() for name, row in rows.items()}
    return {**found, "count": [int(total[0])]}


def _quantile(share: float) -> str:
    return f"q{round(share * 100):02d}"


def _flat_stats(found: Mapping[str, Mapping[str, list[Any]]]) -> dict[str, list[Any]]:
    return {
        f"stats/{name}/{what}": value for name, own in found.items() for what, value in own.items()
    }
