"""The ROS 2 source against ROS 2: real publishers, a real middleware."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hybridlog.live.sources.base import Cause
from hybridlog.live.sources.ros2.child.definitions import Definitions
from hybridlog.live.sources.ros2.source import Ros2Source
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.definition import parse_definition
from hybridlog.schema.index_bodies import index_fields
from hybridlog_storage.messages import Schema
from tests.limits import Limit
from tests.live.sources.ros2_peers import (
    Memory,
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


def needs_names(memory: Memory) -> None:
    if any("does not name the publishers of messages" in said for said in memory.said):
        pytest.skip("this rclpy names no publishers: several of them were NOT tested")


def sequences(memory: Memory, topic: str) -> list[int]:
    """The publisher's numbers of what came."""
    return [taken.sequence or 0 for taken in memory.taken if taken.channel.topic == topic]


def text(payload: bytes) -> str:
    """The string of a String."""
    assert payload[:4] == b"\x00\x01\x00\x00"
    return payload[8 : 7 + int.from_bytes(payload[4:8], "little")].decode()


def test_all_arrives_as_it_was_sent(python: str, talker: Robot) -> None:
    talker.do("make", name="/chat", kind=STRING, depth=5000)
    talker.do("make", name="/camera", kind=IMAGE, depth=50)
    memory = Memory(mine)
    with Ros2Source(python) as source:
        source.start(memory)
        assert source.address.endswith(", rmw_fastrtps_cpp")
        talker.do("heard", name="/chat", by=1)
        talker.do("heard", name="/camera", by=1)
        before = time.time_ns()
        for part in range(4):
            talker.do("texts", name="/chat", count=500)
            talker.do("images", name="/camera", count=5, size=640_000)
            memory.wait(lambda: len(memory.taken) == 505 * (part + 1), "all should arrive")  # noqa: B023
        after = time.time_ns()
    chat = [taken for taken in memory.taken if taken.channel.topic == "/chat"]
    assert [text(taken.payload) for taken in chat] == 4 * [f"message {at}" for at in range(500)]
    assert [taken.sequence for taken in chat] == list(range(1, 2001))
    for taken in memory.taken:
        assert taken.sent is not None
        assert before <= taken.sent <= taken.received <= after
    images = memory.payloads("/camera")
    assert [image[-640_000:] for image in images] == 4 * [bytes([at]) * 640_000 for at in range(5)]
    assert memory.losses == []
    assert memory.said == []
    assert ("/chat", STRING, 1) in memory.came
    assert not {topic for topic, *_ in memory.came} & {"/rosout", "/parameter_events"}
    channel = chat[0].channel
    assert (channel.message_encoding, channel.has_publish_time) == ("cdr", True)
    assert channel.schema is not None
    assert (channel.schema.name, channel.schema.encoding) == (STRING, "ros2msg")
    assert "durability: 2" in channel.metadata["offered_qos_profiles"]
    assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
    assert all(taken.channel is channel for taken in chat)


def test_our_own_node_is_nobody(python: str) -> None:
    memory = Memory()
    with Ros2Source(python) as source:
        source.start(memory)
        with robot(python, "other") as other:
            other.do("make", name="/chat", kind=STRING, depth=1)
            memory.wait(lambda: ("/chat", STRING) in memory.asked, "it should be seen")
            only = ("/parameter_events", "rcl_interfaces/msg/ParameterEvent", 1)
            memory.wait(lambda: only in memory.came, "only the robot's should count")
        memory.wait(lambda: "/chat" in memory.gone, "it should be gone")
        memory.wait(lambda: "/parameter_events" in memory.gone, "ours does not count")


def test_what_was_latched_before_is_heard(python: str, talker: Robot) -> None:
    talker.do("make", name="/map", kind=STRING, depth=2, durability=1)
    talker.do("text", name="/map", words=["old", "older", "new"])
    memory = Memory(mine)
    with Ros2Source(python) as source:
        source.start(memory)
        memory.wait(lambda: len(memory.taken) == 2, "the kept ones should come")
    assert [text(payload) for payload in memory.payloads("/map")] == ["older", "new"]
    assert "durability: 1" in memory.taken[0].channel.metadata["offered_qos_profiles"]
    assert memory.losses == []


