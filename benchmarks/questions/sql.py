"""What PostgreSQL and SQLite are asked in the same words.

`field` gives the expression of a field by its path, as the indexes have it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

Field: TypeAlias = Callable[[str], str]


def closings(table: str, field: Field) -> str:
    """How often the gripper was closed."""
    return f"SELECT COUNT(*) FROM {table} WHERE {field('position')} = 0"


def behind(table: str, field: Field) -> str:
    """How many viewpoints lie behind the robot."""
    return f"SELECT COUNT(*) FROM {table} WHERE {field('position.x')} <= 0"


def in_region(table: str, field: Field) -> str:
    """How many arm poses lie in the paper's box."""
    x, y, z = (field(f"pose.position.{axis}") for axis in "xyz")
    return (
        f"SELECT COUNT(*) FROM {table} WHERE {z} > 1 "
        f"AND {y} > -0.5 AND {y} < 0.5 AND {x} > 0.5 AND {x} < 1"
    )


def positions(table: str, field: Field) -> str:
    """Coordinates of the viewpoints behind the robot."""
    x, y, z = (field(f"position.{axis}") for axis in "xyz")
    return f"SELECT {x}, {y}, {z} FROM {table} WHERE {x} <= 0"


def changes(table: str, time: str, pose: str) -> str:
    """How many runs of rows there are that each differ from the one before.

    Args:
        table: Quoted.
        time: Expression of a row's time.
        pose: Expression of what must differ.
    """
    return (
        "WITH poses AS (SELECT t, pose, lag(pose) OVER (ORDER BY t) AS last "
        f"FROM (SELECT {time} AS t, {pose} AS pose FROM {table}) AS read), "
        "steps AS (SELECT t, CASE WHEN last IS NOT NULL AND pose <> last THEN 1 ELSE 0 END "
        "AS differs FROM poses), "
        "runs AS (SELECT differs, lag(differs) OVER (ORDER BY t) AS before FROM steps) "
        "SELECT COUNT(*) FROM runs WHERE differs = 1 AND coalesce(before, 0) = 0"
    )


def closed(table: str, time: str, is_closed: str) -> str:
    """Begin and end of each time for which something is closed.

    Args:
        table: Quoted.
        time: Expression of a row's time.
        is_closed: Expression of whether a row closes it, or leaves it closed.
    """
    return (
        "WITH commands AS (SELECT t, closed, lag(closed) OVER (ORDER BY t) AS before "
        f"FROM (SELECT {time} AS t, CASE WHEN {is_closed} THEN 1 ELSE 0 END AS closed "
        f"FROM {table}) AS read), "
        "changes AS (SELECT t, closed, lead(t) OVER (ORDER BY t) AS until FROM commands "
        "WHERE before IS NULL OR closed <> before) "
        "SELECT t, until FROM changes WHERE closed = 1 AND until IS NOT NULL"
    )


def sums(rows: Sequence[tuple[Any, ...]]) -> list[float]:
    """Number of rows, and the sum of each of three columns."""
    columns = np.array(rows, np.float64).reshape(-1, 3).sum(axis=0)
    return [float(len(rows)), *map(float, columns)]
