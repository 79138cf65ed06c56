"""Writes training sets in the format of LeRobot, version 3.0.

Episodes are written as they come: rows into Parquet files, pictures into MP4 files, several
episodes a file. The set appears under its name when it is complete.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from contextlib import closing, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct
from msgspec.structs import replace

from hybridlog import __version__
from hybridlog.arrays.video import pyav
from hybridlog.formats.slices import fingerprint
from hybridlog.formats.writing import failures, new_directory
from hybridlog.query.pieces import pieces
from hybridlog.query.query import Query, narrowed
from hybridlog.query.question import Question
from hybridlog.training.episodes import (
    IMAGE_PREFIX,
    Episode,
    FeatureMap,
    OnGap,
    episodes,
    is_depth,
    pictures,
)
from hybridlog_storage.errors import (
    DefinitionError,
    MissingDependencyError,
    PayloadError,
    UsageError,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from numpy.typing import ArrayLike, NDArray

    from hybridlog.session import Session

Codec = Literal["h264", "av1"]
_CODECS: Final[Mapping[Codec, tuple[str, Mapping[str, str]]]] = {
    "h264": ("libx264", {"preset": "veryfast", "crf": "23", "g": "2", "bf": "0"}),
    "av1": ("libsvtav1", {"preset": "10", "crf": "30", "g": "2"}),
}
"""Encoders and their options: a key frame in every two, so that any frame is near one."""
_THREADS: Final = 4  # of an encoder; the bytes depend on it
_SAMPLED_FRAMES: Final = 100
"""Pictures of an episode in its statistics, about."""
_SAMPLED_ROWS: Final = 150
_QUANTILES: Final = (0.01, 0.1, 0.5, 0.9, 0.99)
_CHUNK_FILES: Final = 1000
_DATA_MB: Final = 100
_VIDEO_MB: Final = 200
_PLACE: Final = "{folder}/chunk-{chunk:03d}/file-{file:03d}{suffix}"
_TASKS: Final = {
    "index_columns": ["task"],
    "columns": [
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"}
    ],
}
"""Metadata for pandas: the text of a task is the index of its row, as LeRobot has it."""
_INDEX: Final = {"dtype": "int64", "shape": [1], "names": None}


class LerobotOptions(Struct, frozen=True):
    """Options of a training set.

    Attributes:
        fps: Frames per second.
        episodes_by: An episode for each `recording`, each `mark`, or each interval in which a
            predicate holds, such as `"odom: twist.twist.linear.x > 0.1"`.
        task: What the robot does, in words.
        task_topic: A topic of texts that say it instead; the one at the begin of an episode
            counts.
        codec: Codec of the pictures.
        on_gap: An episode with a gap in a topic is refused, is cut there, or keeps the last
            value. A message with NaN is none.
        depth_scale: Metres at 0 and at 255 of pictures of depth, which are left out without.
    """

    fps: int
    episodes_by: str = "recording"
    task: str = ""
    task_topic: str | None = None
    codec: Codec = "h264"
    on_gap: OnGap = "refuse"
    depth_scale: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.fps <= 1000:
            raise UsageError("Frames per second are 1 to 1000.")
        if bool(self.task.strip()) == (self.task_topic is not None):
            raise UsageError("Say what the robot does: --task TEXT or --task-topic TOPIC.")
        if self.depth_scale is not None and not self.depth_scale[0] < self.depth_scale[1]:
            raise UsageError("A scale of depth is metres at 0 and more metres at 255.")


@dataclass(slots=True)
class LerobotReport:
    """A training set that was written.

    Attributes:
        path: Directory of the set.
        episodes: Number of episodes.
        frames: Number of frames.
        held: Frames whose value of some topic is older than usual.
        dropped: Frames in no episode, since a topic has a gap there.
        missing: Frames that show an earlier picture, since their own cannot be shown.
        lost: Messages that are lost in the episodes.
        left_out: Topics of depth that are left out, since no scale is given.
        bytes: Size of the files.
    """

    path: Path
    episodes: int = 0
    frames: int = 0
    held: int = 0
    dropped: int = 0
    missing: int = 0
    lost: int = 0
    left_out: tuple[str, ...] = ()
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

    `progress` is called with the name of an episode and the number of its frames.
    """
    pyav()
    session, report = query.source.now(), LerobotReport(Path(path))
    features, dropped = features.resolved(session), Counter[str]()
    depths = {topic for topic in features.images.values() if _is_of_depth(query, topic)}
    if depths and options.depth_scale is None:
        kept = {name: one for name, one in features.images.items() if one not in depths}
        features, report.left_out = replace(features, images=kept), tuple(sorted(depths))
        if not features.topics:
            raise UsageError("Pictures of depth need --depth-scale: metres at 0 and at 255.")
    selected = narrowed(query, *features.topics)
    with failures(str(path)):
        final, unfinished = new_directory(path, "a training set is a directory")
        try:
            with closing(
                _Set(session, unfinished.path, features, options, report, depths=depths)
            ) as made:
                for piece in pieces(selected, options.episodes_by):
                    for one in episodes(piece, features, options.fps, options.on_gap, dropped):
                        made.add(one)
                        if progress is not None:
                            progress(one.name, len(one.times))
                report.dropped = dropped.total()
                made.finish(selected)
            unfinished.publish(final)
        finally:
            unfinished.remove()
    return report


