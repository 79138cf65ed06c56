"""Questions to MongoDB: the paper's appendix A through pymongo, and aggregations."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.questions.base import ARM, GRIPPER, VIEWPOINT, Asker, Reading, sums
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray
    from pymongo.collection import Collection
    from pymongo.database import Database

    from benchmarks.backends.base import Backend

_EPOCH = datetime(1970, 1, 1)  # UTC: so pymongo takes and gives dates


class MongoAsker(Asker):
    """Q1 to Q4 as in the appendix, word for word but for JavaScript's syntax.

    The appendix takes the length of the list of rows that Q4 has looked up, in which a
    closing without a viewpoint has a null; only rows that were found are counted here.
    """

    def start(self, backend: Backend) -> None:
        from benchmarks.backends.mongo import Mongo

        assert isinstance(backend, Mongo)
        self._database: Database[dict[str, Any]] = backend.database

    def closings(self) -> int:
        return self._of(GRIPPER).count_documents({"position": 0.0})

    def behind(self) -> int:
        return self._of(VIEWPOINT).count_documents({"position.x": {"$lte": 0}})

    def positions(self) -> list[float]:
        found = self._of(VIEWPOINT).find({"position.x": {"$lte": 0}}, {"_id": 0, "position": 1})
        return sums([tuple(row["position"][axis] for axis in "xyz") for row in found])

    def in_region(self) -> int:
        return self._of(ARM).count_documents(
            {
                "pose.position.z": {"$gt": 1},
                "pose.position.y": {"$gt": -0.5, "$lt": 0.5},
                "pose.position.x": {"$gt": 0.5, "$lt": 1},
            }
        )

    def grasps(self, half_ns: int) -> int:
        half = timedelta(microseconds=half_ns // 1000)
        viewpoints = self._of(VIEWPOINT)
        found = 0
        for closing in self._of(GRIPPER).find({"position": 0.0}):
            time = closing["_meta"]["inserted_at"]
            row = viewpoints.find_one(
                {
                    "position.x": {"$gte": 0},
                    "_meta.inserted_at": {"$lt": time + half, "$gt": time - half},
                }
            )
            found += row is not None
        return found

    def _of(self, topic: str) -> Collection[dict[str, Any]]:
        return self._database[collection_of(topic)]


class MongoReading(Reading):
    """By `_meta.inserted_at`, which is what the indexes are on."""

    def start(self, backend: Backend) -> None:
        from benchmarks.backends.mongo import Mongo

        assert isinstance(backend, Mongo)
        self._database = backend.database

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        rows = self._database[collection_of(topic)].find(
            {"_meta.inserted_at": {"$gte": _date(begin), "$lt": _date(end)}},
            {"_id": 0, "ranges": 1},
            sort=[("_meta.inserted_at", 1)],
        )
        return np.array([row["ranges"] for row in rows], np.float32)

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        row = self._database[collection_of(topic)].find_one(
            {"_meta.inserted_at": {"$lte": _date(time)}},
            {"_id": 0, "ranges": 1},
            sort=[("_meta.inserted_at", -1)],
        )
        assert row is not None
        return np.array(row["ranges"], np.float32)

    def table(self, topic: str) -> pd.DataFrame:
        import pandas as pd

        rows = self._database[collection_of(topic)].find({}, {"_id": 0})
        frame = pd.json_normalize(list(rows))
        return frame.sort_values("_meta.t", kind="stable")


def _date(time: int) -> datetime:
    return _EPOCH + timedelta(milliseconds=time // 1_000_000)
