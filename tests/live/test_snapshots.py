"""Snapshot mode: what lies around a trigger is kept, and nothing else."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.live.clocks import MachineClock
from hybridlog.live.control_server import request
from hybridlog.live.recorder import Recorder, RecorderOptions
from hybridlog.live.ring import BufferedMessage, Ring
from hybridlog.live.snapshots import SnapshotOptions, Snapshots, Trigger, _happened, _Watch
from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.to_bool import to_bool
from hybridlog.record.losses import Cause, Loss
from hybridlog.record.marks import MARKS
from hybridlog_storage.errors import TopicError, UsageError, WhereError
from hybridlog_storage.messages import Channel, Schema
from tests.live.speaker import TEXT, Recorded, Speaker, scan, scan_channel, text, text_channel
from tests.waiting import wait_for

SECOND = 1_000_000_000
T = 1_700_000_000 * SECOND
LATCHED = Channel("/map", "ros1", TEXT, {"latching": "1"}, has_publish_time=False)


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 400)), max_size=60),
    st.integers(0, 60),
)
def test_a_ring_is_the_end_of_what_came(steps: list[tuple[int, int]], back: int) -> None:
    ring = Ring(20 * SECOND, 2000)
    came: list[BufferedMessage] = []
    now = T
    channel = text_channel()
    for step, size in steps:
        now += step * SECOND
        came.append(BufferedMessage(channel, bytes(size), now, None, len(came)))
        ring.add(came[-1])
        assert ring.payload_bytes <= 2000
    kept = ring.since(now - back * SECOND)
    # It is the end of what came, without gaps, ...
    whole = [held for held in came if held.log_time >= now - min(back, 20) * SECOND]
    assert kept == whole[len(whole) - len(kept) :]
    # ... and all of it, unless memory did not suffice.
    if len(kept) < len(whole):
        assert ring.is_short
        missing = whole[len(whole) - len(kept) - 1]
        assert sum(len(held.payload) for held in kept) + len(missing.payload) > 0
    if not ring.is_short:
        assert kept == whole


def test_latched_messages_stay_and_stand_in_front() -> None:
    ring = Ring(10 * SECOND, 1 << 20)
    ring.add(BufferedMessage(LATCHED, b"old", T - 100 * SECOND, None, 0))
    ring.add(BufferedMessage(LATCHED, b"map", T, None, 0))
    for second in range(60):
        ring.add(BufferedMessage(text_channel(), b"x", T + second * SECOND, None, 0))
    front, *rest = ring.since(T + 55 * SECOND)
    assert (front.payload, front.log_time, front.publish_time) == (b"map", T + 55 * SECOND, T)
    assert len(rest) == 5
    assert not ring.is_short


def test_what_is_in_force_when_a_snapshot_begins_not_when_it_ends() -> None:
    deep = "- durability: transient_local\n  depth: 2"
    named = Channel("/map", "cdr", TEXT, {"offered_qos_profiles": deep})
    restarted = [Channel("/tf", "ros1", TEXT, {"latching": "1", "callerid": "/n"}) for _ in "ab"]
    ring = Ring(100 * SECOND, 1 << 20)
    for second in range(6):
        ring.add(BufferedMessage(named, b"%d" % second, T + second * SECOND, None, 0))
        ring.add(BufferedMessage(restarted[second % 2], b"tf", T + second * SECOND, None, 0))
    found = [(m.channel.topic, m.payload, m.publish_time) for m in ring.since(T + 3 * SECOND)]
    assert found[:3] == [
        ("/map", b"1", T + SECOND),
        ("/map", b"2", T + 2 * SECOND),
        ("/tf", b"tf", T + 2 * SECOND),
    ]
    assert len(found) == 9


def test_deep_publishers_are_held_in_bounded_memory() -> None:
    keeping_all = "- durability: 1\n  history: 2"
    channel = Channel("/log", "cdr", TEXT, {"offered_qos_profiles": keeping_all})
    ring = Ring(SECOND, 1 << 30)
    for second in range(6):
        ring.add(BufferedMessage(channel, bytes(10 << 20), T + second * SECOND, None, second))
    assert [m.sequence for m in ring.since(T + 6 * SECOND)] == [3, 4, 5]
    ring.add(BufferedMessage(channel, bytes(40 << 20), T + 8 * SECOND, None, 8))
    ring.add(BufferedMessage(channel, b"", T + 10 * SECOND, None, 9))
    assert [m.sequence for m in ring.since(T + 9 * SECOND)] == [8, 9]


class Robot(Recorded):
    def __init__(self, store: hl.Store, snapshots: SnapshotOptions, budget: int = 1 << 20) -> None:
        options = RecorderOptions(
            name="snap", reserve_bytes=0, budget_bytes=budget, snapshots=snapshots
        )
        super().__init__(store, options)

    def until(self, count: int) -> None:
        """Wait until so many snapshots are begun."""
        wait_for(lambda: self.recorder.look().snapshots == count)


def test_before_and_after_a_trigger(store: hl.Store) -> None:
    trigger = Trigger.of("/scan: near >= 10 and near < 10.5")
    robot = Robot(store, SnapshotOptions(60, 5, 3, (trigger,)))
    start = time.time_ns()
    scans, chatter = scan_channel(), text_channel()
    robot.speaker.say(LATCHED, text("map"), start - 1000 * SECOND)
    robot.recorder.lost(Loss("/scan", Cause.TRANSPORT, 4, start + 18 * SECOND, start + 18 * SECOND))
    robot.recorder.look()
    robot.recorder.lost(Loss("/scan", Cause.TRANSPORT, 9, first=start, last=start))
    for second in range(60):
        # `near` is half the number: the trigger is at 20 s.
        robot.speaker.say(scans, scan(second, 10), start + second * SECOND)
        robot.speaker.say(chatter, text(str(second)), start + second * SECOND + 1)
        if second == 20:
            robot.until(1)
    (report,) = robot.recorder.stop()
    assert report.entry.tags["trigger"] == trigger.text
    assert [m.decode().data for m in store.topic("/chatter")] == [str(n) for n in range(15, 23)]
    assert [m.fields["id"] for m in store.topic("/scan")] == list(range(15, 23))
    (latched,) = store.topic("/map")
    assert latched.decode().data == "map"
    assert latched.log_time_ns == start + 15 * SECOND
    # Of what was lost, only what lies in the snapshot.
    assert sum(row["count"] for row in report.entry.end["losses"]) == 4


def test_a_trigger_while_a_snapshot_is_written_prolongs_it(store: hl.Store) -> None:
    robot = Robot(store, SnapshotOptions(60, 1, 5))
    channel = text_channel()
    now = time.time_ns()
    robot.speaker.say(channel, text("0"), now)
    robot.recorder.fire("first")
    robot.until(1)
    robot.recorder.fire("second")
    robot.speaker.say(channel, text("1"), now + 2 * SECOND)
    robot.speaker.say(channel, text("2"), now + 100 * SECOND)  # long after the end of both
    wait_for(lambda: not robot.recorder._target.filled and robot.recorder.look().snapshots == 1)
    robot.recorder.fire("third")
    robot.until(2)
    reports = robot.recorder.stop()
    assert [report.entry.tags["trigger"] for report in reports] == ["first", "third"]
    assert reports[0].entry.messages == 3  # the second trigger has left a mark
    marks = [message.decode() for message in store.topic(MARKS)]
    assert marks == [{"text": "second", "tags": {"trigger": "second"}}]


def test_without_a_trigger_nothing_is_kept(store: hl.Store) -> None:
    robot = Robot(store, SnapshotOptions(60))
    for number in range(10):
        robot.speaker.say(text_channel(), text(str(number)))
    assert robot.recorder.stop() == []
    store.refresh()
    assert store.recordings() == []


def test_a_ring_that_does_not_fit_says_so(store: hl.Store) -> None:
    robot = Robot(store, SnapshotOptions(60))
    now = time.time_ns()
    for number in range(30):
        robot.speaker.say(scan_channel(), scan(number, 100_000), now + number * SECOND)
    robot.recorder.look()
    robot.recorder.look()
    assert [line for line in robot.said if "does not fit into the memory" in line] == robot.said
    assert len(robot.said) == 1
    robot.recorder.stop()


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", UsageError),
        (": x > 1", UsageError),
        ("re:(: x", TopicError),
        ("/a: x >", WhereError),
        ("/a: _meta.seq > 1", WhereError),
    ],
)
def test_a_trigger_that_is_none(text: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        Trigger.of(text)


def test_times_that_make_no_sense() -> None:
    for options in ({"ring_s": 0}, {"ring_s": 5, "before_s": 6}, {"ring_s": 5, "after_s": -1}):
        with pytest.raises(UsageError):
            SnapshotOptions(**options)


def test_everything_is_kept_already(store: hl.Store) -> None:
    recorder = Recorder(store, [Speaker()], RecorderOptions(reserve_bytes=0), print)
    with pytest.raises(UsageError, match="--ring"):
        recorder.fire("now")
    recorder.stop()


def test_a_trigger_that_can_never_fire_is_told(store: hl.Store) -> None:
    texts = ("/scan: nope == 1", '/scan: near == "x"', "/nowhere: a == 1", "/scan: near > 1")
    robot = Robot(store, SnapshotOptions(60, triggers=tuple(map(Trigger.of, texts))))
    for number in range(4):
        robot.speaker.say(scan_channel(), scan(number, 10))
    robot.until(1)
    robot.recorder.stop()
    said = "\n".join(robot.said)
    assert "'/scan: nope == 1' can never fire on /scan: " in said
    assert "there is no field nope" in said
    assert """'/scan: near == "x"' can never fire on /scan: """ in said
    assert "no topic matched the trigger '/nowhere: a == 1'" in said
    assert said.count("near > 1") == 1  # the snapshot itself
    assert said.count("can never fire") == 2


def test_a_trigger_that_can_never_fire_is_told_before_the_first_message(store: hl.Store) -> None:
    wrong, nowhere = "/scan: nope == 1", "/nowhere: a == 1"
    robot = Robot(store, SnapshotOptions(60, triggers=(Trigger.of(wrong),)))
    robot.recorder.expect(scan_channel())
    (line,) = robot.said
    robot.recorder.stop()
    assert "can never fire on /scan" in line
    said: list[str] = []
    snapshots = Snapshots(
        SnapshotOptions(60, triggers=(Trigger.of(nowhere), Trigger.of("/scan"))),
        1 << 20,
        lambda _: pytest.fail("nothing fires"),
        lambda _: None,
        said.append,
        clock=MachineClock(),
        settle_s=0,
    )
    snapshots.look([])
    assert not said
    for _ in range(2):
        snapshots.look(["/scan", "/odom"])
    assert said == [f"no topic matches the trigger {nowhere!r} so far"]
    snapshots.look(["/nowhere"])
    assert snapshots.close() == []
    assert len(said) == 1


WIDE = Schema("test_msgs/Wide", "ros1msg", b"uint64 id\nfloat64[] a\n")


@pytest.mark.parametrize(
    ("channel", "spell"),
    [
        (
            Channel("/wide", "json", None),
            lambda number, a: json.dumps({"id": number, "a": a}).encode(),
        ),
        (
            Channel("/wide", "ros1", WIDE),
            lambda number, a: struct.pack(f"<QI{len(a)}d", number, len(a), *a),
        ),
    ],
)
@pytest.mark.parametrize(
    ("where", "fires"),
    [
        ("a == 7", [1, 3]),
        ("a[35] == 7", [3]),
        ("a != 7", [0, 2]),
        ("a < 1", [0, 2, 3]),
        ("a.max >= 7", [1, 3]),
        ("a.n >= 2", [2, 3]),
        ("id == 18364758544493064721", [1]),
        ("id > 18364758544493064721", [2]),
    ],
)
def test_a_trigger_fires_on_whole_and_exact_messages(
    channel: Channel,
    spell: Callable[[int, list[float]], bytes],
    where: str,
    fires: list[int],
) -> None:
    arrays = [[0.5], [7.0], [0.5] * 40, [*[0.5] * 35, 7.0, 8.0]]
    numbers = [1, 18364758544493064721, 18364758544493064722, 2]
    watches = (_Watch("it", to_bool(parse(where), None), frozenset({"a", "id"})),)
    for index, (number, array) in enumerate(zip(numbers, arrays, strict=True)):
        held = BufferedMessage(channel, spell(number, array), 0, None, 0)
        assert list(_happened(watches, held)) == (["it"] if index in fires else [])


def test_fields_of_the_ring_can_be_watched(store: hl.Store) -> None:
    robot = Robot(store, SnapshotOptions(60))
    now = time.time_ns()
    for number in range(10):
        robot.speaker.say(scan_channel(), scan(number, 10), now + number)

    def asked(**content: object) -> dict[str, object]:
        return request(store.directory.path, robot.recorder.name, "numbers", **content)

    assert asked(topic="/scan", path="near", begin=now + 4) == {
        "n": 6,
        "least": 2.0,
        "mean": 3.25,
        "greatest": 4.5,
    }
    assert asked(topic="/scan", path="data.max", begin=now)["greatest"] == 9
    assert asked(topic="/scan", path="nope", begin=now) == {"n": 0}
    assert asked(topic="/other", path="near", begin=now) == {"n": 0}
    with pytest.raises(UsageError, match="a field needs a topic"):
        asked(topic="/scan", path=5, begin=now)
    robot.recorder.stop()
