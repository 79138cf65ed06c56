"""How regularly topics came, against other readers and numpy."""

from __future__ import annotations

import json
import random
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.query.answers.statistics import TopicCheck
from hybridlog_storage.messages import Channel
from tests import independent
from tests.cli.within import answer as run
from tests.data import DATA, needs_data
from tests.some import EXHAUSTIVE

MS = 10**6
SECOND = 10**9
REAL = ("auv_ros2.mcap", "tilt_laser.bag")
MORE = (
    "sick_laser_radar.bag",
    "ouster.mcap",
    "auv_ros2_db3",
    "leg_tracker_positive_7.bag",
    "robot_localization_test1.bag",
)


def write_mcap(path: Path, messages: dict[str, list[int]], payload: bytes = b"{}") -> Path:
    """JSON messages at some log times, by topic, all topics in one file in order of time."""
    channels = {name: Channel(name, "json", None) for name in messages}
    sent = sorted((time, name) for name, times in messages.items() for time in times)
    said = [(channels[name], time, payload) for time, name in sent]
    return independent.write_mcap(path, said, channels.values())


def recorded(log: Path, folder: Path) -> hl.Store:
    store = hl.open(folder / "store", create=True, mongo="none")
    store.record(log)
    return store


def right(times: list[int], span: tuple[int, int]) -> tuple[object, ...]:
    """Messages, rate, jitter, longest gap, late start and early stop, in plain numpy."""
    at = np.sort(np.array(times, np.int64))
    steps = np.diff(at)
    gap = int(steps.max()) if len(steps) else None
    jitter = float(np.std(steps)) if len(steps) > 1 else None
    rate = len(steps) * 1e9 / int(at[-1] - at[0]) if len(steps) and at[-1] > at[0] else None
    period = float(np.sort(steps)[int(0.9 * (len(steps) - 1))]) if len(steps) else None
    return len(at), rate, jitter, period, gap, int(at[0]) - span[0], span[1] - int(at[-1])


def told(one: TopicCheck) -> tuple[object, ...]:
    periods = one.jitter_ns, one.period_ns
    return one.messages, one.rate_hz, *periods, one.gap_ns, one.late_ns, one.early_ns


@needs_data
@pytest.mark.parametrize("name", [*REAL, *(pytest.param(n, marks=EXHAUSTIVE) for n in MORE)])
def test_topics_of_real_logs(name: str, tmp_path: Path) -> None:
    log = DATA / "real" / name
    times: dict[str, list[int]] = defaultdict(list)
    for message in independent.read(log):
        times[message.topic].append(message.log_time)
    span = min(map(min, times.values())), max(map(max, times.values()))
    with recorded(log, tmp_path) as store:
        found = store.check()
        assert {one.topic for one in found if one.messages} == {*times}
        for one in found:
            assert one.lost == 0
            if one.messages:
                assert told(one) == pytest.approx(right(times[one.topic], span)), one.topic
        begin, end = span[0] + 10 * MS, span[0] + 1_500 * MS
        part = store.all_topics().between("+10ms", "+1500ms").check()
        for one in part:
            inside = [time for time in times[one.topic] if begin <= time < end]
            if inside:
                assert told(one) == pytest.approx(right(inside, (begin, min(end, span[1] + 1) - 1)))
            else:
                assert not one.messages
    badness = [one.silent_periods for one in found]
    assert badness == sorted(badness, reverse=True)


def test_the_worst_topic_comes_first_and_silent_topics_before_all(tmp_path: Path) -> None:
    steady = [SECOND + n * 10 * MS for n in range(301)]
    logs = {
        "/steady": steady,
        "/gap": [t for t in steady if not 2 * SECOND < t < 3 * SECOND],
        "/late": [t for t in steady if t >= 3 * SECOND],
        "/early": [t for t in steady if t <= 1_500 * MS],
        "/once": steady[:1],
        "/never": [],
    }
    with recorded(write_mcap(tmp_path / "log.mcap", logs), tmp_path) as store:
        found = store.check()
    assert [one.topic for one in found[:4]] == ["/never", "/early", "/late", "/gap"]
    assert {one.topic for one in found[5:]} == {"/once"}
    assert [round(one.silent_periods) for one in found[1:]] == [250, 200, 100, 1, 0]
    assert (found[3].gap_ns, found[3].gap_begin_ns) == (SECOND, 2 * SECOND)
    shown = run("check", store=tmp_path / "store").lines
    assert shown[0].split()[:2] == ["topic", "messages"]
    assert [line.split()[0] for line in shown[1:]] == [one.topic for one in found]
    as_json = run("check", "-t", "gap", "--json", store=tmp_path / "store").json
    assert [(row["topic"], row["gap_ns"]) for row in as_json] == [("/gap", SECOND)]


@pytest.mark.parametrize("topics", [1, 20])
def test_the_times_are_read_once_and_no_payload(topics: int, tmp_path: Path) -> None:
    """Gaps read message indexes, of chunks with many topics not once a topic; rates nothing."""
    each = 1000 // topics
    logs = {f"/t{n}": [SECOND + k * MS + n for k in range(each)] for n in range(topics)}
    read = []
    for size in (10, 10_000):
        # Random, so that the stored payloads have that size, too.
        payload = json.dumps({"text": random.Random(size).randbytes(size // 2).hex()}).encode()
        folder = tmp_path / str(size)
        folder.mkdir()
        with recorded(write_mcap(folder / "log.mcap", logs, payload), folder) as store:
            query = store.all_topics()
            assert {one.gap_ns for one in query.check()} == {MS}
            assert query.counters.chunks_read == 0
            # Sixteen bytes a message, some for each chunk and channel; or a column of times.
            assert query.counters.bytes_read < 40 * sum(map(len, logs.values())) + 4000 * topics
            read.append(query.counters.bytes_read)
            query.count()
            assert query.counters.bytes_read == 0
            chunks = sum(store.entry(one.id).chunks for one in store.recordings())
    assert read[1] <= read[0] + 100 * chunks * topics