def _is_of_depth(query: Query, topic: str) -> bool:
    """True if the first picture of a topic has depth in place of colours."""
    for message in narrowed(query, topic).limit(1):
        with suppress(PayloadError, DefinitionError):
            return is_depth(message.to_numpy())
    return False


class _Set:
    """Writes the files of a set below `root`, and counts in `report`."""

    def __init__(
        self,
        session: Session,
        root: Path,
        features: FeatureMap,
        options: LerobotOptions,
        report: LerobotReport,
        *,
        depths: set[str],
    ) -> None:
        self._session, self._root, self._features = session, root, features
        self._options, self._report = options, report
        self._rows: list[dict[str, Any]] = []  # of the table of episodes
        self._about: list[dict[str, Any]] = []  # the episodes
        self._tasks: dict[str, int] = {}
        self._columns: defaultdict[str, list[NDArray[Any]]] = defaultdict(list)
        self._videos = {
            name: _Video(root, name, options, is_depth=topic in depths)
            for name, topic in features.images.items()
        }
        self._file: pq.ParquetWriter | None = None
        self._number, self._size = -1, 0
        self._types: dict[str, str] = {}  # of the vectors

    def add(self, episode: Episode) -> None:
        """Write an episode."""
        begin, length, report = self._report.frames, len(episode.times), self._report
        about, missing = self._described(episode), Counter[str]()
        names, first = about["names"], self._about[0] if self._about else about
        types = {key: str(one.dtype) for key, one in episode.vectors.items()}
        if (names, self._types or types) != (first["names"], types):
            raise UsageError(
                f"{first['name']} and {episode.name} have other columns: choose recordings that "
                "are alike."
            )
        self._types = types
        frames = np.arange(length, dtype=np.int64)
        task = self._tasks.setdefault(about["task"], len(self._tasks))
        columns: dict[str, NDArray[Any]] = episode.vectors | {
            "timestamp": (frames / self._options.fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(length, len(self._rows), np.int64),
            "index": frames + begin,
            "task_index": np.full(length, task, np.int64),
        }
        for key, array in columns.items():
            self._columns[key].append(array)
        row: dict[str, Any] = {
            "episode_index": len(self._rows),
            "tasks": [about["task"]],
            "length": length,
            **_place_of("data", self._write(columns)),
            **_place_of("meta/episodes", 0),
            "dataset_from_index": begin,
            "dataset_to_index": begin + length,
            **_flat_stats({key: _stats(one) for key, one in columns.items()}),
        }
        for name, topic in self._features.images.items():
            row |= self._videos[name].add(episode.name, self._shown(episode, topic, missing))
        self._rows.append(row)
        self._about.append(about | {"missing": missing})
        report.episodes += 1
        report.frames += length
        report.held += sum(episode.held.values())
        report.missing += missing.total()
        report.lost += about["lost"]

    def _described(self, episode: Episode) -> dict[str, Any]:
        begin, end = int(episode.times[0]), int(episode.times[-1]) + 1
        question = Question(self._features.topics, (episode.recording,))
        lost = Query(self._session, question).between(begin, end).completeness()
        return {
            "name": episode.name,
            "recording": episode.recording,
            "begin_ns": begin,
            "end_ns": end,
            "task": self._task(episode),
            "names": {name: [*columns] for name, columns in episode.names.items()},
            "held": episode.held,
            "lost": lost.messages,
            "is_lost_exact": lost.is_exact,
        }

    def _task(self, episode: Episode) -> str:
        topic = self._options.task_topic
        if topic is None:
            return self._options.task
        query = Query(self._session, self._session.question([topic], [episode.recording]))
        text = getattr(query.at(int(episode.times[0])).decode(), "data", None)
        if not isinstance(text, str) or not text.strip():
            raise UsageError(f"{topic} has no text in `data`: name another topic.")
        return text

    def _write(self, columns: Mapping[str, NDArray[Any]]) -> int:
        """Write rows; returns the number of their file."""
        table = pa.table({key: _column(array) for key, array in columns.items()})
        self._size += table.nbytes
        if self._file is None or self._size > _DATA_MB << 20:
            self.close()
            self._number, self._size = self._number + 1, table.nbytes
            path = _path(self._root, "data", self._number, ".parquet")
            self._file = pq.ParquetWriter(path, table.schema, compression="snappy")
        self._file.write_table(table)
        return self._number

    def _shown(
        self, episode: Episode, topic: str, missing: Counter[str]
    ) -> Iterator[tuple[NDArray[np.uint8] | None, int]]:
        for picture, frames in pictures(self._session, episode, topic, self._options.depth_scale):
            if picture is None:
                if self._options.on_gap == "refuse":
                    raise UsageError(
                        f"{episode.name}: a picture of {topic} cannot be shown, or has no "
                        "payload. --on-gap hold shows the one before."
                    )
                missing[topic] += frames
            yield picture, frames

    def finish(self, query: Query) -> None:
        """Write what describes the episodes of a question."""
        if not self._rows:
            raise UsageError("There is no episode in these recordings, so nothing is written.")
        self.close()
        stats = {key: _stats(np.concatenate(own)) for key, own in self._columns.items()}
        for video in self._videos.values():
            video.finish()
            stats[video.key] = _colour_stats(video.counts)
        path = _path(self._root, "meta/episodes", 0, ".parquet")
        pq.write_table(pa.Table.from_pylist(self._rows), path, compression="snappy")
        tasks = pa.table({"task_index": [*self._tasks.values()], "task": [*self._tasks]})
        tasks = tasks.replace_schema_metadata({"pandas": json.dumps(_TASKS)})
        pq.write_table(tasks, self._root / "meta/tasks.parquet", compression="snappy")
        options = self._options
        own = {
            "hybridlog": __version__,
            "question": repr(query),
            "fingerprint": fingerprint(query),
            "map": self._features.to_yaml(),
            "fps": options.fps,
            "episodes_by": options.episodes_by,
            "task": options.task or options.task_topic,
            "codec": options.codec,
            "on_gap": options.on_gap,
            "depth_scale": options.depth_scale,
            "episodes": self._about,
        }
        for file, value in (("stats", stats), ("hybridlog", own), ("info", self._info())):
            (self._root / f"meta/{file}.json").write_text(json.dumps(value, indent=1))
        files = (file for file in self._root.rglob("*") if file.is_file())
        self._report.bytes = sum(file.stat().st_size for file in files)

    def _info(self) -> dict[str, Any]:
        """The description of the set for LeRobot."""
        features: dict[str, Any] = {
            name: {"dtype": self._types[name], "shape": [len(columns)], "names": columns}
            for name, columns in self._about[0]["names"].items()
        }
        features |= {video.key: video.feature for video in self._videos.values()}
        features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        features |= dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), _INDEX)
        place = "chunk-{chunk_index:03d}/file-{file_index:03d}"
        return {
            "codebase_version": "v3.0",
            "robot_type": self._features.robot_type or "unknown",
            "total_episodes": len(self._rows),
            "total_frames": self._report.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK_FILES,
            "data_files_size_in_mb": _DATA_MB,
            "video_files_size_in_mb": _VIDEO_MB,
            "fps": self._options.fps,
            "splits": {"train": f"0:{len(self._rows)}"},
            "data_path": f"data/{place}.parquet",
            "video_path": f"videos/{{video_key}}/{place}.mp4",
            "features": features,
        }

    def close(self) -> None:
        """Close the file of rows."""
        if self._file is not None:
            self._file.close()
            self._file = None


