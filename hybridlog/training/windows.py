"""Windows of states and pictures over a store, for training without an export."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.across.topic_reader import OpensAgain
from hybridlog.query.answers.last_message import message_at
from hybridlog.query.answers.lost import completeness_of
from hybridlog.query.pieces import pieces
from hybridlog.query.query import Query
from hybridlog.query.question import Question
from hybridlog.query.times import format_time
from hybridlog.training.episodes import episodes, picture_or_none
from hybridlog.training.feature_map import IMAGE_PREFIX
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import PayloadError, StoreError, UsageError
from hybridlog_storage.times import BEGIN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.across.topic_reader import OpenedStore
    from hybridlog.training.episodes import Episode, OnGap
    from hybridlog.training.feature_map import FeatureMap

_MAX_NAMES: Final = 3  # recordings in a message
_OWN: Final = frozenset({"log_time", "is_stale", "recording", "episode"})


class Windows(OpensAgain, Sequence[dict[str, Any]]):
    """Windows of frames at regular times, one for each frame that one can begin with.

    A map-style data set: `len`, `[n]` and iteration. Numbers are read when it is made, pictures
    when a window is asked for. It can be pickled and used after a fork, such as in workers of
    a data loader: each process opens the store for itself.

    A window is a dictionary of `numpy` arrays:

    * each feature of numbers, such as `action`: float32[length + horizon, width];
    * each camera, such as `observation.images.front`: uint8[length, rows, columns, 3];
    * `log_time`: int64[length + horizon], ns;
    * `is_stale`: bool[length + horizon], frames with a value or picture that may be older than
      what the robot had: there is a gap, messages are lost, or a picture cannot be shown;
    * `recording`: id of its recording, a text; `episode`: its number.

    Attributes:
        names: Names of the columns, by name of the feature.
        episodes: Names of the episodes.
        left_out: Number of frames that are in no window because of gaps, and of those in
            episodes that are too short.
        counters: What reading pictures has cost in this process.
    """

    def __init__(
        self,
        query: Query,
        open_again: Callable[[], OpenedStore],
        features: FeatureMap,
        *,
        fps: int,
        length: int,
        horizon: int,
        episodes_by: str,
        on_gap: OnGap,
    ) -> None:
        if length < 1 or horizon < 0:
            raise UsageError("A window has 1 frame or more, and 0 or more behind them.")
        if not 1 <= fps <= 1000:
            raise UsageError("Frames per second are 1 to 1000.")
        super().__init__(query.session, open_again)
        features = features.resolved(query.session)
        if taken := _OWN.intersection(features.vectors):
            raise UsageError(f"{min(taken)} is no name for a feature of windows: choose another.")
        selected = query.with_topic(*features.topics)
        if running := [one.label for one in selected.summaries() if one.status == "open"]:
            raise UsageError(
                f"{listed(running, _MAX_NAMES)} is being recorded, so its windows would change: "
                "choose recordings that have ended."
            )
        self._question = selected.question
        self._cameras = features.images
        self._length, self._size = length, length + horizon
        self._holds = on_gap == "hold"
        dropped: Counter[str] = Counter()
        found = [
            episode
            for piece in pieces(selected, episodes_by)
            for episode in episodes(piece, features, fps, on_gap, dropped)
        ]
        self._episodes = [one for one in found if len(one.times) >= self._size]
        used = sum(len(one.times) for one in self._episodes)
        self.left_out = dropped.total(), sum(len(one.times) for one in found) - used
        self.episodes = tuple(one.name for one in self._episodes)
        counts = [len(one.times) - self._size + 1 for one in self._episodes]
        self._ends = np.cumsum(counts, dtype=np.int64)
        self.names = self._check_alike(features)

    def __repr__(self) -> str:
        parts = [*self.names, *(IMAGE_PREFIX + name for name in self._cameras)]
        return (
            f"<Windows {', '.join(parts)}; {len(self)} of {counted(len(self.episodes), 'episode')}>"
        )

    def _check_alike(self, features: FeatureMap) -> dict[str, tuple[str, ...]]:
        """Names of the columns, which must be those of all episodes.

        Raises:
            UsageError: They differ.
        """
        names = [one.names for one in self._episodes] or [dict.fromkeys(features.vectors, ())]
        for episode, own in zip(self._episodes, names, strict=False):
            if own != names[0]:
                raise UsageError(
                    f"{self.episodes[0]} and {episode.name} have other columns: choose "
                    "recordings that are alike."
                )
        return names[0]

    def remarks(self) -> list[str]:
        """Sentences about the windows: frames that are in none, and what the topics may lack."""
        gaps, short = self.left_out
        found = []
        if not (self._episodes or gaps or short):
            found.append("There is no episode in these recordings, so there is no window.")
        if gaps:
            found.append(f"{counted(gaps, 'frame')} left out, because a topic has a gap there.")
        if short:
            found.append(
                f"{counted(short, 'frame')} left out, in episodes of less than "
                f"{counted(self._size, 'frame')}."
            )
        if stale := sum(int(one.is_stale.sum()) for one in self._episodes):
            found.append(
                f"{counted(stale, 'frame')} may have values that are older than usual; "
                "`is_stale` says which."
            )
        return [*found, *completeness_of(self._opened(), self._question).sentences]

    def order(self, seed: int) -> NDArray[np.int64]:
        """All places in random order: for a seed always the same, with every version of numpy.

        Args:
            seed: 0 to 4294967295.
        """
        # The stream of `RandomState` is frozen; that of `default_rng` is not.
        order: NDArray[np.int64] = np.random.RandomState(seed).permutation(len(self))
        return order

    def __len__(self) -> int:
        """Number of windows."""
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, place: Any) -> Any:
        """A window; a list of them for a slice.

        Raises:
            PayloadError: A picture cannot be shown, or has no payload.
            StoreError: A picture is not in the store any more, or damaged.
        """
        if isinstance(place, slice):
            return [self[n] for n in range(*place.indices(len(self)))]
        row = range(len(self))[place]
        number = int(np.searchsorted(self._ends, row, "right"))
        episode = self._episodes[number]
        last = len(episode.times) - self._size + 1
        begin = row - int(self._ends[number]) + last
        frames = slice(begin, begin + self._size)
        is_stale = episode.is_stale[frames].copy()
        window: dict[str, Any] = {
            name: values[frames].copy() for name, values in episode.vectors.items()
        }
        for name, topic in self._cameras.items():
            shown = episode.shown[topic][begin : begin + self._length]
            window[IMAGE_PREFIX + name] = self._pictures(episode, topic, shown, is_stale)
        return {
            **window,
            "log_time": episode.times[frames].copy(),
            "is_stale": is_stale,
            "recording": episode.recording,
            "episode": number,
        }

    def _pictures(
        self, episode: Episode, topic: str, shown: NDArray[np.int64], is_stale: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """The pictures of messages, each decoded once; marks frames whose own is not there."""
        question = Question((topic,), (episode.recording,))
        edges = np.flatnonzero(np.diff(shown, prepend=BEGIN, append=BEGIN))
        found: NDArray[np.uint8] | None = None
        waiting = 0
        for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            picture = self._picture(episode, question, int(shown[low]))
            if picture is None:
                is_stale[low:high] = True
                if found is None:
                    waiting = high
                else:
                    found[low:high] = found[low - 1]
                continue
            if found is None:
                found = np.empty((len(shown), *picture.shape), np.uint8)
                found[:waiting] = picture
            if picture.shape != found.shape[1:]:
                raise PayloadError(f"{episode.name}: pictures of {topic} change their size")
            found[low:high] = picture
        if found is None:
            raise PayloadError(
                f"{episode.name}: no picture of {topic} can be shown in the window at "
                f"{format_time(int(shown[0]))}"
            )
        return found

    def _picture(self, episode: Episode, question: Question, time: int) -> NDArray[np.uint8] | None:
        topic = question.topics[0]
        message = message_at(self._opened(), question, self.counters, time)
        if message is None or message.log_time_ns != time:
            raise StoreError(
                f"{episode.name}: the picture of {topic} at {format_time(time)} is not in the "
                "store any more: make the windows again."
            )
        picture = picture_or_none(message)
        if picture is None and not self._holds:
            raise PayloadError(
                f"{episode.name}: the picture of {topic} at {format_time(time)} cannot be "
                "shown, or has no payload. on_gap='hold' shows the one before"
            )
        return picture
