"""Questions to hybridlog in its own words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.questions.base import ARM, GRIPPER, VIEWPOINT, Asker, Reading

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from benchmarks.backends.base import Backend
    from hybridlog.store import Store


class _Stored:
    """The backend's store."""

    store: Store

    def start(self, backend: Backend) -> None:
        from benchmarks.backends.hybridlog_store import Hybridlog

        assert isinstance(backend, Hybridlog)
        self.store = backend.store


class HybridlogAsker(_Stored, Asker):
    """One chain of calls a question; Q4 is a join by time."""

    def closings(self) -> int:
        return self.store.topic(GRIPPER).where("position == 0").count()

    def behind(self) -> int:
        return self.store.topic(VIEWPOINT).where("position.x <= 0").count()

    def positions(self) -> list[float]:
        axes = [f"position.{axis}" for axis in "xyz"]
        frame = self.store.topic(VIEWPOINT).where("position.x <= 0").fields(*axes).to_pandas()
        return [float(len(frame)), *map(float, frame[axes].sum())]

    def in_region(self) -> int:
        region = (
            "pose.position.z > 1 and -0.5 < pose.position.y < 0.5 and 0.5 < pose.position.x < 1"
        )
        return self.store.topic(ARM).where(region).count()

    def grasps(self, half_ns: int) -> int:
        closings = (
            self.store.topic(GRIPPER).where("position == 0").windows(f"{half_ns}ns", f"{half_ns}ns")
        )
        in_front = self.store.topic(VIEWPOINT).where("position.x >= 0")
        return len(closings.containing(in_front))


class HybridlogReading(_Stored, Reading):
    """Through the index of chunks."""

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        query = self.store.topic(topic).between(f"{begin}ns", f"{end}ns").fields("ranges")
        return np.stack(list(query.to_pandas()["ranges"]))

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        found: NDArray[np.float32] = self.store.topic(topic).at(f"{time}ns").decode().ranges
        return found

    def table(self, topic: str) -> pd.DataFrame:
        return self.store.topic(topic).to_pandas()
