"""What PostgreSQL and SQLite are asked in the same words, as their indexes want them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from benchmarks.questions.base import ARM, GRIPPER, VIEWPOINT, Asker, Reading, sums

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray


class Sql:
    """A connection, and how its system writes a field, a table and a value."""

    mark: ClassVar[str] = "?"
    column: ClassVar[str]

    @abstractmethod
    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """What a query answers."""

    @abstractmethod
    def field(self, path: str, table: str = "") -> str:
        """The expression of a field, as the indexes have it."""

    @abstractmethod
    def name(self, topic: str) -> str:
        """Quoted name of the table of a topic."""

    @property
    def time(self) -> str:
        """Expression of a row's time."""
        return self.field("_meta.t")

    def number(self, query: str, values: Sequence[object] = ()) -> int:
        """The one number that a query answers."""
        return int(self.rows(query, values)[0][0])

    def count(self, topic: str, condition: str) -> int:
        """How many rows of a topic fulfil a condition."""
        return self.number(f"SELECT COUNT(*) FROM {self.name(topic)} WHERE {condition}")


class SqlAsker(Sql, Asker):
    """All questions; systems replace those for which they have other words."""

    front: ClassVar[str] = ""
    """Before the viewpoint's x in Q4."""

    def closings(self) -> int:
        return self.count(GRIPPER, f"{self.field('position')} = 0")

    def behind(self) -> int:
        return self.count(VIEWPOINT, f"{self.field('position.x')} <= 0")

    def in_region(self) -> int:
        x, y, z = (self.field(f"pose.position.{axis}") for axis in "xyz")
        return self.count(ARM, f"{z} > 1 AND {y} > -0.5 AND {y} < 0.5 AND {x} > 0.5 AND {x} < 1")

    def grasps(self, half_ns: int) -> int:
        mine, theirs = self.field("_meta.t", "a"), self.field("_meta.t", "b")
        return self.number(
            f"SELECT COUNT(*) FROM {self.name(GRIPPER)} a "
            f"WHERE {self.field('position', 'a')} = 0 AND EXISTS ("
            f"SELECT 1 FROM {self.name(VIEWPOINT)} b "
            f"WHERE {theirs} > {mine} - {self.mark} AND {theirs} < {mine} + {self.mark} "
            f"AND {self.front}{self.field('position.x', 'b')} >= 0)",
            [half_ns, half_ns],
        )

    def positions(self) -> list[float]:
        x, y, z = (self.field(f"position.{axis}") for axis in "xyz")
        query = f"SELECT {x}, {y}, {z} FROM {self.name(VIEWPOINT)} WHERE {x} <= 0"
        return sums(self.rows(query))


class SqlReading(Sql, Reading):
    """By the expression of the time, on which an indexed system has an index."""

    ranges: ClassVar[str]
    """Expression of the ranges of a scan, or of a message that has them."""

    @abstractmethod
    def loaded(self, value: Any) -> dict[str, Any]:
        """A row's message."""

    def loaded_ranges(self, value: Any) -> Any:
        """Ranges, from what `ranges` gives."""
        return self.loaded(value)["ranges"]

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        within = f"{self.time} >= {self.mark} AND {self.time} < {self.mark} ORDER BY {self.time}"
        return self._ranges(topic, within, [begin, end])

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        until = f"{self.time} <= {self.mark} ORDER BY {self.time} DESC LIMIT 1"
        found: NDArray[np.float32] = self._ranges(topic, until, [time])[0]
        return found

    def table(self, topic: str) -> pd.DataFrame:
        import pandas as pd

        query = f"SELECT {self.column} FROM {self.name(topic)} ORDER BY {self.time}"
        return pd.json_normalize([self.loaded(row[0]) for row in self.rows(query)])

    def _ranges(self, topic: str, condition: str, values: Sequence[object]) -> NDArray[np.float32]:
        query = f"SELECT {self.ranges} FROM {self.name(topic)} WHERE {condition}"
        rows = self.rows(query, values)
        return np.array([self.loaded_ranges(row[0]) for row in rows], np.float32)
