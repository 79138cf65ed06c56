"""The ROS 2 source against ROS 2: real publishers, a real middleware."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hybridlog.live.sources.base import Cause
from hybridlog.live.sources.ros2.source import Ros2Source
from hybridlog.schema.codecs import codec_for
from tests.indexed import index_fields
from tests.limits import Limit
from tests.live.sources.heard import Heard
from tests.live.sources.ros2_peers import (
    Robot,
    domain,
    is_alive,
    robot,
    ros2_python,
)
from tests.waiting import wait_for

pytestmark = pytest.mark.peer("ROS 2")

STRING = "std_msgs/msg/String"
IMAGE = "sensor_msgs/msg/Image"


@pytest.fixture(scope="session")
def python() -> str:
    found = ros2_python()
    if found is None:
        pytest.skip("NO ROS 2: the wheels of rclpy cannot be installed here; nothing is tested")
    return found


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch, limit: Limit) -> None:
    for name, value in domain().items():
        monkeypatch.setenv(name, value)
    limit(ros2_pause_s=0.01)


@pytest.fixture
def talker(python: str) -> Iterator[Robot]:
    with robot(python, "talker") as found:
        yield found


def mine(topic: str, _: str) -> bool:
    return topic not in {"/rosout", "/parameter_events"}


def sequences(heard: Heard, topic: str) -> list[int]:
    return [taken.sequence or 0 for taken in heard.taken if taken.channel.topic == topic]


def text(payload: bytes) -> str:
    assert payload[:4] == b"\x00\x01\x00\x00"
    return payload[8 : 7 + int.from_bytes(payload[4:8], "little")].decode()


def test_all_arrives_as_it_was_sent(python: str, talker: Robot) -> None:
    talker.do("make", name="/map", kind=STRING, depth=2, durability=1)
    talker.do("text", name="/map", words=["old", "older", "new"])
    talker.do("make", name="/chat", kind=STRING, depth=5000)
    talker.do("make", name="/camera", kind=IMAGE, depth=50)
    heard = Heard(mine)
    with Ros2Source(python) as source:
        source.start(heard)
        assert source.address.endswith(", rmw_fastrtps_cpp")
        # What was latched before is heard, too.
        heard.wait(lambda: len(heard.payloads("/map")) == 2, "the kept ones should come")
        talker.do("heard", name="/chat", by=1)
        talker.do("heard", name="/camera", by=1)
        before = time.time_ns()
        talker.do("texts", name="/chat", count=2000)
        talker.do("images", name="/camera", count=20, size=640_000)
        heard.wait(lambda: len(heard.taken) == 2022, "all should arrive")
        after = time.time_ns()
        # Another type after a restart is a channel of its own.
        talker.do("drop", name="/chat")
        heard.wait(lambda: "/chat" in heard.gone, "it should be gone")
        talker.do("make", name="/chat", kind="std_msgs/msg/Int32", depth=10)
        talker.do("heard", name="/chat", by=1)
        talker.do("text", name="/chat", words=[2])
        heard.wait(lambda: len(heard.taken) == 2023, "the number should come")
    assert [text(payload) for payload in heard.payloads("/map")] == ["older", "new"]
    assert "durability: 1" in heard.taken[0].channel.metadata["offered_qos_profiles"]
    *chat, number = [taken for taken in heard.taken if taken.channel.topic == "/chat"]
    assert [text(taken.payload) for taken in chat] == [f"message {at}" for at in range(2000)]
    assert [taken.sequence for taken in chat] == list(range(1, 2001))
    images = heard.payloads("/camera")
    assert [image[-640_000:] for image in images] == [bytes([at]) * 640_000 for at in range(20)]
    for taken in heard.taken[2:-1]:
        assert taken.sent is not None
        assert before <= taken.sent <= taken.received <= after
    assert heard.losses == []
    assert heard.said == []
    assert ("/chat", STRING) in heard.came
    assert not {topic for topic, *_ in heard.came} & {"/rosout", "/parameter_events"}
    channel = chat[0].channel
    assert (channel.message_encoding, channel.has_publish_time) == ("cdr", True)
    assert channel.schema is not None
    assert (channel.schema.name, channel.schema.encoding) == (STRING, "ros2msg")
    assert "durability: 2" in channel.metadata["offered_qos_profiles"]
    assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
    assert all(taken.channel is channel for taken in chat)
    assert number.payload[4:] == b"\2\0\0\0"
    assert number.channel.metadata["topic_type_hash"] != channel.metadata["topic_type_hash"]


def test_calls_of_services_and_states_of_actions_are_heard(python: str, talker: Robot) -> None:
    heard = Heard(mine)
    with Ros2Source(python) as source:
        source.start(heard)
        talker.do(
            "make", name="/go/_action/status", kind="action_msgs/msg/GoalStatusArray", depth=1
        )
        talker.do("call", name="/list", prefixes=["a", "bc"])
        heard.wait(lambda: len(heard.taken) == 4, "both ends should tell of both messages")
        status = ("/go/_action/status", "action_msgs/msg/GoalStatusArray")
        heard.wait(lambda: status in heard.came, "the action should be seen")
    assert {taken.channel.topic for taken in heard.taken} == {"/list/_service_event"}
    channel = heard.taken[0].channel
    assert channel.schema is not None
    assert channel.schema.name == "rcl_interfaces/srv/ListParameters_Event"
    rows = [index_fields(codec_for(channel), taken.payload) for taken in heard.taken]
    # Sent and received request, sent and received answer; the two ends may be in any order.
    assert sorted(row["info"]["event_type"] for row in rows) == [0, 1, 2, 3]
    requests = [row["request"] for row in rows if row["info"]["event_type"] < 2]
    answers = [row["response"] for row in rows if row["info"]["event_type"] >= 2]
    assert [each[0]["prefixes"] for each in requests] == [["a", "bc"]] * 2
    assert [each[0]["result"]["names"] for each in answers] == [["a", "bc"]] * 2
    assert heard.said == []


@pytest.mark.parametrize(
    ("reliability", "transports"),
    [
        (2, "DEFAULT"),
        *(pytest.param(*case, marks=pytest.mark.exhaustive) for case in ((1, ""), (2, ""))),
    ],
)
def test_all_that_an_overloaded_publisher_sent_has_come_or_is_counted(
    python: str, monkeypatch: pytest.MonkeyPatch, reliability: int, transports: str
) -> None:
    names = [f"/camera{number}" for number in range(6)]
    rounds = 50
    heard = Heard(lambda topic, _: topic in names)
    with robot(python, "overloaded") as overloaded:
        for name in names:
            overloaded.do("make", name=name, kind=IMAGE, depth=10, reliability=reliability)
        if transports:
            # Ours for the child only: Fast DDS as it comes cannot even hold one image.
            monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", transports)
        with Ros2Source(python) as source:
            source.start(heard)
            sent = dict.fromkeys(names, 0)

            def speak(until: Callable[[str], object], what: str) -> None:
                deadline = time.monotonic() + 60
                for name in names:
                    while not until(name):
                        assert time.monotonic() < deadline, what
                        overloaded.do("images", name=name, count=1, size=10)
                        sent[name] += 1
                        time.sleep(0.05)

            speak(heard.payloads, "it should be heard")
            overloaded.do("flood", names=names, rounds=rounds, size=640_000)
            for name in names:
                sent[name] += rounds
            flooded = dict(sent)
            speak(
                lambda name: (sequences(heard, name)[-1] or 0) > flooded[name],
                "it should be heard again",
            )
    for name in names:
        counts = [lost.count or 0 for lost in heard.losses if lost.topic == name]
        came = sequences(heard, name)
        assert came == sorted(set(came))
        # What is sent before the child listens is nobody's.
        assert len(came) + sum(counts) == came[-1] - came[0] + 1
        assert came[-1] <= sent[name]
    assert {lost.cause for lost in heard.losses} <= {Cause.TRANSPORT, Cause.QUEUE}


def test_nothing_outlives_a_recorder_that_is_killed(python: str) -> None:
    program = """
        import sys, time
        from hybridlog.live.sources.ros2.source import Ros2Source
        from tests.live.sources.heard import Heard
        source = Ros2Source(sys.argv[1])
        source.start(Heard())
        print(source._child.pid, flush=True)
        time.sleep(60)
    """
    root = Path(__file__).parents[3]
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program), python],
        cwd=root,
        stdout=subprocess.PIPE,
        text=True,
    ) as recorder:
        assert recorder.stdout is not None
        child = int(recorder.stdout.readline())
        recorder.kill()
    wait_for(lambda: not is_alive(child))
