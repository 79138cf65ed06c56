"""Real logs go in, and come back byte for byte: compared with other people's readers."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import bson
import pytest
from bson.raw_bson import DEFAULT_RAW_BSON_OPTIONS
from mcap.reader import make_reader

import hybridlog as hl
from hybridlog_storage.errors import SourceError
from tests import independent, places
from tests.data import DATA, needs_data

pytestmark = needs_data

WHOLE = [
    *(f"real/{n}" for n in (
        "leg_tracker_stationary.bag",
        "robot_localization_test1.bag",
        "tilt_laser.bag",
        "sick_laser_radar.bag",
        "luminar_pointcloud.bag",
        "pointcloud_4mb.bag",
        "ouster.mcap",
        "compressed_image.bag",
        "auv_ros2.mcap",
        "auv_ros2_db3",
    )),
    *(f"odd/{n}" for n in (
        "example.bag",
        "example-bz2.bag",
        "example-lz4.bag",
        "example-unsorted-chunks.bag",
        "no-messages.bag",
        "empty_msgs.bag",
        "array_test.bag",
        "every_sensor_msg_ros2.mcap",
        "protobuf.mcap",
        "foxglove_log.mcap",
    )),
    *(f"odd/rosbag2/{n}" for n in (
        "topics_and_services.mcap",
        "topics_and_services.db3",
        "talker.mcap",
        "talker_db3",
        "wrong_rmw_test.db3",
        "empty_bag_0.db3",
        "split_mcap",
    )),
]  # fmt: skip
DAMAGED = {
    # name: (source that was damaged, messages that must be read, least places of damage)
    "tilt_trunc60.bag": ("real/tilt_laser.bag", 2469, 1),
    "luminar_lz4_bitflip.bag": ("real/luminar_pointcloud.bag", 14, 1),
    "husky.bag.active": (None, 12303, 0),
    "tilt_chunksize_lie.bag": ("real/tilt_laser.bag", 4093, 0),
    "auv_trunc60.mcap": ("real/auv_ros2.mcap", 11421, 1),
    "auv_no_summary.mcap": ("real/auv_ros2.mcap", 18558, 1),
    "auv_huge_record_len.mcap": ("real/auv_ros2.mcap", 18558, 0),
    "ouster_zstd_bitflip.mcap": ("real/ouster.mcap", 100, 1),
    "lidar_trunc50.db3": (None, 217, 1),
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("real") / "store", create=True) as opened:
        yield opened


def fetched(store: hl.Store, recording: str) -> list[independent.Seen]:
    topics = {c.topic for r in store.recordings() if r.id == recording for c in r.channels}
    if not topics:
        return []
    return [
        independent.Seen(m.topic, m.log_time_ns, m.raw)
        for m in store.query(sorted(topics), [recording])
    ]


@pytest.mark.parametrize("name", WHOLE)
def test_every_message_comes_back(store: hl.Store, name: str) -> None:
    report = store.record(DATA / name, name=name.replace("/", "-"))
    assert not report.damage
    got = fetched(store, report.entry.id)
    want = independent.read(DATA / name)
    assert Counter(got) == Counter(want)
    times = [m.log_time for m in got]
    assert times == sorted(times)
    assert report.entry.messages == len(want)
    by_topic = Counter(m.topic for m in want)
    for topic, count in by_topic.items():
        assert store.query([topic], [report.entry.id]).count() == count


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_logs_give_what_can_be_read(store: hl.Store, name: str) -> None:
    origin, messages, places = DAMAGED[name]
    report = store.record(DATA / "damaged" / name, name=f"damaged-{name}")
    assert report.entry.messages == messages
    assert len(report.damage) >= places
    assert report.entry.status == ("damaged" if places else "complete")
    assert all(damage.reason for damage in report.damage)
    got = Counter(fetched(store, report.entry.id))
    assert got.total() == messages
    if origin is not None:
        assert not got - Counter(independent.read(DATA / origin))


@pytest.mark.parametrize("name", ["odd/empty-file.bag", "damaged/magic_only.bag", "CATALOGUE.md"])
def test_what_is_no_log_leaves_nothing(store: hl.Store, name: str) -> None:
    before = store.directory.ids()
    with pytest.raises(SourceError, match=Path(name).name):
        store.record(DATA / name)
    assert store.directory.ids() == before


def test_segments_pass_the_official_readers(store: hl.Store) -> None:
    assert sorted(r.id for r in store.recordings()) == store.directory.ids()
    for entry in store.recordings():
        counted = 0
        for _, path in places.segments(store.directory.path, entry.id):
            data = path.read_bytes()
            reader = make_reader(io.BytesIO(data), validate_crcs=True)
            counted += sum(1 for _ in reader.iter_messages())
        assert counted == entry.messages
    assert store.verify().findings == []


def dump(store: hl.Store) -> dict[str, list[bytes]]:
    """Everything in the database, as bytes; but for how often it was begun anew."""
    reached = store.shared.index.reached()
    assert reached is not None, store.shared.index.unavailable
    found = {
        name: sorted(
            document.raw
            for raw in reached.each([(name, {})], lambda _: {"$match": {}})
            for document in bson.decode_iter(raw, DEFAULT_RAW_BSON_OPTIONS)
        )
        for name in reached.list_collections()
    }
    for name in ("hybridlog.recordings", "hybridlog.store"):
        documents = [bson.decode(document) for document in found[name]]
        found[name] = [bson.encode({**d, "made": ""}) for d in documents]
    return found


@pytest.mark.mongo
def test_an_index_made_anew_is_the_same(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        for name in ("every_sensor_msg_ros2.mcap", "array_test.bag", "foxglove_log.mcap"):
            report = store.record(DATA / "odd" / name)
            assert report.indexed == report.entry.messages
        before = dump(store)
        assert store.verify().findings == []
        store.index.rebuild()
        assert dump(store) == before
