"""Where header stamps start again, and that nothing matches across."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.tf.reader import Epochs, epochs_of, found_in
from tests.data import DATA, needs_data
from tests.ros_values import ROS2
from tests.tf.test_tree import BEGIN, S
from tests.tf.test_trees import Said, places, point, recorded, tf

Stamps = tuple[Any, Any]


def seconds(log: Sequence[float], stamps: Sequence[float]) -> Stamps:
    return tuple((np.array(one) * S).astype(np.int64) for one in (log, stamps))  # type: ignore[return-value]


def looped(begin: float = 0, rate: float = 10, length: float = 5, runs: int = 2) -> Stamps:
    """Stamps that go from 1 to `length` again and again, 20 s of log time apart."""
    once = np.arange(1, length, 1 / rate)
    log = np.concatenate([begin + 20 * n + once for n in range(runs)])
    return seconds(log.tolist(), np.tile(once, runs).tolist())


STEADY = seconds(np.arange(0, 60, 0.1).tolist(), np.arange(0, 60, 0.1).tolist())


@pytest.mark.parametrize(
    ("topics", "begins"),
    [
        ([looped(), looped(0.01)], [21]),
        ([looped(runs=4), looped(0.01, runs=4)], [21, 41, 61]),
        ([looped(rate=30)], [21]),
        ([looped(rate=1)], []),  # too few of a sole topic
        ([looped(rate=1), looped(0.01, rate=1)], [21]),
        ([looped(), STEADY], [21]),  # half of them
        ([looped(), STEADY, STEADY], []),
        ([looped(), looped(2.5)], [21]),
        ([STEADY], []),
        ([], []),
    ],
)
def test_rule(topics: list[Stamps], begins: list[float]) -> None:
    assert (found_in(topics) / S).round(3).tolist() == begins


@pytest.mark.parametrize("by", [0.9, 5])
def test_disorder_is_no_epoch(by: float) -> None:
    """Stamps that fall by less than a second, that return, and those of several clocks."""
    time = np.arange(0, 60, 0.1)
    late = time - np.where((time > 30) & (time < 35), by, 0)
    assert not len(found_in([seconds(time.tolist(), late.tolist())] * 2))
    mixed = time - np.where(np.arange(600) % 7 == 3, 1000, 0)
    assert not len(found_in([seconds(time.tolist(), mixed.tolist())] * 2))


def test_one_topic_that_returns_is_disorder_for_all() -> None:
    time = np.arange(0, 60, 0.1)
    falls = seconds(time.tolist(), (time - np.where(time >= 30, 25, 0)).tolist())
    back = seconds(time.tolist(), (time - np.where((time >= 30) & (time < 35), 5, 0)).tolist())
    assert (found_in([falls]) / S).tolist() == [30]
    assert not len(found_in([falls, back]))


def test_stamps_at_the_end_of_time() -> None:
    log = 2**63 - 1 - 20 * S + np.arange(15) * S
    fallen = np.where(np.arange(15) < 12, 1000 * S, 0) + np.arange(15) * S
    assert found_in([(log, fallen)] * 2).tolist() == [log[12]]


@needs_data
@pytest.mark.parametrize("name", ["ouster.mcap", "auv_ros2.mcap"])
def test_logs_of_several_clocks_have_one_epoch(tmp_path: Path, name: str) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        store.record(DATA / "real" / name)
        session = store.snapshot().session
        assert not len(epochs_of(session, store.session.look().summaries[0].id).begins)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    """A bag that was played twice: at the log times of the second, all stamps are 20 s old."""
    messages: list[Said] = []
    for run in range(2):
        at = BEGIN + run * 20 * S
        messages += [("/tf_static", tf("base", "cam", 0, 7), at)] * (not run)
        for n in range(1, 6):
            messages += [("/tf", tf("map", "base", n * S, 100 * run + n), at + n * S)]
            for topic in ("/a", "/b"):
                if (run, topic, n) not in {(0, "/b", 3), (1, "/a", 3)}:
                    said = point("base", n * S + 1000 * (topic == "/b"), 100 * run + n)
                    messages.append((topic, said, at + n * S + 1))
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        recorded(store, "loop", messages)
        yield store


AGAIN = "Header stamps of loop start again at 2023-11-14T22:13:41Z (log time)"


def test_nothing_matches_across(store: hl.Store) -> None:
    sets = store.sync(["/a", "/b"], tolerance="50ms")
    runs = [[1, 2, 4, 5], [101, 102, 104, 105]]
    found = [[m.fields["point"]["x"] for m in one] for one in sets]
    assert found == [[x, x] for run in runs for x in run]
    assert sets.times.max() < 6 * S
    assert AGAIN in " ".join(sets.remarks())
    for how in ("nearest", "asof", "interpolate"):
        rows = store.align("/a", ["/b"], how=how, clock="header")
        pairs = rows.to_arrow().select(["a.point.x", "b.point.x"]).to_pylist()
        assert all(y is None or (x > 50) == (y > 50) for x, y in map(dict.values, pairs))
        assert AGAIN in " ".join(rows.remarks())


@pytest.mark.parametrize(
    ("how", "without", "wanted"),
    [
        ("nearest", [(1, n) for n in range(1, 6)], [1, 2, 3, 4, 5, *[None] * 5]),
        ("interpolate", [(0, 5)], [1, 2, 3, 4, None, 1, 2, 3, 4, 5]),
    ],
)
def test_a_run_that_lacks_messages(
    tmp_path: Path, how: str, without: list[tuple[int, int]], wanted: list[float | None]
) -> None:
    messages: list[Said] = []
    for run in range(2):
        for n in range(1, 6):
            at = BEGIN + run * 20 * S + n * S
            topics = ("/a", "/c") if (run, n) in without else ("/a", "/b", "/c")
            messages += [(topic, point("base", n * S, n), at) for topic in topics]
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        recorded(store, "loop", messages)
        rows = store.align("/a", ["/b"], how=how, clock="header").to_arrow()
        assert rows["b.point.x"].to_pylist() == wanted


def test_transforms_are_of_the_same_run(store: hl.Store) -> None:
    query = store.topic("/a").in_frame("map")
    assert places(query) == [2, 4, 6, 8, 10, 202, 204, 208, 210]
    assert AGAIN in " ".join(query.completeness().sentences)
    assert store.tf().transform("map", "base", 2 * S).translation[0] == 102  # of the last run
    assert store.tf().transform("base", "cam", 2 * S).translation[0] == 7


def test_the_clock_of_a_simulation_decides(tmp_path: Path) -> None:
    """Where `/clock` goes back there is an epoch, whatever the topics do."""
    time = ROS2.types["builtin_interfaces/msg/Time"]
    clock = ROS2.types["rosgraph_msgs/msg/Clock"]
    messages: list[Said] = [("/clock", clock(time(n % 30, 0)), BEGIN + n * S) for n in range(60)]
    messages += [("/a", point("base", n % 30 * S + 1), BEGIN + n * S) for n in range(60)]
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        recorded(store, "sim", messages)
        session = store.snapshot().session
        begins = epochs_of(session, store.session.look().summaries[0].id).begins
        assert begins.tolist() == [BEGIN + 30 * S]


def test_stamps_of_many_epochs_are_apart() -> None:
    log = np.arange(1000, dtype=np.int64)
    epochs = Epochs("x", log[1:])
    assert np.diff(epochs.offsets(log)).min() > 2 * (epochs.apart or 0) - 2 > 10**15
    assert epochs.offsets(log).max() < 2**63 - 2 * 10**18
