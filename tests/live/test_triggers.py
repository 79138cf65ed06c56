"""Triggers: a message that fits marks and pins what is around it."""

from __future__ import annotations

import json
import random
import struct
import time
from collections.abc import Callable
from operator import attrgetter

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.follow import child
from hybridlog.follow.child import Trigger
from hybridlog.live.recorder import RecorderOptions, priority_rule, throttle_rule
from hybridlog.live.recording import LIVE_SETTINGS
from hybridlog.query.topics import matcher
from hybridlog.record.marks import MARKS
from hybridlog_storage.errors import TopicError, UsageError, WhereError
from hybridlog_storage.messages import Channel, Schema
from tests.indexed import misindexed
from tests.live.speaker import Recorded, scan, scan_channel, text, text_channel
from tests.waiting import wait_for

SECOND = 1_000_000_000


def robot(store: hl.Store, *texts: str, before: float = 0, after: float = 0) -> Recorded:
    options = RecorderOptions(
        reserve_bytes=0,
        derives=bool(texts),
        triggers=[*map(Trigger.of, texts)],
        before_s=before,
        after_s=after,
    )
    return Recorded(store, options)


def test_what_is_around_a_trigger_is_marked_and_pinned(store: hl.Store) -> None:
    trigger = "/scan: near >= 10 and near < 11"
    recorded = robot(store, trigger, before=5, after=3)
    start = time.time_ns()
    for second in range(60):
        # `near` is half the number: the trigger is at 20 s and 21 s.
        recorded.speaker.say(scan_channel(), scan(second, 10), start + second * SECOND)
    (report,) = recorded.recorder.stop()
    assert report.entry.messages == 60
    begin, end = start + 15 * SECOND, start + 24 * SECOND
    (pin,) = report.entry.manifest.pins
    assert (pin.first, pin.last, pin.reason) == (begin, end, trigger)
    (mark,) = store.topic(MARKS)
    assert mark.log_time_ns == begin
    assert mark.fields == {"text": trigger, "tags": {"trigger": trigger}, "end": end}
    (said,) = recorded.said
    assert said.startswith(f"{trigger!r} is marked and pinned from ")
    inside = store.topic("/scan").during(store.topic(MARKS).windows())
    assert [m.fields["id"] for m in inside] == [*range(15, 24)]


