"""Episodes of a training set as directories, while the set is not complete."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import closing
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from msgspec import Struct

from hybridlog.arrays.video import pyav
from hybridlog.query.query import Query
from hybridlog.query.question import Question
from hybridlog.training.episodes import pictures
from hybridlog_storage.disk.files import write_new
from hybridlog_storage.errors import MissingDependencyError, PayloadError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog.training.episodes import Episode, OnGap
    from hybridlog.training.feature_map import FeatureMap

Codec = Literal["h264", "av1"]
CODECS: Final[Mapping[Codec, tuple[str, Mapping[str, str]]]] = {
    "h264": ("libx264", {"preset": "veryfast", "crf": "23", "g": "2", "bf": "0"}),
    "av1": ("libsvtav1", {"preset": "10", "crf": "30", "g": "2"}),
}
"""Encoders and their options: a key frame in every two, so that any frame is near one."""
_THREADS: Final = 4  # of an encoder; the bytes depend on it
_SAMPLED_FRAMES: Final = 100
"""Pictures of an episode in its statistics, about."""
_SAMPLED_ROWS: Final = 150
_ABOUT: Final = "episode.json"
_VECTORS: Final = "vectors.npz"


class LerobotOptions(Struct, frozen=True):
    """Options of a training set.

    Attributes:
        fps: Frames per second.
        episodes_by: `recording`, `mark`, or a predicate.
        task: Activity of the robot, in words.
        task_topic: A topic that says it instead; its text at the begin of an episode counts.
        codec: Codec of the pictures.
        on_gap: Effect of a gap in a topic.
    """

    fps: int
    episodes_by: str = "recording"
    task: str = ""
    task_topic: str | None = None
    codec: Codec = "h264"
    on_gap: OnGap = "refuse"

    def __post_init__(self) -> None:
        if not 1 <= self.fps <= 1000:
            raise UsageError("Frames per second are 1 to 1000.")
        if bool(self.task.strip()) == (self.task_topic is not None):
            raise UsageError("Say what the robot does: --task TEXT or --task-topic TOPIC.")


class WrittenEpisode(Struct):
    """An episode that was written.

    Attributes:
        place: Its directory.
        about: Name, recording, begin and end, task, losses.
        length: Number of frames.
        counts: 3 x 256 by camera: how often each value occurs in a colour.
        pixels: Rows and columns by camera.
    """

    place: Path
    about: dict[str, Any]
    length: int
    counts: dict[str, list[list[int]]]
    pixels: dict[str, list[int]]

    @classmethod
    def read(cls, place: Path) -> WrittenEpisode | None:
        """The episode in a directory; None if it is not whole."""
        if not (place / _ABOUT).exists():
            return None
        return cls(place, **json.loads((place / _ABOUT).read_text()))

    def vectors(self) -> dict[str, NDArray[np.float32]]:
        """The features: float32[n, width] by name."""
        with np.load(self.place / _VECTORS, allow_pickle=False) as found:
            return {name: found[name] for name in found.files}


def write_episode(
    session: Session, episode: Episode, features: FeatureMap, options: LerobotOptions, place: Path
) -> WrittenEpisode:
    """Write an episode; its description is written last."""
    if place.exists():
        shutil.rmtree(place)
    place.mkdir()
    begin, end = int(episode.times[0]), int(episode.times[-1]) + 1
    query = Query(session, Question(features.topics, (episode.recording,))).between(begin, end)
    lost = query.completeness()
    about: dict[str, Any] = {
        "name": episode.name,
        "recording": episode.recording,
        "begin_ns": begin,
        "end_ns": end,
        "task": _task(session, episode, options),
        "names": {name: [*columns] for name, columns in episode.names.items()},
        "held": episode.held,
        "lost": lost.messages,
        "is_lost_exact": lost.is_exact,
        "missing": {},
    }
    counts, pixels = {}, {}
    for name, topic in features.images.items():
        with closing(_Video(place / f"{name}.mp4", options)) as video:
            for picture, shown in pictures(session, episode, topic):
                if picture is None:
                    if options.on_gap == "refuse":
                        raise UsageError(
                            f"{episode.name}: a picture of {topic} cannot be shown, or has no "
                            "payload. --on-gap hold shows the one before."
                        )
                    about["missing"][topic] = about["missing"].get(topic, 0) + shown
                video.add(picture, shown)
            video.finish(f"{episode.name}: {topic}")
        counts[name], pixels[name] = video.counts.tolist(), [*video.size]
    np.savez(place / _VECTORS, **episode.vectors)  # type: ignore[arg-type]
    value = {"about": about, "length": len(episode.times), "counts": counts, "pixels": pixels}
    write_text(place / _ABOUT, json.dumps(value))
    return WrittenEpisode(place, about, len(episode.times), counts, pixels)


def _task(session: Session, episode: Episode, options: LerobotOptions) -> str:
    if options.task_topic is None:
        return options.task
    topic = Query(session, session.question([options.task_topic], [episode.recording]))
    text = getattr(topic.at(int(episode.times[0])).decode(), "data", None)
    if not isinstance(text, str) or not text.strip():
        raise UsageError(f"{options.task_topic} has no text in `data`: name another topic.")
    return text


class _Video:
    """Encodes the pictures of an episode.

    Attributes:
        counts: int64[3, 256], how often each value occurs in a colour, of some pictures.
        size: Rows and columns of a picture.
    """

    def __init__(self, path: Path, options: LerobotOptions) -> None:
        self._av = pyav()
        self._options = options
        self._file: Any = self._av.open(str(path), "w", format="mp4")
        self._track: Any = None
        self._frames = 0
        self._waiting = 0  # frames before the first picture
        self._before: NDArray[np.uint8] | None = None
        self.counts = np.zeros((3, 256), np.int64)
        self.size = (0, 0)

    def add(self, picture: NDArray[np.uint8] | None, count: int) -> None:
        """Append a picture, or the one before, for a number of frames."""
        if picture is None and self._before is None:
            self._waiting += count
            return
        if picture is not None:
            count, self._waiting = count + self._waiting, 0
            self._before = self._checked(picture)
            if self._frames % max(self._frames // _SAMPLED_FRAMES, 1) == 0:
                self._count(picture)
        frame = self._av.VideoFrame.from_ndarray(self._before, format="rgb24")
        frame = frame.reformat(format="yuv420p")
        for _ in range(count):
            frame.pts, frame.time_base = self._frames, Fraction(1, self._options.fps)
            self._mux(frame)
            self._frames += 1

    def _checked(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._track is None:
            self.size = picture.shape[:2]
            self._start()
        if picture.shape[:2] != self.size:
            before, now = (f"{one[1]} x {one[0]}" for one in (self.size, picture.shape))
            raise UsageError(f"A camera changes its size from {before} to {now}.")
        even = [(0, self.size[0] % 2), (0, self.size[1] % 2), (0, 0)]
        return np.ascontiguousarray(np.pad(picture, even, mode="edge"))

    def _start(self) -> None:
        name, options = CODECS[self._options.codec]
        try:
            track = self._file.add_stream(name, rate=self._options.fps, options=dict(options))
        except (self._av.FFmpegError, ValueError) as error:
            raise MissingDependencyError(f"this PyAV has no {name}") from error
        track.width, track.height = self.size[1] + self.size[1] % 2, self.size[0] + self.size[0] % 2
        track.pix_fmt = "yuv420p"
        track.codec_context.thread_count = _THREADS
        self._track = track

    def _count(self, picture: NDArray[np.uint8]) -> None:
        step = max(max(picture.shape[:2]) // _SAMPLED_ROWS, 1)
        for colour in range(3):
            values = picture[::step, ::step, colour].ravel()
            self.counts[colour] += np.bincount(values, minlength=256)

    def _mux(self, frame: Any) -> None:
        for packet in self._track.encode(frame):
            self._file.mux(packet)

    def finish(self, name: str) -> None:
        """Complete the file; without any picture it is refused."""
        if self._track is None:
            raise PayloadError(f"{name} has no picture that can be shown")
        self._mux(None)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def write_text(path: Path, text: str) -> None:
    """Write a file that is whole or not there."""
    write_new(path, text.encode())
