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
from mcap.stream_reader import StreamReader

import hybridlog as hl
from hybridlog_storage.errors import SourceError
from tests import independent, places
from tests.data import DATA, needs_data

pytestmark = [needs_data, pytest.mark.mongo]

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
        assert opened.shared.index.reached() is not None, opened.shared.index.unavailable
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
    assert report.missed == 0
    got = fetched(store, report.entry.id)
    want = independent.read(DATA / name)
    assert Counter(got) == Counter(want)
    times = [m.log_time for m in got]
    assert times == sorted(times)
    assert report.entry.messages == report.indexed == len(want)
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
    for damage in report.damage:
        assert damage.reason
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
            list(StreamReader(io.BytesIO(data), validate_crcs=True).records)
            reader = make_reader(io.BytesIO(data), validate_crcs=True)
            counted += sum(1 for _ in reader.iter_messages())
        assert counted == entry.messages


def dump(store: hl.Store) -> dict[str, list[bytes]]:
    """Everything in the database, as bytes; but for how often it was begun anew."""
    assert store.shared.index.reached() is not None
    found = {
        name: sorted(
            document.raw
            for raw in store.shared.index.reached().each([(name, {})], lambda _: {"$match": {}})
            for document in bson.decode_iter(raw, DEFAULT_RAW_BSON_OPTIONS)
        )
        for name in store.shared.index.reached().list_collections()
    }
    for name in ("hybridlog.recordings", "hybridlog.store"):
        documents = [bson.decode(document) for document in found[name]]
        found[name] = [bson.encode({**d, "made": ""}) for d in documents]
    return found


def test_verify_finds_nothing_and_reindex_changes_nothing(store: hl.Store) -> None:
    assert store.verify().findings == []
    before = dump(store)
    assert sum(map(len, before.values())) > 50_000
    store.index.rebuild()
    assert dump(store) == before
