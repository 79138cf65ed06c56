"""Frames by tf2's rules, on logs made for each of them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.tf.tree import FrameTree
from hybridlog_storage.errors import TopicError, TransformError, UsageError
from hybridlog_storage.messages import Channel, Schema

S = 10**9
BEGIN = 1_700_000_000 * S
_NUMBER, _TEXT, _WHOLE = ({"type": kind} for kind in ("number", "string", "integer"))


def _object(**fields: object) -> dict[str, object]:
    return {"type": "object", "properties": fields}


_SCHEMA = json.dumps(
    _object(
        timestamp=_object(sec=_WHOLE, nsec=_WHOLE),
        parent_frame_id=_TEXT,
        child_frame_id=_TEXT,
        translation=_object(**dict.fromkeys("xyz", _NUMBER)),
        rotation=_object(**dict.fromkeys("xyzw", _NUMBER)),
    )
)
MOVING = Channel("/tf", "json", Schema("foxglove.FrameTransform", "jsonschema", _SCHEMA.encode()))
STATIC = Channel(
    "/tf_static", "json", Schema("foxglove.FrameTransform", "jsonschema", _SCHEMA.encode())
)
TURNED = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # a quarter to the left


def said(
    time: float,
    parent: str,
    child: str,
    at: Sequence[float] = (0, 0, 0),
    turned: Sequence[float] = (0, 0, 0, 1),
) -> bytes:
    sec, nsec = divmod(BEGIN + round(time * S), S)
    body: dict[str, Any] = {
        "timestamp": {"sec": sec, "nsec": nsec},
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": dict(zip("xyz", map(float, at), strict=True)),
        "rotation": dict(zip("xyzw", map(float, turned), strict=True)),
    }
    return json.dumps(body).encode()


class Log:
    """A store with one recording of transforms."""

    def __init__(self, store: hl.Store) -> None:
        self.store = store

    def tree(self, *messages: bytes, static: Sequence[bytes] = ()) -> FrameTree:
        name = f"log {len(self.store.session.look().summaries)}"
        with self.store.start(name) as recording:
            for channel, bodies in ((STATIC, static), (MOVING, messages)):
                for n, body in enumerate(bodies):
                    recording.write(channel, body, log_time=BEGIN + n)
        return self.store.tf(name)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Log]:
    path = tmp_path_factory.mktemp("tf") / "store"
    with hl.open(path, create=True, mongo="none") as store:
        yield Log(store)


def at(*seconds: float) -> np.ndarray[Any, np.dtype[np.int64]]:
    return np.array([BEGIN + round(one * S) for one in seconds], np.int64)


def test_between_two_transforms(log: Log) -> None:
    """Translation straight, rotation the shorter way, whatever the sign of the quaternion."""
    tree = log.tree(
        said(0, "odom", "base", (0, 0, 0)),
        said(1, "odom", "base", (4, 0, 2), tuple(-one for one in TURNED)),
    )
    found = tree.lookup("odom", "base", at(0, 0.25, 1))
    np.testing.assert_allclose(found.translation, [(0, 0, 0), (1, 0, 0.5), (4, 0, 2)], atol=1e-12)
    np.testing.assert_allclose(found.rpy()[:, 2], np.deg2rad([0, 22.5, 90]), atol=1e-12)
    assert not found.missing


def test_points_go_from_source_to_target(log: Log) -> None:
    tree = log.tree(
        said(0, "/odom", "/base", (10, 0, 0), TURNED),
        static=[said(0, "base", "laser", (1, 0, 0))],
    )
    found = tree.transform("odom", "laser", BEGIN)
    np.testing.assert_allclose(found.apply([2, 0, 0]), (10, 3, 0), atol=1e-12)
    back = tree.transform("laser", "/odom", BEGIN)
    np.testing.assert_allclose(back.apply([10, 3, 0]), (2, 0, 0), atol=1e-12)
    np.testing.assert_allclose(found.matrix() @ back.matrix(), np.eye(4), atol=1e-12)
    same = tree.lookup("laser", "laser", at(-100, 0))
    assert same.is_known.all()


def test_there_is_no_transform_outside(log: Log) -> None:
    tree = log.tree(said(1, "odom", "base"), said(3, "odom", "base", (2, 0, 0)))
    times = at(0.999999999, 1, 3, 3.000000001)
    found = tree.lookup("odom", "base", times)
    assert found.is_known.tolist() == [False, True, True, False]
    assert sorted(found.missing.values()) == [1, 1]
    with pytest.raises(TransformError, match="after the last transform of base, 2023"):
        tree.transform("odom", "base", int(times[-1]))
    for odd in ([1_700_000_001.5], ["+1s"], [object()]):
        with pytest.raises(UsageError, match="whole nanoseconds"):
            tree.lookup("odom", "base", odd)


def test_a_frame_that_changes_its_parent(log: Log) -> None:
    """Its latest transform names the parent; a new one begins anew."""
    tree = log.tree(
        said(0, "map", "shelf", (5, 0, 0)),
        said(9, "map", "shelf", (5, 0, 0)),
        said(0, "map", "robot"),
        said(9, "map", "robot", (9, 0, 0)),
        said(0, "shelf", "box", (0, 1, 0)),
        said(4, "robot", "box", (0, 2, 0)),
        said(9, "robot", "box", (0, 2, 0)),
    )
    found = tree.lookup("map", "box", at(0, 3.9, 4, 6))
    np.testing.assert_allclose(
        found.translation, [(5, 1, 0), (5, 1, 0), (4, 2, 0), (6, 2, 0)], atol=1e-12
    )
    assert "box has several parents: shelf and robot." in " ".join(tree.problems()).replace(
        ", ", " and "
    )


def test_loops_and_several_trees(log: Log) -> None:
    tree = log.tree(
        said(0, "a", "b"), said(0, "b", "c"), said(0, "c", "a"), said(0, "world", "else")
    )
    assert sorted(tree.names) == ["a", "b", "c", "else", "world"]
    assert tree.lookup("a", "c", at(0)).is_known.all()
    found = tree.lookup("else", "c", at(0, 1))
    assert found.missing == {"no way between c and else": 2}
    with pytest.raises(TransformError, match="no way between c and else"):
        tree.transform("else", "c", BEGIN)
    with pytest.raises(TransformError, match="no way"):
        tree.latest("else", "c")


def test_what_is_no_transform_is_left_out_and_counted(log: Log) -> None:
    tree = log.tree(
        said(0, "a", "b"),
        said(0, "a", "b", (9, 9, 9)),
        said(0, "a", "a"),
        said(0, "", "b"),
        said(1, "a", "b", turned=(0, 0, 0, 0)),
        said(2, "a", "b", turned=(0, 0, 0, 1.005)),
        said(2, "a", "fixed"),
        static=[said(0, "a", "fixed", (1, 0, 0))],
    )
    assert tree.frames["fixed"].is_static
    assert tree.frames["b"].stamps.tolist() == [*at(0, 2)]
    assert tree.frames["b"].poses.translation[0].tolist() == [0, 0, 0]
    assert tree.frames["b"].poses.rotation[1].tolist() == [0, 0, 0, 1]
    assert tree.invalid == {
        "a frame that is its own parent": 1,
        "a frame without a name": 1,
        "a rotation that is no unit quaternion": 1,
        "moving, while fixed is static": 1,
    }


def test_names(log: Log) -> None:
    tree = log.tree(said(0, "a", "b"))
    with pytest.raises(TopicError, match="no frame 'c'; there are a, b"):
        tree.lookup("a", "c", at(0))
    with pytest.raises(TopicError, match="belong to one recording"):
        log.store.tf()


def test_no_transforms(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        with store.start("x") as recording:
            recording.write(Channel("/a", "json", None), b"{}", log_time=1)
        with pytest.raises(TopicError, match="No topic has transforms"):
            store.tf("x")


def test_gaps_and_rates(log: Log) -> None:
    tree = log.tree(*(said(n, "a", "b") for n in (0, 1, 2, 5)))
    one = tree.frames["b"]
    assert one.rate_hz == pytest.approx(0.6)
    assert one.longest_gap() == tuple(at(2, 5))
    rows = tree.to_arrow().to_pylist()
    assert [row["frame"] for row in rows] == ["a", "b"]
    assert rows[1]["longest_gap_ns"] == 3 * S
