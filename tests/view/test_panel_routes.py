"""What panels ask the server for, against the store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from starlette.testclient import TestClient

import hybridlog as hl
from hybridlog.drawing.tree import tree
from hybridlog.query.answers.current import next_time
from hybridlog_storage.errors import TopicError
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.odd_messages import MS, START, write_odd
from tests.view.conftest import Asking

S = 10**9


def got(client: TestClient, page: str, topic: str, recording: str = "odd", /, **asked: Any) -> Any:
    answer = client.get(page, params={"recording": recording, "topic": topic, **asked})
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_the_message_is_the_one_that_the_store_has_at_a_time(
    client: TestClient, demo_store: hl.Store, start: int
) -> None:
    topics = ("/base/scan", "/tf_static", "/rosout", "/camera/front/image_raw")
    for topic in (*topics, "/r_gripper_controller/command"):
        query = demo_store.topic(topic)
        times = query.to_arrow()["log_time"].cast("int64").to_numpy()
        for at in (-S, 0, 51 * MS, 5 * S, int(times[2 % len(times)]) - start, 19 * S, 60 * S):
            found = got(client, "message", topic, "robot", at=at)
            later = times[times > start + at]
            assert found["until"] == (str(later[0] - start) if len(later) else None)
            try:
                wanted = query.at(start + at)
            except TopicError:
                assert found["time"] is None
                assert "tree" not in found
                continue
            assert found["time"] == str(wanted.log_time_ns - start)
            assert (found["seq"], found["type"]) == (wanted.seq, wanted.type)
            assert found["bytes"] == len(wanted.payload)
            assert found["tree"] == tree(wanted)


def test_a_damaged_message_is_told(odd: TestClient) -> None:
    for topic in ("/own", "/loose"):
        found = got(odd, "message", topic, at=6 * S)
        assert found["problem"]
        assert "tree" not in found
        assert found["time"] == str(6 * S)


def test_the_next_time_is_found_in_any_chunk(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    # Late messages, pauses of hours and messages at the same time, in chunks of a few messages.
    steps = rng.choice([0, 0, 1, 10, -5, 1000, 10_000_000], 400)
    times = np.maximum(START + np.cumsum(steps) * MS, START)
    channels = [Channel(name, "json", None) for name in ("/a", "/b")]
    with hl.open(tmp_path / "store", create=True) as store:
        settings = SegmentSettings(chunk_size=1024, segment_size=1 << 16)
        with store.start("late", settings=settings) as recording:
            for n, time in enumerate(times.tolist()):
                recording.write(channels[n % 3 == 0], b'{"n": 1, "text": "x"}', log_time=time)
        entry = store.entry("late")
        own = np.sort(times[np.arange(400) % 3 == 0])
        for moment in {0, *(own[::7] - 1).tolist(), *own[::7].tolist(), *(own[::7] + 1).tolist()}:
            later = own[own >= moment]
            found = next_time(store.session, entry, "/b", moment)
            assert found == (int(later[0]) if len(later) else None)
        assert next_time(store.session, entry, "/c", 0) is None


def test_a_damaged_chunk_is_told(tmp_path: Path, asking: Asking) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        write_odd(store)
    segments = places.files(tmp_path / "store")
    assert segments
    for segment in segments:
        data = bytearray(segment.read_bytes())
        with segment.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        for chunk in summary.chunk_indexes:
            data[chunk.chunk_start_offset + chunk.chunk_length - 1] ^= 1
        segment.chmod(0o644)
        segment.write_bytes(data)
    with hl.open(tmp_path / "store") as store:
        client = asking(store)
        for page, topic, asked in (
            ("message", "/own", {"at": S}),
            ("image", "/own", {"at": S}),
            ("series", "/own", {"field": "id", "begin": 0, "end": 6 * S, "pixels": 10}),
            ("rows", "/rosout", {"at": S, "before": 5, "field": "msg"}),
            ("rows", "/rosout", {"at": S, "after": 5, "field": "msg", "where": "msg ~ 'line'"}),
        ):
            answer = client.get(page, params={"recording": "odd", "topic": topic, **asked})
            assert answer.status_code == 400, page
            assert "damaged" in answer.json()["error"]
        paths = [field["path"] for field in got(client, "fields", "/own")["fields"]]
        assert paths[:5] == ["ok", "id", "ratio", "at", "took"]
