"""Times below 1970, and those up to the last nanosecond of 64 bits."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from rosbags.typesys import Stores, get_typestore

import hybridlog as hl
from hybridlog.query.query import Query
from hybridlog_storage.messages import Channel
from hybridlog_storage.times import END, span_of
from tests.odd_messages import ros_channel
from tests.query.test_engines import WAYS, only

SECOND = 10**9
STAMPS = [
    -2_145_916_800 * SECOND,
    -SECOND - 1,
    -1,
    0,
    SECOND,
    None,
]  # from 1902 on; zero is not set
STATE = Channel("/state", "json", None)
POINT = ros_channel("/point", "geometry_msgs/msg/PointStamped", 2)
LATE = [END - 1000, END - 1000, END - 1, END, END]


def _stamped() -> Iterator[bytes]:
    types = get_typestore(Stores.ROS2_HUMBLE)
    header, time = types.types["std_msgs/msg/Header"], types.types["builtin_interfaces/msg/Time"]
    kind = types.types["geometry_msgs/msg/PointStamped"]
    point = types.types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0)
    for stamp in STAMPS:
        if stamp is None:
            yield b"\x00\x01\x00\x00"  # a message that is cut off has no stamp
        else:
            sec, nanosec = divmod(stamp, SECOND)
            message = kind(
                header=header(stamp=time(sec=sec, nanosec=nanosec), frame_id=""), point=point
            )
            yield bytes(types.serialize_cdr(message, "geometry_msgs/msg/PointStamped"))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("ends") / "store", create=True) as opened:
        for name, times in (("late", LATE), ("last", [END])):
            with opened.start(name) as recording:
                for number, time in enumerate(times):
                    said = json.dumps({"v": number}).encode()
                    recording.write(STATE, said, log_time=time, publish_time=time)
        with opened.start("stamps") as recording:
            for number, raw in enumerate(_stamped()):
                at = 1_700_000_000 * SECOND + number
                recording.write(POINT, raw, log_time=at, publish_time=0)
        yield opened


def _late(store: hl.Store, name: str = "late") -> Query:
    return store.topic("/state").in_recording(name)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("clock", ["log", "publish"])
@pytest.mark.parametrize("condition", [None, "v >= 0"])
def test_the_last_time_is_in_ranges_without_an_end(
    store: hl.Store, way: str, clock: str, condition: str | None
) -> None:
    with only(way):
        for name, begin, end, wanted in (
            ("late", "start", "end", 5),
            ("late", END - 1000, None, 5),
            ("late", END - 999, None, 3),
            ("late", END - 1000, END - 1, 2),
            ("late", END - 1, None, 3),
            ("late", 0, END, 5),
            ("last", "start", "end", 1),
            ("last", END - 5, None, 1),
        ):
            query = _late(store, name).between(begin, end).clock(clock)
            if condition is not None:
                query = query.where(condition)
            assert query.count() == len(list(query)) == wanted, (name, begin, end)
            assert query.to_arrow().num_rows == wanted
            assert next(m.log_time_ns for m in query.reverse()) >= END - 1000


def test_answers_about_the_last_time(store: hl.Store) -> None:
    query = _late(store)
    assert [one.messages for one in query.check()] == [5]
    assert [one.messages for one in _late(store, "last").check()] == [1]
    gaps = query.gaps(longer_than="10ns")
    assert [(gap.begin_ns, gap.end_ns) for gap in gaps] == [(END - 1000, END - 1)]
    changes = query.changes("v", pause="1ns")
    assert [(c.begin_ns, c.end_ns, c.messages) for c in changes] == [
        (END - 1000, END - 999, 1),
        (END - 1, END, 3),
    ]
    assert query.at(END).fields == {"v": 4}
    assert query.at(END - 2).fields == {"v": 1}
    assert query.where("v == 4").at(END).fields == {"v": 4}
    assert query.stats("v")[0].count == 5
    assert query.fields("v").resample("500ns").to_arrow()["v"].to_pylist() == [1, 1]
    windows_around = query.windows("2ns", "2ns")
    assert len(windows_around) == 5
    assert query.during(windows_around).count() == 5
    assert store.align(query, query).to_arrow().num_rows == 5
    assert span_of(END, END) == (END - 1, END)


@pytest.mark.parametrize("way", WAYS)
def test_header_stamps_before_1970(store: hl.Store, way: str) -> None:
    with only(way):
        query = store.topic("/point").in_recording("stamps")
        for begin, end, wanted in (
            ("start", "end", 4),
            (-SECOND - 1, 1, 2),
            (-(10**19) // 2, 0, 3),
            ("1969-12-31T23:59:58Z", "1970-01-01", 2),
            ("1902-01-01", "1902-01-02", 1),
            ("1969-12-31T23:59:58.999999999Z", None, 3),
            (-1.5, 0.5, 2),
            (None, -1, 2),
            (0, None, 1),
            ("start", "+1ns", 1),
            ("-1s", "end", 1),
            ("-1000000001ns", "end", 1),
        ):
            found = query.between(begin, end).clock("header")
            assert found.count() == len(list(found)) == wanted, (begin, end)
        assert query.where('header.stamp < t"1970-01-01"').count() == 3
        assert query.where('header.stamp >= t"1969-12-31T23:59:58Z"').count() == 4
        assert query.where("header.stamp < -1").count() == 2
