"""Log times by `/clock`."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Iterator

import pytest

import hybridlog as hl
from hybridlog.live.clocks import clock_time
from hybridlog.live.recorder import RecorderOptions, throttle_rule
from hybridlog.query.topics import matcher
from hybridlog.record.losses import Cause
from hybridlog_storage.manifest import Loss
from hybridlog_storage.messages import Channel, Schema
from tests.calls import Calls
from tests.limits import Limit
from tests.live.speaker import Recorded, text, text_channel

SECOND = 1_000_000_000
CLOCK = Channel(
    "/clock",
    "ros1",
    Schema("rosgraph_msgs/Clock", "ros1msg", b"time clock\n"),
    {},
    has_publish_time=False,
)
CHATTER = text_channel()


def clock(seconds: float) -> bytes:
    return struct.pack("<II", int(seconds), round(seconds % 1 * SECOND))


class Simulation(Recorded):
    """A recorder by `/clock`, and what it records from a simulated robot."""

    def __init__(self, store: hl.Store, **options: object) -> None:
        self.store = store
        chosen = RecorderOptions(reserve_bytes=0, use_sim_time=True, derives=False, **options)  # type: ignore[arg-type]
        super().__init__(store, chosen)
        self.now = time.time_ns()

    def tick(self, seconds: float) -> None:
        self.now += 1000
        self.speaker.say(CLOCK, clock(seconds), self.now)

    def say(self, word: str, *, late: int = 0) -> None:
        self.now += 1000
        self.speaker.say(CHATTER, text(word), self.now - late)

    def messages(self, topic: str) -> Iterator[hl.Message]:
        """Messages of a topic in its recording, by log time."""
        self.store.refresh()
        return iter(self.store.query([topic], [self.entry.id]))

    def end(self) -> tuple[list[tuple[str, float]], list[tuple[str | None, str, int, int, int]]]:
        """Words with their log times in seconds, in the order of time, and the ledger."""
        (report,) = self.recorder.stop()
        self.entry = report.entry
        found = self.messages("/chatter") if report.entry.messages else []
        rows = [
            (row["topic"], row["cause"], row["count"], row["from"], row["to"])
            for row in report.entry.losses
        ]
        return [(bytes(m.payload[4:]).decode(), m.log_time_ns / SECOND) for m in found], rows


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A store for all of them."""
    path = tmp_path_factory.mktemp("simulated") / "store"
    with hl.open(path, create=True) as opened:
        yield opened


def test_log_times_are_the_latest_of_the_clock(store: hl.Store) -> None:
    simulation = Simulation(store)
    simulation.say("early")
    simulation.tick(10.5)
    simulation.say("a")
    simulation.say("b")
    simulation.tick(11)
    simulation.say("c")
    simulation.say("before the last tick", late=3500)
    assert simulation.recorder.look().topics[0].silent_s == 0.5  # of simulated time
    found, rows = simulation.end()
    assert found == [
        ("early", 10.5), ("a", 10.5), ("b", 10.5), ("before the last tick", 10.5), ("c", 11)
    ]  # fmt: skip
    assert rows == []
    assert simulation.said == []
    assert simulation.entry.manifest.source.kind == "test, by /clock"
    assert [m.log_time_ns for m in simulation.messages("/clock")] == [10_500_000_000, 11 * SECOND]


def test_a_clock_that_goes_back_takes_log_times_with_it(store: hl.Store) -> None:
    simulation = Simulation(store)
    for lap in range(12):
        simulation.tick(100)
        simulation.say(f"{lap} late")
        simulation.tick(lap)
        simulation.say(f"{lap} early")
    found, rows = simulation.end()
    assert sorted(found) == sorted(
        pair for lap in range(12) for pair in ((f"{lap} late", 100.0), (f"{lap} early", float(lap)))
    )
    assert rows == []
    assert len(simulation.said) == 12
    assert "/clock went back by 100.000 s, to 0.000 s" in simulation.said[0]


def test_a_loss_over_a_jump_is_a_span(store: hl.Store) -> None:
    simulation = Simulation(store)
    simulation.tick(100)
    first = simulation.now
    simulation.say("a")
    simulation.tick(3)
    simulation.speaker.sink.lost(
        Loss(  # type: ignore[union-attr]
            Cause.TRANSPORT, "/chatter", 2, first=first, last=simulation.now
        )
    )
    assert simulation.end()[1] == [("/chatter", "transport", 2, 3 * SECOND, 100 * SECOND)]


