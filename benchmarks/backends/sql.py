"""What PostgreSQL and SQLite have in common: batches, and questions in the same words."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from benchmarks.backends.base import ARM, GRIPPER, HALF_NS, VIEWPOINT, sums
from benchmarks.backends.conversion import DatabaseBackend
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

_BATCH_S = 2.0  # of messages in one transaction, as in the paper
_BATCH_CHARACTERS = 16 << 20  # of JSON, after which it is not put off any longer


def is_due(size: int, since: float) -> bool:
    """Whether a transaction is not put off any longer."""
    return size >= _BATCH_CHARACTERS or time.monotonic() - since >= _BATCH_S


def table_of(topic: str) -> str:
    """Name of the table of a topic, as an SQL identifier: its collection's."""
    return f'"{collection_of(topic)}"'


class SqlBackend(DatabaseBackend):
    """A table a topic, with the messages in one column."""

    mark: ClassVar[str]
    """Where a value stands in a query."""
    column: ClassVar[str]
    ranges: ClassVar[str]
    """Expression of the ranges of a scan, or of a message that has them."""
    front: ClassVar[str] = ""
    """Before the viewpoint's x in Q4."""

    @abstractmethod
    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """What a query answers."""

    @abstractmethod
    def field(self, path: str, table: str = "") -> str:
        """The expression of a field, as the indexes have it: a query uses one for exactly that."""

    @abstractmethod
    def loaded(self, value: Any) -> Any:
        """A message, or what `ranges` gives."""

    def _count(self, topic: str, condition: str) -> int:
        return int(self.rows(f"SELECT COUNT(*) FROM {table_of(topic)} WHERE {condition}")[0][0])

    def closings(self) -> int:
        return self._count(GRIPPER, f"{self.field('position')} = 0")

    def behind(self) -> int:
        return self._count(VIEWPOINT, f"{self.field('position.x')} <= 0")

    def in_region(self) -> int:
        x, y, z = (self.field(f"pose.position.{axis}") for axis in "xyz")
        return self._count(ARM, f"{z} > 1 AND {y} > -0.5 AND {y} < 0.5 AND {x} > 0.5 AND {x} < 1")

    def grasps(self) -> int:
        mine, theirs = self.field("_meta.t", "a"), self.field("_meta.t", "b")
        query = (
            f"SELECT COUNT(*) FROM {table_of(GRIPPER)} a "
            f"WHERE {self.field('position', 'a')} = 0 AND EXISTS ("
            f"SELECT 1 FROM {table_of(VIEWPOINT)} b "
            f"WHERE {theirs} > {mine} - {self.mark} AND {theirs} < {mine} + {self.mark} "
            f"AND {self.front}{self.field('position.x', 'b')} >= 0)"
        )
        return int(self.rows(query, [HALF_NS, HALF_NS])[0][0])

    def positions(self) -> list[float]:
        x, y, z = (self.field(f"position.{axis}") for axis in "xyz")
        query = f"SELECT {x}, {y}, {z} FROM {table_of(VIEWPOINT)} WHERE {x} <= 0"
        return sums(self.rows(query))

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        at = self.field("_meta.t")
        return self._ranges(
            topic, f"{at} >= {self.mark} AND {at} < {self.mark} ORDER BY {at}", begin, end
        )

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        at = self.field("_meta.t")
        until = f"{at} <= {self.mark} ORDER BY {at} DESC LIMIT 1"
        found: NDArray[np.float32] = self._ranges(topic, until, time)[0]
        return found

    def table(self, topic: str) -> pd.DataFrame:
        import pandas as pd

        at = self.field("_meta.t")
        query = f"SELECT {self.column} FROM {table_of(topic)} ORDER BY {at}"
        return pd.json_normalize([self.loaded(row[0]) for row in self.rows(query)])

    def _ranges(self, topic: str, condition: str, *values: int) -> NDArray[np.float32]:
        query = f"SELECT {self.ranges} FROM {table_of(topic)} WHERE {condition}"
        found = [self.loaded(row[0]) for row in self.rows(query, values)]
        whole = [one["ranges"] if isinstance(one, dict) else one for one in found]
        return np.array(whole, np.float32)