def test_another_type_after_a_restart_is_a_channel_of_its_own(python: str, talker: Robot) -> None:
    """It is heard at once, while the publisher that was killed still counts as present."""
    number = "std_msgs/msg/Int32"
    memory = Memory(mine)
    with Ros2Source(python) as source:
        source.start(memory)
        talker.do("make", name="/x", kind=STRING, depth=10)
        talker.do("heard", name="/x", by=1)
        talker.do("text", name="/x", words=["one"])
        memory.wait(lambda: memory.taken, "the text should come")
        with robot(python, "other") as other:
            other.do("make", name="/x", kind=number, depth=10)
            other.do("heard", name="/x", by=1)
            other.do("text", name="/x", words=[2])
            memory.wait(lambda: len(memory.taken) == 2, "the number should come")
        talker.do("drop", name="/x")
        memory.wait(lambda: "/x" in memory.gone, "it should be gone")
        talker.do("make", name="/x", kind=number, depth=10)
        talker.do("heard", name="/x", by=1)
        talker.do("text", name="/x", words=[3])
        memory.wait(lambda: len(memory.taken) == 3, "the next number should come")
    assert memory.said == []
    assert memory.losses == []
    kinds = [taken.channel.schema.name for taken in memory.taken if taken.channel.schema]
    assert kinds == [STRING, number, number]
    assert len({taken.channel.metadata["topic_type_hash"] for taken in memory.taken}) == 2
    assert text(memory.taken[0].payload) == "one"
    assert memory.taken[1].payload[4:] == b"\2\0\0\0"


def test_calls_of_services_and_states_of_actions_are_heard(python: str, talker: Robot) -> None:
    memory = Memory(mine)
    with Ros2Source(python) as source:
        source.start(memory)
        talker.do(
            "make", name="/go/_action/status", kind="action_msgs/msg/GoalStatusArray", depth=1
        )
        talker.do("call", name="/list", prefixes=["a", "bc"])
        memory.wait(lambda: len(memory.taken) == 4, "both ends should tell of both messages")
        status = ("/go/_action/status", "action_msgs/msg/GoalStatusArray", 1)
        memory.wait(lambda: status in memory.came, "the action should be seen")
    assert {taken.channel.topic for taken in memory.taken} == {"/list/_service_event"}
    channel = memory.taken[0].channel
    assert channel.schema is not None
    assert channel.schema.name == "rcl_interfaces/srv/ListParameters_Event"
    rows = [index_fields(codec_for(channel), taken.payload) for taken in memory.taken]
    # Sent and received request, sent and received answer; the two ends may be in any order.
    assert sorted(row["info"]["event_type"] for row in rows) == [0, 1, 2, 3]
    requests = [row["request"] for row in rows if row["info"]["event_type"] < 2]
    answers = [row["response"] for row in rows if row["info"]["event_type"] >= 2]
    assert [each[0]["prefixes"] for each in requests] == [["a", "bc"]] * 2
    assert [each[0]["result"]["names"] for each in answers] == [["a", "bc"]] * 2
    assert memory.said == []


def test_a_publisher_that_offers_less_joins(python: str, talker: Robot) -> None:
    talker.do("make", name="/chat", kind=STRING, depth=5000)
    memory = Memory(mine)
    with Ros2Source(python) as source, robot(python, "poor") as poor:
        source.start(memory)
        talker.do("heard", name="/chat", by=1)
        talker.do("texts", name="/chat", count=100)
        poor.do("make", name="/chat", kind=STRING, depth=5000, reliability=2, durability=2)
        poor.do("heard", name="/chat", by=1)
        poor.do("text", name="/chat", words=["poor"])
        # The new subscription need not have found the talker yet.
        talker.do("texts", name="/chat", count=100)
        talker.do("heard", name="/chat", by=1)
        talker.do("texts", name="/chat", count=100)

        def known() -> int:
            return len(memory.taken) + sum(lost.count or 0 for lost in memory.losses)

        memory.wait(lambda: known() >= 301, "all should arrive or be counted")
    needs_names(memory)
    found = [text(payload) for payload in memory.payloads("/chat")]
    assert found.count("poor") == 1
    found.remove("poor")
    each = [f"message {at}" for at in range(100)]
    assert found[:100] == found[-100:] == each
    assert found[100:-100] == each[len(each) - len(found[100:-100]) :]
    assert known() == 301
    assert {(lost.topic, lost.cause) for lost in memory.losses} <= {("/chat", Cause.TRANSPORT)}
    assert memory.said == []