def test_hits_of_one_name_that_touch_are_one(store: hl.Store) -> None:
    recorded = robot(store, before=2, after=2)
    now, recorder = time.time_ns(), recorded.recorder
    recorded.speaker.say(text_channel(), text("first"), now - 10 * SECOND)
    recorder.fire("bump", now)
    recorder.look()
    assert recorded.said
    for second, name in ((3, "bump"), (5, "fall"), (20, "bump"), (40, "bump")):
        recorder.fire(name, now + second * SECOND)
    assert recorder.look().incidents == 4
    (report,) = recorder.stop()
    spans = [(-2, 5, "bump"), (3, 7, "fall"), (18, 22, "bump"), (38, 42, "bump")]
    pins = [(pin.first, pin.last, pin.reason) for pin in report.entry.manifest.pins]
    marks = [(m.log_time_ns, m.fields["end"], m.fields["text"]) for m in store.topic(MARKS)]
    for found in (pins, marks):
        told = sorted(((a - now) // SECOND, (b - now) // SECOND, name) for a, b, name in found)
        assert told == sorted(spans)
    assert len(recorded.said) == 4


def test_marks_of_a_trigger_begin_no_recording_earlier(store: hl.Store) -> None:
    recorded = robot(store, before=100)
    now = time.time_ns()
    recorded.speaker.say(text_channel(), text("first"), now)
    recorded.recorder.fire("SIGUSR1")
    (report,) = recorded.recorder.stop()
    assert report.entry.manifest.marks[0].time == now
    assert report.entry.manifest.pins[0].first < now


def test_what_a_person_marks_and_pins_is_stored_at_once(store: hl.Store) -> None:
    recorded = robot(store)
    recorded.speaker.say(text_channel(), text("first"))
    name = recorded.mark("slipped", {"wheel": "left"}, 30 * SECOND, 10 * SECOND)
    manifest = store.directory.manifests.read(store.entry(name).id)
    (mark,), (pin,) = manifest.marks, manifest.pins
    assert (mark.text, mark.tags) == ("slipped", {"wheel": "left"})
    assert pin.first is not None
    assert pin.last is not None
    assert (pin.last - pin.first, pin.reason) == (40 * SECOND, "slipped")
    recorded.recorder.stop()


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", UsageError),
        (": x > 1", UsageError),
        ("status > 3", UsageError),
        ("re:(: x", TopicError),
        ("/a: x >", WhereError),
        ("/a: _meta.seq > 1", WhereError),
        ('/a: {"x": 1}', WhereError),
        ("/a: /b: x > 1", WhereError),
    ],
)
def test_a_trigger_that_is_none(text: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        Trigger.of(text)


def test_what_triggers_cannot_read_is_told(store: hl.Store) -> None:
    recorded = robot(store, "/scan: near > 1")
    recorded.speaker.say(scan_channel(), scan(4, 10))
    recorded.speaker.say(scan_channel(), b"no scan")
    recorded.recorder.stop()
    marked, unread = sorted(recorded.said)
    assert "is marked and pinned" in marked
    assert unread == "triggers do not see messages that cannot be read, or lack arrays"


def test_what_names_no_topic_is_told_soon(store: hl.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    options = RecorderOptions(
        reserve_bytes=0,
        derives=False,
        triggers=[Trigger.of("/nowhere: a == 1"), Trigger.of("/scan: near > 1")],
        throttles=[throttle_rule("/cam", "5Hz"), throttle_rule("scan", "500Hz")],
        priorities=[priority_rule("b\udcff", "low")],
        matcher=matcher(["/scan", "/odom"]),
    )
    recorded = Recorded(store, options)
    assert recorded.recorder.wants("/scan", "")
    recorded.speaker.say(scan_channel(), scan(0, 10))
    names = ["'/odom'", "'/cam' of --throttle", "'b\\xff' of --priority"]
    names.append("the trigger '/nowhere: a == 1'")
    assert recorded.recorder.unfitting() == names
    recorded.recorder.look()
    assert not any("fits" in text for text in recorded.said)
    monkeypatch.setattr("hybridlog.live.recorder._FITS_S", 0.0)
    recorded.recorder._looked = recorded.recorder._started - 1
    recorded.recorder.look()
    told = [text for text in recorded.said if "fits" in text]
    assert told == [f"no topic fits {name} so far" for name in names]
    recorded.recorder.stop()


FIRES = {
    "a == 7": [1, 3],
    "a[35] == 7": [3],
    "a != 7": [0, 2],
    "a < 1": [0, 2, 3],
    "a.max >= 7": [1, 3],
    "a.n >= 2": [2, 3],
    "id == 18364758544493064721": [1],
    "id > 18364758544493064721": [2],
}
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
def test_a_trigger_fires_on_whole_and_exact_messages(
    store: hl.Store, channel: Channel, spell: Callable[[int, list[float]], bytes]
) -> None:
    arrays = [[0.5], [7.0], [0.5] * 40, [*[0.5] * 35, 7.0, 8.0]]
    numbers = [1, 18364758544493064721, 18364758544493064722, 2]
    recorded = robot(store, *(f"/wide: {where}" for where in FIRES))
    start = time.time_ns()
    for index, (number, array) in enumerate(zip(numbers, arrays, strict=True)):
        recorded.speaker.say(channel, spell(number, array), start + index * SECOND)
    (report,) = recorded.recorder.stop()
    found: dict[str, list[int]] = {}
    for mark in sorted(report.entry.manifest.marks, key=attrgetter("time")):
        found.setdefault(mark.text, []).append((mark.time - start) // SECOND)
    assert found == {f"/wide: {where}": fires for where, fires in FIRES.items()}


def test_a_follower_that_cannot_work_is_given_up(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child, "_PAUSE_S", 0.0)
    monkeypatch.setattr(child, "_START", "raise SystemExit")
    recorded = robot(store, "/scan")
    wait_for(lambda: recorded.said)
    assert recorded.said == ["triggers are evaluated no more: their process ends again and again"]
    recorded.speaker.say(scan_channel(), scan(0, 10))
    (report,) = recorded.recorder.stop()
    assert (report.entry.messages, report.entry.manifest.marks) == (1, ())


@pytest.mark.mongo
def test_a_follower_that_is_killed_misses_nothing_and_makes_nothing_twice(store: hl.Store) -> None:
    recorded = Recorded(
        store,
        RecorderOptions(
            reserve_bytes=0,
            flush_interval_s=0.2,
            settings=replace(LIVE_SETTINGS, segment_size=1 << 18),
            triggers=[Trigger.of("/scan: id in [1, 9, 19, 25]")],
            before_s=0,
        ),
    )
    follower = recorded.recorder._follower
    noise, start = random.Random(3), time.time_ns()
    for number in range(30):
        payload = struct.pack("<IfI", number, 0, 40_000) + noise.randbytes(40_000)
        recorded.speaker.say(scan_channel(), payload, start + number * SECOND)
        if number in {9, 19}:
            wait_for(lambda: follower.state.indexed > 0 and not recorded.recorder.look().lag)
            assert follower._process is not None
            follower._process.kill()
    (report,) = recorded.recorder.stop()
    times = sorted((mark.time - start) // SECOND for mark in report.entry.manifest.marks)
    assert times == [1, 9, 19, 25]
    assert (report.entry.messages, report.indexed, report.missed) == (30, 30, 0)
    assert sorted(store.topic("/scan").to_arrow()["id"].to_pylist()) == [*range(30)]
    assert store.verify().findings == []
    assert misindexed(store) == {}
