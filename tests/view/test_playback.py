"""Playback over the Foxglove WebSocket protocol, as a viewer sees it."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hybridlog_storage.errors import TimeError
from tests import places

pytest.importorskip("websockets", reason="websockets is not installed: no playback is tested")

from websockets.exceptions import InvalidStatus

import hybridlog as hl
from hybridlog.view.playback import PlayedLog
from hybridlog_storage.messages import Channel, Schema
from tests.independent import Seen, read_mcap, write_mcap
from tests.limits import Limit
from tests.view.viewer import SDK, WEBSOCKET, Data, State, Time, Viewer, served

S = 10**9
BEGIN = 1_700_000_000 * S
LATER = BEGIN + 30 * 86400 * S
TEXT = b"string data\n"


def write_log(path: Path, begin: int, seconds: int = 3) -> Path:
    """A log with latched and many-published topics, several encodings, and equal times."""
    text = Schema("std_msgs/String", "ros1msg", TEXT)
    proto = Channel("/proto", "protobuf", Schema("a.B", "protobuf", b"\n\x00\xff\xfe"))
    odd = Channel("/odd", "ros1", Schema("pkg/Odd", "ros1msg", b"string data # \xff\n"))
    latched = Channel("/map", "ros1", text, {"callerid": "/server", "latching": "1"})
    tf_a, tf_b = (Channel("/tf", "ros1", text, {"callerid": f"/{n}"}) for n in "ab")
    counted, bare = Channel("/n", "json", None), Channel("/bare", "cdr", None)
    silent = Channel("/silent", "json", None)
    said = [(latched, begin, b"\x03\x00\x00\x00map")]
    for n in range(seconds * 100):
        time = begin + n * S // 100
        said.append((counted, time, b'{"n": %d}' % n))
        said.append((tf_a, time, b"\x01\x00\x00\x00a"))
        said.append((tf_b, time, b"\x01\x00\x00\x00b"))
        if n % 100 == 50:
            said.append((proto, time, b"\x08" + bytes([n % 128])))
            said.append((bare, time, b"\x00\x01\x00\x00" + bytes([n % 128])))
            said.append((odd, time, b"\x01\x00\x00\x00o"))
    every = (latched, tf_a, tf_b, counted, proto, odd, bare, silent)
    return write_mcap(path, said, every, chunk_size=2000)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("played")
    write_log(directory / "one.mcap", BEGIN)
    write_log(directory / "two.mcap", LATER)
    return directory


@pytest.fixture(scope="module")
def store(logs: Path) -> Iterator[hl.Store]:
    with hl.open(logs / "store", create=True) as opened:
        for name in ("one", "two"):
            opened.record(logs / f"{name}.mcap")
        yield opened


@pytest.fixture(scope="module")
def one(store: hl.Store) -> PlayedLog:
    return PlayedLog(store.all_topics().in_recording("one"))


@pytest.fixture(scope="module")
def seen(logs: Path) -> list[Seen]:
    return read_mcap(logs / "one.mcap")


@contextmanager
def recorded(path: Path, messages: Iterable[tuple[str, int, bytes]]) -> Iterator[PlayedLog]:
    """A log of topics, times and payloads."""
    with hl.open(path / "store", create=True) as opened:
        with opened.start("log") as recording:
            for topic, log_time, payload in messages:
                recording.write(Channel(topic, "json", None), payload, log_time=log_time)
        yield PlayedLog(opened.all_topics())


def data(found: list[Any]) -> list[Data]:
    return [each for each in found if isinstance(each, Data)]


def test_every_message_comes_once_in_order_and_as_it_was(one: PlayedLog, seen: list[Seen]) -> None:
    with served(one) as url, Viewer(url) as viewer:
        assert viewer.connection.subprotocol == SDK
        assert viewer.info["capabilities"] == ["playbackControl", "time"]
        assert viewer.info["dataStartTime"] == {"sec": BEGIN // S, "nsec": 0}
        assert viewer.info["dataEndTime"] == {"sec": BEGIN // S + 2, "nsec": 990_000_000}
        assert viewer.first_state == State("paused", BEGIN, 100.0, False, b"")
        viewer.subscribe()
        found = viewer.until_end()
    assert [m.time for m in found] == sorted(m.time for m in found)
    for topic in ("/map", "/tf", "/n", "/proto", "/odd", "/bare"):
        wanted = [m for m in seen if m.topic == topic]
        assert [Seen(*m) for m in found if m.topic == topic] == wanted, topic
    assert len(found) == len(seen)


def test_a_seek_shows_what_is_current_and_then_plays_on(one: PlayedLog, seen: list[Seen]) -> None:
    there = BEGIN + 2 * S
    with served(one) as url, Viewer(url) as viewer:
        viewer.control(plays=False)
        viewer.subscribe()
        assert [Seen(*m) for m in data(viewer.quiet())] == [m for m in seen if m.log_time == BEGIN]
        assert viewer.control(plays=False, seek=there) == State("paused", there, 1.0, True, b"id")
        shown = viewer.quiet()
        assert shown[0] == Time(there)
        before = [m for m in data(shown) if m.time < there]
        last = {}
        for message in seen:
            if message.log_time < there:
                last[message.topic] = message
        assert {Seen(*m) for m in before} == set(last.values())
        now = [m for m in data(shown) if m.time >= there]
        assert [Seen(*m) for m in now] == [m for m in seen if m.log_time == there]
        assert viewer.control(plays=True, speed=100).status == "playing"
        rest = viewer.until_end()
        assert [Seen(*m) for m in rest] == [m for m in seen if m.log_time > there]
        # At the end, only a seek goes on.
        assert viewer.control(plays=True).status == "ended"
        assert viewer.control(plays=True, speed=100, seek=0).time == BEGIN
        assert [Seen(*m) for m in viewer.until_end()] == seen


def test_pause_and_speed(one: PlayedLog) -> None:
    with served(one) as url, Viewer(url) as viewer:
        viewer.control(plays=False)
        viewer.subscribe("/n")
        assert viewer.control(plays=True, speed=0.0).speed == pytest.approx(0.01)
        paused = viewer.control(plays=False, speed=math.nan)
        assert (paused.status, paused.speed) == ("paused", pytest.approx(0.01))
        assert paused.time < BEGIN + S
        viewer.quiet()
        assert viewer.control(plays=False, speed=math.inf).speed == 100
        assert viewer.quiet() == [], "time stands still"
        assert viewer.control(plays=False, seek=2**63).time == one.end


def test_subscriptions_may_change_while_it_plays(one: PlayedLog, seen: list[Seen]) -> None:
    """Others that come and go neither double nor lose messages of a topic that stays."""
    with served(one, speed=10.0) as url, Viewer(url) as viewer, Viewer(url) as other:
        other.control(plays=False)  # each viewer has a playback of its own
        viewer.subscribe("/tf")
        found: list[Data] = []
        for _ in range(6):
            viewer.subscribe("/n")
            count = len(found)
            while all(m.topic != "/n" for m in found[count:]):
                found += data([viewer.read()])
            viewer.unsubscribe("/n")
        found += viewer.until_end()
    assert [Seen(*m) for m in found if m.topic == "/tf"] == [m for m in seen if m.topic == "/tf"]


def test_messages_of_the_same_time_stay_together(tmp_path: Path, limit: Limit) -> None:
    """A request that comes in the middle of them waits: behind it, all later ones are read."""
    limit(playback_sent=1)
    same = [("/same", BEGIN, b"%d" % n) for n in range(3000)]
    with recorded(tmp_path, [*same, ("/other", BEGIN + S, b"{}")]) as log:
        with served(log) as url, Viewer(url) as viewer:
            viewer.subscribe("/same")
            while not isinstance(first := viewer.read(), Data):
                pass
            viewer.subscribe("/other")
            found = [first, *viewer.until_end()]
    assert [int(m.payload) for m in found if m.topic == "/same"] == list(range(3000))


def test_a_slow_viewer_loses_nothing(tmp_path: Path) -> None:
    """The log time waits for it: with 64 MB in a third of a second, anything else would drop."""
    size, count = 1 << 20, 64
    big = [("/big", BEGIN + n * S // 10, bytes([n]) * size) for n in range(count)]
    with recorded(tmp_path, big) as log:
        with served(log, speed=20.0) as url, Viewer(url, small_buffers=True) as viewer:
            viewer.subscribe()
            viewer.until(State, status="playing")
            found: list[int] = []

            def read(until: int) -> None:
                while len(found) < until:
                    one = viewer.read()
                    if isinstance(one, Time):
                        # What is under way fits into the buffers of the two sockets.
                        assert one.time < BEGIN + (len(found) + 24) * S // 10
                    elif isinstance(one, Data):
                        found.append(one.payload[0])

            read(5)
            time.sleep(0.5)  # of the viewer, as when it draws; longer than the whole log
            read(10)
            viewer.ask(plays=False)
            while not isinstance(state := viewer.read(), State):
                if isinstance(state, Data):
                    found.append(state.payload[0])
            assert state.time < log.end - S // 2, "it stops where it is"
            viewer.ask(plays=True, speed=100)
            read(count)
            assert found == list(range(count))


def test_recordings_follow_one_another_at_once(store: hl.Store, logs: Path) -> None:
    log = PlayedLog(store.topic("/n", "/map"))
    assert (log.begin, log.end) == (BEGIN, LATER + 2_990_000_000)
    wanted = [m for n in ("one", "two") for m in read_mcap(logs / f"{n}.mcap")]
    with served(log) as url, Viewer(url) as viewer:
        viewer.subscribe()
        found: list[Data] = []
        while not (isinstance(each := viewer.read(), State) and each.status == "ended"):
            if isinstance(each, Data):
                found.append(each)
            elif isinstance(each, Time):
                assert not BEGIN + 600 * S < each.time < LATER
        assert [Seen(*m) for m in found] == [m for m in wanted if m.topic in {"/n", "/map"}]


def test_the_older_protocol_has_no_playback_control(one: PlayedLog, seen: list[Seen]) -> None:
    """Its clients take a message that they do not know for an error, so none is sent."""
    with served(one) as url, Viewer(url, protocols=[WEBSOCKET]) as viewer:
        assert viewer.connection.subprotocol == WEBSOCKET
        viewer.subscribe()
        found, until = viewer.quiet(0.5), time.monotonic() + 60
        while len(data(found)) < len(seen) and time.monotonic() < until:  # a busy machine stops
            found += viewer.quiet(0.5)
    assert len(data(found)) == len(seen)
    assert {type(each) for each in found} == {Data, Time}


@pytest.mark.parametrize(
    ("origin", "host", "is_welcome"),
    [
        (None, None, True),
        ("https://app.foxglove.dev", None, True),
        ("http://localhost:8080", "localhost", True),
        ("file://", None, True),
        ("https://viewer.example", None, True),
        ("https://evil.example", None, False),
        ("https://foxglove.dev.evil.example", None, False),
        ("http://app.foxglove.dev", None, False),
        ("http://[", None, False),
        ("null", None, False),
        ("", None, False),
        (None, "evil.example", False),
    ],
)
def test_web_pages(origin: str | None, host: str | None, is_welcome: bool, one: PlayedLog) -> None:
    said: list[str] = []
    with served(one, said, origins=("https://viewer.example",)) as url:
        if is_welcome:
            with Viewer(url, origin=origin, host=host):
                pass
        else:
            with pytest.raises(InvalidStatus) as refused:
                Viewer(url, origin=origin, host=host)
            assert refused.value.response.status_code == 403
    assert len(said) == (origin is not None and not is_welcome)


@pytest.mark.parametrize(
    "request_",
    [
        "",
        "[" * 100_000,
        '{"op": "advertise", "channels": []}',
        '{"op": "subscribe", "subscriptions": [7]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99}]}',
        '{"op": "unsubscribe", "subscriptionIds": ["1"]}',
        b"\x03\x00",
        b"\x03\x07" + bytes(17),
        b"\x03\x00" + bytes(13) + b"\xff\xff\xff\xff",
    ],
)
def test_requests_that_are_none_are_answered(request_: str | bytes, one: PlayedLog) -> None:
    with served(one) as url, Viewer(url) as viewer:
        viewer.connection.send(request_)
        assert viewer.text("status")["level"] == 2
        viewer.subscribe("/proto")
        assert len(viewer.until_end()) == 3


def test_a_damaged_log_is_said(store: hl.Store, tmp_path: Path) -> None:
    copied = tmp_path / "store"
    shutil.copytree(store.directory.path, copied, ignore=shutil.ignore_patterns("mongod*"))
    (segment,) = places.folder(copied, "one").glob("*.mcap")
    said: list[str] = []
    with hl.open(copied) as opened:
        log = PlayedLog(opened.topic("/n").in_recording("one"))
        content = bytearray(segment.read_bytes())
        begin, end = len(content) // 10, len(content) // 2
        content[begin:end] = bytes(end - begin)
        segment.write_bytes(content)
        with served(log, said) as url, Viewer(url) as viewer:
            viewer.subscribe()
            error = None
            while error is None:
                one = viewer.read()
                error = one if isinstance(one, dict) else None
            assert error["level"] == 2
            assert viewer.until(State).status == "paused"
            assert said == [error["message"]]
            viewer.control(plays=True)
            assert viewer.text("status")["level"] == 2, "playing on meets the damage again"


def test_a_client_has_to_speak_the_protocol(one: PlayedLog) -> None:
    with served(one) as url, pytest.raises(InvalidStatus, match="400"):
        Viewer(url, protocols=[])


def test_range_and_predicate(store: hl.Store, seen: list[Seen]) -> None:
    query = store.topic("/n", "/map").in_recording("one").between("+1s", "+2s")
    log = PlayedLog(query)
    assert (log.begin, log.end) == (BEGIN + S, BEGIN + 2 * S - 1)
    with served(log) as url, Viewer(url) as viewer:
        viewer.subscribe()
        found = viewer.until_end()
    # The map is latched, so it is in force; the last /n from before is not.
    wanted = [m for m in seen if m.topic == "/n" and BEGIN + S <= m.log_time < BEGIN + 2 * S]
    assert [Seen(*m) for m in found] == [seen[0], *wanted]
    odd = PlayedLog(store.topic("/n").in_recording("one").where("n >= 290"))
    with served(odd) as url, Viewer(url) as viewer:
        viewer.subscribe()
        assert [json.loads(m.payload)["n"] for m in viewer.until_end()] == [*range(290, 300)]
    with pytest.raises(TimeError, match="Nothing was recorded"):
        PlayedLog(store.topic("/n").between("1999-01-01", "1999-01-02"))