def test_what_is_lost_on_the_way_is_counted(python: str, talker: Robot, tmp_path: Path) -> None:
    overrides = tmp_path / "qos.yaml"
    overrides.write_text("/chat: {history: keep_last, depth: 1}")
    talker.do("make", name="/chat", kind=STRING, depth=1)
    memory = Memory(mine)
    with Ros2Source(python, overrides) as source:
        source.start(memory)
        talker.do("heard", name="/chat", by=1)
        talker.do("text", name="/chat", words=["first"])
        memory.wait(lambda: memory.taken, "the first should come")
        talker.do("texts", name="/chat", count=3000)
        last = "message 2999"
        memory.wait(lambda: text(memory.taken[-1].payload) == last, "the last should come")
    assert memory.losses
    assert {(lost.topic, lost.cause) for lost in memory.losses} == {("/chat", Cause.TRANSPORT)}
    known = memory.losses
    # The names of nodes come later than their publishers.
    assert {lost.detail for lost in known} <= {"", "from /talker"}
    assert len(memory.taken) + sum(lost.count or 0 for lost in known) == 3001
    for lost in known:
        assert memory.taken[0].received <= lost.first <= lost.last <= memory.taken[-1].received


@pytest.mark.parametrize("transports", ["", "DEFAULT"])
@pytest.mark.parametrize("reliability", [1, 2])
def test_all_that_an_overloaded_publisher_sent_has_come_or_is_counted(
    python: str, monkeypatch: pytest.MonkeyPatch, reliability: int, transports: str
) -> None:
    names = [f"/camera{number}" for number in range(6)]
    rounds = 50
    memory = Memory(lambda topic, _: topic in names)
    with robot(python, "overloaded") as overloaded:
        for name in names:
            overloaded.do("make", name=name, kind=IMAGE, depth=10, reliability=reliability)
        if transports:
            # Ours for the child only: Fast DDS as it comes cannot even hold one image.
            monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", transports)
        with Ros2Source(python) as source:
            source.start(memory)
            sent = dict.fromkeys(names, 0)

            def speak(until: Callable[[str], object], what: str) -> None:
                """Speaks slowly on each topic until it is heard."""
                deadline = time.monotonic() + 60
                for name in names:
                    while not until(name):
                        assert time.monotonic() < deadline, what
                        overloaded.do("images", name=name, count=1, size=10)
                        sent[name] += 1
                        time.sleep(0.05)

            speak(memory.payloads, "it should be heard")
            overloaded.do("flood", names=names, rounds=rounds, size=640_000)
            for name in names:
                sent[name] += rounds
            flooded = dict(sent)
            speak(
                lambda name: (sequences(memory, name)[-1] or 0) > flooded[name],
                "it should be heard again",
            )
    for name in names:
        counts = [lost.count or 0 for lost in memory.losses if lost.topic == name]
        came = sequences(memory, name)
        assert came == sorted(set(came))
        # What is sent before the child listens is nobody's.
        assert len(came) + sum(counts) == came[-1] - came[0] + 1
        assert came[-1] <= sent[name]
    assert {lost.cause for lost in memory.losses} <= {Cause.TRANSPORT, Cause.QUEUE}


def test_publishers_that_come_again_are_accused_of_nothing(python: str, talker: Robot) -> None:
    memory = Memory(mine)
    with Ros2Source(python) as source:
        source.start(memory)
        for count in (50, 3, 20):
            talker.do("make", name="/chat", kind=STRING, depth=5000)
            talker.do("heard", name="/chat", by=1)
            memory.wait(lambda: len(memory.came) > len(memory.gone), "it should come")
            before = len(memory.taken)
            talker.do("texts", name="/chat", count=count)
            memory.wait(lambda: len(memory.taken) == before + count, "all should arrive")  # noqa: B023
            talker.do("drop", name="/chat")
            memory.wait(lambda: len(memory.came) == len(memory.gone), "it should go")
    assert len(memory.taken) == 73
    assert memory.losses == []