def test_what_does_not_fit_before_the_clock_is_in_the_ledger(store: hl.Store) -> None:
    simulation = Simulation(store, budget_bytes=1 << 20)
    for number in range(10):
        simulation.say(f"{number}" * 20_000)
    simulation.speaker.sink.lost(
        Loss(  # type: ignore[union-attr]
            Cause.TRANSPORT, "/chatter", 3, first=simulation.now, last=simulation.now
        )
    )
    simulation.tick(7)
    simulation.say("last")
    state = simulation.recorder.look()
    found, rows = simulation.end()
    assert [word[0] for word, _ in found] == ["0", "1", "2", "3", "4", "5", "l"]
    assert {at for _, at in found} == {7.0}
    assert sorted(row[:3] for row in rows) == [
        ("/chatter", "clock", 4),
        ("/chatter", "transport", 3),
    ]
    assert {t.topic: t.messages for t in state.topics} == {"/chatter": 7, "/clock": 1}


def test_without_a_clock_everything_is_counted_as_lost(store: hl.Store, limit: Limit) -> None:
    limit(clock_wait_s=0)
    simulation = Simulation(store)
    simulation.say("a")
    simulation.say("b")
    simulation.recorder.look()
    assert "waiting for /clock" in simulation.said[0]
    (row,) = simulation.end()[1]
    assert row[:3] == ("/chatter", "clock", 2)
    assert row[3] == simulation.now - 1000


def test_a_clock_that_is_not_wanted_is_recorded_all_the_same(store: hl.Store) -> None:
    simulation = Simulation(store, matcher=matcher(["/chatter"]))
    sink = simulation.speaker.sink
    assert sink is not None
    assert sink.wants("/clock", "rosgraph_msgs/Clock")
    assert not sink.wants("/scan", "")
    sink.topic_came("/clock", "rosgraph_msgs/Clock")
    simulation.tick(5)
    simulation.say("a")
    sink.topic_gone("/clock")
    assert simulation.recorder.silent() == []
    found, rows = simulation.end()
    assert (found, rows) == ([("a", 5.0)], [])
    assert [channel.topic for channel in simulation.entry.channels] == ["/clock", "/chatter"]


def test_marks_and_throttles_go_by_the_clock(store: hl.Store) -> None:
    simulation = Simulation(store, throttles=[throttle_rule("/chatter", "1Hz")])
    for seconds in range(4):
        simulation.tick(seconds)
        for word in "ab":
            simulation.say(word)
    assert simulation.recorder.look().sim_time == 3 * SECOND
    found, rows = simulation.end()
    assert found == [("a", 0.0), ("a", 1.0), ("a", 2.0), ("a", 3.0)]
    assert [row[1:] for row in rows] == [("throttle", 4, 0, 3 * SECOND)]


def test_messages_that_come_while_the_held_ones_are_passed_on_stay_behind_them(
    store: hl.Store, calls: Calls
) -> None:
    simulation = Simulation(store)
    for number in range(3):
        simulation.say(f"held {number}")

    def slow(_: Channel, payload: bytes, **__: int) -> None:
        if payload == text("held 0"):
            other = threading.Thread(target=simulation.say, args=("new",))
            other.start()
            other.join()

    calls(simulation.recorder, "take", slow)
    simulation.tick(1)
    found, _ = simulation.end()
    assert [word for word, _ in found] == ["held 0", "held 1", "held 2", "new"]


@pytest.mark.parametrize(
    ("encoding", "name", "payload", "expected"),
    [
        ("ros1", "rosgraph_msgs/Clock", struct.pack("<II", 3_000_000_000, 5), 3 * 10**18 + 5),
        ("cdr", "rosgraph_msgs/msg/Clock", b"\0\1\0\0" + struct.pack("<iI", 2, 7), 2 * 10**9 + 7),
        ("cdr", "rosgraph_msgs/msg/Clock", b"\0\0\0\0" + struct.pack(">iI", 2, 7), 2 * 10**9 + 7),
        ("cdr", "rosgraph_msgs/msg/Clock", b"\0\1\0\0" + struct.pack("<i", 2), None),
        ("cdr", "rosgraph_msgs/msg/Clock", b"\0\1\0\0" + struct.pack("<iI", -5, 0), None),
        ("cdr", "rosgraph_msgs/msg/Clock", b"", None),
        ("cdr", "builtin_interfaces/msg/Time", b"\0\1\0\0" + bytes(8), None),
        ("json", "rosgraph_msgs/Clock", b"{}", None),
    ],
)
def test_what_a_clock_message_is(
    encoding: str, name: str, payload: bytes, expected: int | None
) -> None:
    channel = Channel("/clock", encoding, Schema(name, "", b""), {}, has_publish_time=False)
    assert clock_time(channel, payload) == expected


def test_a_topic_that_is_no_clock_is_told(store: hl.Store) -> None:
    simulation = Simulation(store)
    simulation.speaker.say(text_channel("/clock"), text("noon"), simulation.now)
    assert "no rosgraph_msgs Clock" in simulation.said[0]
    simulation.end()
