"""Choosing recordings by name, tag, topic, type, time and content, in Python and by command."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import hybridlog as hl
from hybridlog.live import LiveOptions
from hybridlog.query.choice import overlaps
from hybridlog.recordings import Recordings
from hybridlog_storage.errors import (
    TimeError,
    TopicError,
    UsageError,
    WhereError,
)
from hybridlog_storage.messages import Channel, Schema
from tests.cli.running import run
from tests.cli.within import Answer, answer
from tests.every_output import written
from tests.independent import write_mcap
from tests.test_snapshot import summary

DAY = 86_400 * 10**9
START = 20_242 * DAY  # 2025-06-03
SCAN, IMU, ODD = "sensor_msgs/LaserScan", "sensor_msgs/msg/Imu", "acme.robot.Imu"


class Made(NamedTuple):
    """A recording: its name, its tags, and its topics with their type and values of `n`."""

    name: str
    tags: dict[str, str]
    topics: dict[str, tuple[str, list[int]]]


MADE = [
    Made("monday 1", {"robot": "7", "place": "lab"}, {"/scan": (SCAN, [1, 2, 3])}),
    Made("monday 2", {"robot": "8"}, {"/scan": (SCAN, [2, 9]), "/imu": (IMU, [5])}),
    Made("tuesday", {"robot": "7"}, {"/left/scan": (SCAN, [4]), "/odd": (ODD, [1])}),
    Made("run[1]", {}, {"/scan": (SCAN, [0])}),
    Made("run1", {"robot": ""}, {"/imu": (IMU, [6, 7])}),
]
NAMES = ["monday 1", "monday 2", "tuesday", "run[1]", "run1"]


def write(path: Path, day: int, topics: dict[str, tuple[str, list[int]]]) -> None:
    said = []
    for topic, (kind, values) in topics.items():
        channel = Channel(topic, "json", Schema(kind, "jsonschema", b'{"type": "object"}'))
        for number, n in enumerate(values):
            time = START + day * DAY + number * 10**9
            said.append((channel, time, json.dumps({"n": n, "robot": "x"}).encode()))
    write_mcap(path, said)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    path = tmp_path_factory.mktemp("choosing")
    with hl.open(path / "store", create=True) as opened:
        for day, made in enumerate(MADE):
            write(path / "log.mcap", day, made.topics)
            opened.record(path / "log.mcap", name=made.name, tags=made.tags)
        yield opened


def call(store: hl.Store, *words: str) -> Answer:
    return answer(*words, store=store.directory.path, code=None)


CHOSEN: list[tuple[dict[str, Any], list[str]]] = [
    ({}, NAMES),
    ({"name": "monday*"}, ["monday 1", "monday 2"]),
    ({"name": "*[12]"}, ["monday 1", "monday 2", "run1"]),
    ({"name": "run[1]"}, ["run[1]"]),  # a whole name before a glob
    ({"name": "run[12]"}, ["run1"]),
    ({"name": "monday ?"}, ["monday 1", "monday 2"]),
    ({"name": ["tues", "monday 1"]}, ["monday 1", "tuesday"]),
    ({"tag": "robot=7"}, ["monday 1", "tuesday"]),
    ({"tag": "robot"}, ["monday 1", "monday 2", "tuesday", "run1"]),
    ({"tag": "robot="}, ["run1"]),
    ({"tag": ["robot=7", "place"]}, ["monday 1"]),
    ({"tag": {"robot": "8"}}, ["monday 2"]),
    ({"tag": {"robot": None, "place": "lab"}}, ["monday 1"]),
    ({"has": "scan"}, ["monday 1", "monday 2", "tuesday", "run[1]"]),
    ({"has": "/scan"}, ["monday 1", "monday 2", "run[1]"]),
    ({"has": ["scan", "imu"]}, ["monday 2"]),
    ({"has": "re:/(odd|imu)"}, ["monday 2", "tuesday", "run1"]),
    ({"has": "IMU"}, ["monday 2", "run1"]),  # another case, if nothing fits it
    ({"type": "sensor_msgs/Imu"}, ["monday 2", "run1"]),
    ({"type": "sensor_msgs/msg/LaserScan"}, ["monday 1", "monday 2", "tuesday", "run[1]"]),
    ({"type": "Imu"}, ["monday 2", "tuesday", "run1"]),
    ({"type": "acme.*"}, ["tuesday"]),
    ({"type": "sensor_msgs/*", "has": "/odd"}, ["tuesday"]),
    ({"during": ("2025-06-04", "2025-06-06")}, ["monday 2", "tuesday"]),
    ({"during": (START + DAY + 10**9, START + 2 * DAY)}, ["monday 2"]),  # its last message
    ({"during": (START + DAY + 10**9 + 1, START + 2 * DAY + 1)}, ["tuesday"]),
    ({"during": (None, "2025-06-04")}, ["monday 1"]),
    ({"during": ("2025-06-06", "end")}, ["run[1]", "run1"]),
    ({"during": ("start", "now")}, NAMES),
    ({"where": "scan: n > 3"}, ["monday 2", "tuesday"]),
    ({"where": "/scan: n > 3"}, ["monday 2"]),
    ({"where": "**: n = 1"}, ["monday 1", "tuesday"]),
    ({"where": ["scan: n = 2", "imu: n = 5"]}, ["monday 2"]),
    ({"where": "imu"}, ["monday 2", "run1"]),
    ({"tag": "robot=7", "where": "scan: n >= 4"}, ["tuesday"]),
    ({"tag": "robot=9"}, []),
    ({"tag": "colour"}, []),
    ({"has": "/nothing"}, []),
    ({"type": "Image"}, []),
    ({"name": "x*"}, []),
    ({"during": ("2030-01-01", None)}, []),
    ({"where": "scan: n > 99"}, []),
]


@pytest.mark.parametrize(("asked", "names"), CHOSEN, ids=[str(asked) for asked, _ in CHOSEN])
def test_recordings_are_chosen(store: hl.Store, asked: dict[str, Any], names: list[str]) -> None:
    found = store.recordings(**asked)
    assert list(found.names) == names
    assert [entry.name for entry in found] == names
    if names:
        assert found.check() is found
    else:
        with pytest.raises(TopicError, match="There is no recording"):
            found.topic("scan")


@pytest.mark.parametrize(
    ("asked", "error", "words"),
    [
        ({"name": "nobody"}, TopicError, "'nobody' is not in the store. There are: monday 1"),
        ({"name": "mon"}, TopicError, "ambiguous. There are: monday 1, monday 2."),
        ({"tag": "=7"}, UsageError, "KEY=VALUE"),
        ({"has": "re:("}, TopicError, "refused"),
        ({"during": ("+1s", "end")}, TimeError, "absolute, not '[+]1s'"),
        ({"during": ("2025-06-05", "2025-06-04")}, TimeError, "empty"),
        ({"during": "2025-06-04"}, TimeError, "two times"),
        ({"where": ": n > 1"}, UsageError, "TOPIC: PREDICATE"),
        ({"where": "scan: n >"}, WhereError, "expected a value"),
        ({"has": [5]}, UsageError, "takes text"),
    ],
)
def test_a_choice_without_a_meaning_is_refused(
    store: hl.Store, asked: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        store.recordings(**asked)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--tag", "robot=9"), "with the tag robot=9; did you mean robot="),
        (("--tag", "colour"), "with the tag colour; there are place=lab, robot=, robot=7, robot=8"),
        (("-r", "mon*", "--tag", "robot="), "named 'mon*', with the tag robot=; did you mean"),
        (("--has", "imy"), "did you mean /imu?"),
        (("--type", "sensor_msgs/LaserScam"), "did you mean sensor_msgs/LaserScan, "),
        (("--type", "x"), f"there are {ODD}, {SCAN}, {IMU}"),
        (("--during", "2030-01-01", "end"), "with messages from 2030-01-01 to end."),
        (("--with", "/scan: n > 99"), "with a message for which '/scan: n > 99' holds."),
        (("-r", "x*"), "named 'x*'; there are monday 1, monday 2, run1, run[1], tuesday"),
    ],
)
def test_who_chooses_nothing_hears_why(store: hl.Store, words: tuple[str, ...], said: str) -> None:
    done = call(store, "ls", *words)
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("There is no recording ")
    assert said in done.err


def test_all_commands_choose_alike(store: hl.Store) -> None:
    chosen = ["--tag", "robot=7", "--with", "scan: n > 3"]
    assert [one["name"] for one in call(store, "ls", *chosen, "--json").json] == ["tuesday"]
    assert [one["name"] for one in call(store, "info", *chosen, "--json").json] == ["tuesday"]
    assert call(store, "fetch", "-t", "scan", "--count", "-q", *chosen).out == "1\n"
    assert call(store, "intervals", "-t", "scan", "--count", "-q", *chosen).out == "1\n"
    assert call(store, "intervals", "scan", "--changes", "n", "--count", "-q", *chosen).out
    assert "/left/scan" in call(store, "info", "-t", "scan", *chosen).out
    assert "from 1 recording," in call(store, "info", "--losses", *chosen).err
    rows = call(store, "info", "--sizes", "recording", *chosen, "--json").json["rows"]
    assert [row["recording"] for row in rows] == ["tuesday"]
    assert call(store, "verify", *chosen).out.startswith("1 recording,")
    assert call(store, "verify", "--repair", *chosen).out.startswith("1 recording,")
    for command in ("info", "verify", "verify --repair", "rm"):
        assert call(store, *command.split(), "--tag", "robot=9").code == 2
    for command in ("fetch", "intervals", "info --tables -t"):
        assert "robot=9" in call(store, *command.split(), "scan", "--tag", "robot=9").err


@pytest.mark.mongo
def test_the_index_of_chosen_recordings_is_made_anew(store: hl.Store) -> None:
    done = call(store, "index", "rebuild", "--tag", "robot=7", "--with", "scan: n > 3")
    assert len(done.out.splitlines()) == 2
    assert call(store, "index", "rebuild", "--tag", "robot=9").code == 2


def test_names_of_commands_may_be_globs(store: hl.Store) -> None:
    assert call(store, "info", "run[1]", "--json").json[0]["name"] == "run[1]"
    found = call(store, "info", "tues*", "--json").json
    assert [one["name"] for one in found] == ["tuesday"]
    assert call(store, "verify", "mon*", "-r", "run1").out.startswith("3 recordings,")


def test_tags_of_many_are_changed_at_once(store: hl.Store) -> None:
    assert (
        call(store, "tag", "run*", "by=hand").out
        == "run[1]: by=hand\nrun1: by=hand\nrun1: robot=\n"
    )
    assert call(store, "tag", "--has", "imu", "by=machine").code == 0
    store.refresh()
    assert list(store.recordings(tag="by=machine").names) == ["monday 2", "run1"]
    assert call(store, "tag", "-r", "*", "--remove", "by").code == 0  # also of those that lack it
    store.refresh()
    assert store.recordings(tag="by") == []
    assert "has no tag 'by'" in call(store, "tag", "tuesday", "--remove", "by").err
    assert "Name a recording" in call(store, "tag").err
    assert "KEY=VALUE" in call(store, "tag", "--has", "imu", "run1").err


def test_recordings_are_deleted_by_choice(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        for day in range(1, 4):
            write(tmp_path / "log.mcap", day, {"/a": ("t", [day])})
            store.record(tmp_path / "log.mcap", name=f"r{day}", tags={"day": str(day % 2)})
        assert "r1, r3" in (asked := call(store, "rm", "--tag", "day=1")).err
        assert asked.code == 2
        assert "--yes" in asked.err
        assert "Name the recordings" in call(store, "rm").err
        assert call(store, "rm", "-r", "r?", "--with", "a: n > 2", "--yes").out == "deleted r3\n"
        assert call(store, "rm", "r1", "-r", "r2", "-y").out == "deleted r1\ndeleted r2\n"
        store.refresh()
        assert store.recordings() == []


def test_queries_of_chosen_recordings(store: hl.Store) -> None:
    found = store.recordings(tag="robot=7")
    assert isinstance(found, Recordings)
    assert found.topics() == ["/left/scan", "/odd", "/scan"]
    assert found.all_topics().count() == 5
    # A short name that is ambiguous among all is clear in the second recording.
    with pytest.raises(TopicError, match="ambiguous"):
        found.topic("scan")
    assert found[1:].topic("scan").topics == ("/left/scan",)
    assert found[0].name == "monday 1"
    assert store.topic("/scan").in_recording("mon*").count() == 5
    # Whatever takes names takes recordings.
    assert store.verify(found).recordings == 2
    assert store.query(["/scan"], found).count() == 3
    assert {size.recording for size in store.sizes(found).rows} == {"monday 1", "tuesday"}
    assert store.session.select(found) == found


def test_tables_name_recordings(store: hl.Store) -> None:
    query = store.topic("/scan", "/imu")
    frame = query.to_pandas()
    assert list(frame.columns) == ["topic", "recording", "n", "robot"]
    rows = [json.loads(line) for line in written(query, "jsonl").splitlines()]
    assert list(rows[0]) == ["log_time_ns", "topic", "recording", "n", "robot"]
    assert [row["recording"] for row in rows] == frame["recording"].tolist()


def test_one_recording_is_named_on_request(store: hl.Store) -> None:
    one = store.topic("/scan").in_recording("tues*", "monday 1")
    assert list(one.to_pandas().columns) == ["n", "robot"]
    assert one.fields("recording", "n").to_arrow().column("recording").unique().to_pylist() == [
        "monday 1"
    ]


def test_a_running_recording_reaches_until_now() -> None:
    now = 100
    made = [
        summary(1, (5, 9), ["/a"], status="open", created=4)[0],
        summary(2, None, ["/a"], status="open", created=50)[0],
        summary(3, (5, 9), ["/a"])[0],
        summary(4, None, ["/a"], created=50)[0],
    ]

    def chosen(begin: int, end: int) -> set[str]:
        return {one.name for one in made if overlaps(one, begin, end, now)}

    assert chosen(20, 30) == {"r1"}
    assert chosen(60, 70) == {"r1", "r2"}
    assert chosen(8, 9) == {"r1", "r3"}
    assert chosen(100, 200) == set()


def test_a_name_means_its_recording_while_others_are_recorded(tmp_path: Path) -> None:
    """Recordings that go on get their place among the others when they are looked at."""
    said = Channel("/said", "json", None)
    with hl.open(tmp_path / "store", create=True) as store:
        for number in range(3):
            with store.start(f"ended-{number}") as recording:
                recording.write(said, b'{"n": 1}', log_time=(3 + number) * 10**9)
        options = LiveOptions(flush_interval_s=0.05)
        with store.start("first", options) as one, store.start("second", options) as two:
            one.write(said, b'{"n": 2}', log_time=10**9)
            two.write(said, b'{"n": 3}', log_time=4 * 10**9 + 1)
            end = time.monotonic() + 30
            while store.topic("said").count() < 5 and time.monotonic() < end:
                time.sleep(0.02)
            for label in ("first", "second", *(f"ended-{number}" for number in range(3))):
                with hl.open(tmp_path / "store") as other:
                    query = other.topic("said").in_recording(label)
                    assert {message.recording for message in query} == {other.entry(label).id}
                    found = other.recordings(where="said: n > 0", name=label)
                    assert [entry.name for entry in found] == [label]
            assert not run("tag", "ended-2", "owner=anna", store=tmp_path / "store").err
            with hl.open(tmp_path / "store") as other:
                tagged = [one.name for one in other.session.look().summaries if one.tags]
            assert tagged == ["ended-2"]