def test_two_publishers_of_a_topic_are_told_apart(python: str, talker: Robot) -> None:
    memory = Memory(mine)
    with Ros2Source(python) as source, robot(python, "second") as second:
        source.start(memory)
        for one, count in ((talker, 10), (second, 700)):
            one.do("make", name="/chat", kind=STRING, depth=5000)
            one.do("heard", name="/chat", by=1)
            one.do("texts", name="/chat", count=count)
        for _ in range(3):
            talker.do("texts", name="/chat", count=5)
            second.do("texts", name="/chat", count=5)
        memory.wait(lambda: len(memory.taken) == 740, "all should arrive")
        memory.wait(lambda: ("/chat", STRING, 2) in memory.came, "both should be counted")
    needs_names(memory)
    assert memory.losses == []
    assert memory.said == []


def test_what_overrides_exclude_is_said(python: str, talker: Robot, tmp_path: Path) -> None:
    overrides = tmp_path / "qos.yaml"
    overrides.write_text("/chat: {reliability: reliable, deadline: {sec: 5, nsec: 0}}")
    talker.do("make", name="/chat", kind=STRING, depth=5, reliability=2)
    memory = Memory(mine)
    with Ros2Source(python, overrides) as source:
        source.start(memory)
        memory.wait(lambda: memory.said, "it should be said")
    assert "/chat: /talker is incompatible: its reliability and deadline" in memory.said[0]


def test_a_child_that_is_killed_comes_again(python: str, talker: Robot) -> None:
    talker.do("make", name="/chat", kind=STRING, depth=5000)
    memory = Memory(mine)
    with Ros2Source(python) as source:
        source.start(memory)
        talker.do("heard", name="/chat", by=1)
        talker.do("text", name="/chat", words=["before"])
        memory.wait(lambda: memory.taken, "it should arrive")
        assert source._child is not None
        os.kill(source._child.pid, signal.SIGKILL)
        memory.wait(lambda: memory.losses, "the outage should be told")
        # What is sent before the new child has found the talker is nobody's.
        until = time.monotonic() + 60
        while text(memory.taken[-1].payload) != "after":
            assert time.monotonic() < until, "it should be heard again"
            talker.do("text", name="/chat", words=["after"])
            time.sleep(0.2)
    [lost] = [lost for lost in memory.losses if lost.cause is Cause.CONNECTION]
    assert (lost.topic, lost.count) == ("/chat", None)
    assert any("killed by SIGKILL" in said for said in memory.said)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_nothing_outlives_a_recorder_that_is_killed(python: str, number: int) -> None:
    program = """
        import sys, time
        from hybridlog.live.sources.ros2.source import Ros2Source
        from tests.live.sources.ros2_peers import Memory
        source = Ros2Source(sys.argv[1])
        source.start(Memory())
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
        recorder.send_signal(number)
    wait_for(lambda: not is_alive(child))


def test_a_child_ends_when_it_is_told_to(python: str) -> None:
    memory = Memory(mine)
    source = Ros2Source(python)
    source.start(memory)
    assert source._child is not None
    pid = source._child.pid
    source.stop()
    assert not is_alive(pid)
    assert memory.said == []


def test_all_definitions_of_the_environment_can_be_read(python: str) -> None:
    share = Path(python).parents[1] / "share"
    definitions = Definitions([share])
    names = [
        f"{path.parts[-3]}/msg/{path.stem}"
        for package in ("std_msgs", "sensor_msgs", "geometry_msgs", "rcl_interfaces")
        for path in sorted(share.glob(f"{package}/msg/*.msg"))
    ]
    if not names:
        pytest.skip("the ROS 2 that was named is no virtual environment of wheels")
    for name in names:
        found = definitions.find(name)
        parse_definition(Schema(name, found.encoding, found.text))
    assert definitions.find(IMAGE).has_bytes
    assert not definitions.find("sensor_msgs/msg/JointState").has_bytes