class _Video:
    """Encodes the pictures of a camera, several episodes a file, and counts values of colours."""

    def __init__(self, root: Path, name: str, options: LerobotOptions, *, is_depth: bool) -> None:
        self.key = f"{IMAGE_PREFIX}{name}"
        self.counts = np.zeros((3, 256), np.int64)  # how often each value occurs in some pictures
        self._root, self._options, self._is_depth = root, options, is_depth
        self._size: tuple[int, ...] = ()  # rows and columns of a picture
        self._file: Any = None
        self._track: Any = None
        self._path = root
        self._number, self._frames = -1, 0

    def add(
        self, episode: str, shown: Iterable[tuple[NDArray[np.uint8] | None, int]]
    ) -> dict[str, Any]:
        """Append pictures, each for a number of frames; returns columns of their episode.

        For None it is the one before, or the first one.
        """
        if self._file is not None and self._path.stat().st_size > _VIDEO_MB << 20:
            self.finish()
        begin, waiting, before, counts = self._frames, 0, None, np.zeros((3, 256), np.int64)
        for picture, frames in shown:
            waiting += frames
            if picture is not None:
                before = self._fitting(episode, picture)
                done = self._frames - begin
                if done % max(done // _SAMPLED_FRAMES, 1) == 0:
                    counts += _counts_of(picture)
            if before is not None:
                self._encode(before, waiting)
                waiting = 0
        if before is None:
            raise PayloadError(f"{episode}: {self.key} has no picture that can be shown")
        self.counts += counts
        folder, fps = f"videos/{self.key}", self._options.fps
        return {
            **_place_of(folder, self._number),
            f"{folder}/from_timestamp": begin / fps,
            f"{folder}/to_timestamp": self._frames / fps,
            **_flat_stats({self.key: _colour_stats(counts)}),
        }

    @property
    def feature(self) -> dict[str, Any]:
        """Its description for LeRobot."""
        rows, columns = (number + number % 2 for number in self._size)
        return {
            "dtype": "video",
            "shape": [rows, columns, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.fps": self._options.fps,
                "video.height": rows,
                "video.width": columns,
                "video.channels": 3,
                "video.codec": self._options.codec,
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": self._is_depth,
                "has_audio": False,
            },
        }

    def _fitting(self, episode: str, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture with an even number of rows and columns; all have one size."""
        rows, columns = self._size = self._size or picture.shape[:2]
        if picture.shape[:2] != self._size:
            raise UsageError(
                f"{episode}: {self.key} has other sizes of pictures than before: choose "
                "recordings that are alike."
            )
        even = [(0, rows % 2), (0, columns % 2), (0, 0)]
        return np.ascontiguousarray(np.pad(picture, even, mode="edge"))

    def _encode(self, picture: NDArray[np.uint8], frames: int) -> None:
        if self._file is None:
            self._begin(*picture.shape[:2])
        frame = pyav().VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv420p")
        for _ in range(frames):
            frame.pts, frame.time_base = self._frames, Fraction(1, self._options.fps)
            self._file.mux(self._track.encode(frame))
            self._frames += 1

    def _begin(self, rows: int, columns: int) -> None:
        """Begin the next file."""
        self._number += 1
        self._path = _path(self._root, f"videos/{self.key}", self._number, ".mp4")
        self._file = pyav().open(str(self._path), "w", format="mp4")
        name, how = _CODECS[self._options.codec]
        try:
            track = self._file.add_stream(name, rate=self._options.fps, options=dict(how))
        except (pyav().FFmpegError, ValueError) as error:
            raise MissingDependencyError(f"this PyAV has no {name}") from error
        track.width, track.height, track.pix_fmt = columns, rows, "yuv420p"
        track.codec_context.thread_count = _THREADS
        self._track = track

    def finish(self) -> None:
        """Complete the file."""
        self._file.mux(self._track.encode(None))
        self._file.close()
        self._file, self._frames = None, 0


def _path(root: Path, folder: str, number: int, suffix: str) -> Path:
    """The path of a file by its number; its folder is made."""
    chunk, file = divmod(number, _CHUNK_FILES)
    path = root / _PLACE.format(folder=folder, chunk=chunk, file=file, suffix=suffix)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


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


def _counts_of(picture: NDArray[np.uint8]) -> NDArray[np.int64]:
    """How often each value occurs in each colour of some rows and columns: int64[3, 256]."""
    step = max(max(picture.shape[:2]) // _SAMPLED_ROWS, 1)
    colours = (picture[::step, ::step, colour].ravel() for colour in range(3))
    return np.array([np.bincount(one, minlength=256) for one in colours], np.int64)


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
