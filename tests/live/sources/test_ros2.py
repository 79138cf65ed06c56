"""The recorder's end of the ROS 2 source, against children that a test can make misbehave."""

from __future__ import annotations

import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest

from hybridlog.live.sources.base import Cause, Loss
from hybridlog.live.sources.ros2.source import (
    PYTHON_VARIABLE,
    Ros2Source,
    candidates,
)
from hybridlog_storage.errors import MissingDependencyError, SourceError, UsageError
from hybridlog_storage.messages import Schema
from tests.limits import Limit
from tests.live.sources.heard import Heard, must_return
from tests.live.sources.ros2_peers import fake_child, is_alive, starts
from tests.waiting import wait_for


@pytest.fixture(autouse=True)
def _no_ros(monkeypatch: pytest.MonkeyPatch, limit: Limit) -> None:
    for name in (PYTHON_VARIABLE, "ROS_DISTRO", "AMENT_PREFIX_PATH", "ROS_DOMAIN_ID"):
        monkeypatch.delenv(name, raising=False)
    limit(ros2_pause_s=0.01)


def _files() -> set[str]:
    return {path.name for path in Path("/proc/self/fd").iterdir()}


@pytest.fixture(autouse=True)
def _nothing_is_left(tmp_path: Path) -> object:
    before = set(threading.enumerate())
    files = _files()
    yield
    assert set(threading.enumerate()) <= before
    assert len(_files()) <= len(files)
    assert not [pid for pid in starts(tmp_path) if is_alive(pid)]


def test_messages_and_events_reach_the_sink(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "5")
    sizes = [0, 5, 32 << 10, 3, 3 << 20, *[20_000] * 100, 1]
    child = fake_child(
        tmp_path,
        """
        hello()
        for topic in ("/a", "/no"):
            box.event("candidate", topic=topic, type="std_msgs/msg/String")
        assert json.loads(file.readline()) == {"subscribe": "/a", "type": "std_msgs/msg/String"}
        box.event("topic", topic="/a", type="std_msgs/msg/String")
        channel(text=b"caf\\xff", offered="- durability: 1", hash="RIHS01_x")
        for number, size in enumerate(SIZES):
            box.message(0, bytes([number]) * size, 10 + number, 0, number)
        box.lost("/a", "transport", 3, times=(1, 2), detail="from \\x1b[31m/n")
        box.say("a\\nb")
        box.event("gone", topic="/a")
        wait()
        message(b"last", -1)
        box.event("bye")
        """.replace("SIZES", str(sizes)),
    )
    heard = Heard(lambda topic, _: topic != "/no")
    with Ros2Source(child) as source:
        source.start(heard)
        assert source.address == "domain 5, rmw_fake"
        heard.wait(lambda: heard.gone, "the topic should be gone")
    *taken, last = heard.taken
    assert [one.payload for one in taken] == [bytes([n]) * size for n, size in enumerate(sizes)]
    assert [one.sequence for one in taken] == [one.received - 10 for one in taken]
    assert (last.payload, last.sequence) == (b"last", None)
    assert {one.sent for one in heard.taken} == {None}
    channel = heard.taken[0].channel
    assert (channel.topic, channel.message_encoding) == ("/a", "cdr")
    assert channel.schema == Schema("std_msgs/msg/String", "ros2msg", b"caf\xff")
    assert channel.has_publish_time
    assert channel.metadata == {
        "offered_qos_profiles": "- durability: 1",
        "topic_type_hash": "RIHS01_x",
    }
    assert heard.came == [("/a", "std_msgs/msg/String")]
    assert heard.losses == [Loss(Cause.TRANSPORT, "/a", 3, 1, 2, "from ?[31m/n")]
    assert heard.said == ["ROS 2: a b"]
    assert heard.ends == []


@pytest.mark.parametrize(
    "ceaseless", ["time.sleep(60)", 'box.event("candidate", topic="/a", type="b")']
)
def test_a_child_that_does_not_listen_is_ended(
    tmp_path: Path, limit: Limit, ceaseless: str
) -> None:
    limit(ros2_hand_over_s=0.1)
    deaf = 'signal.signal(signal.SIGTERM, signal.SIG_IGN)\nhello()\nbox.say("deaf")'
    heard = Heard()
    source = Ros2Source(fake_child(tmp_path, f"{deaf}\nwhile True: {ceaseless}"))
    source.start(heard)
    heard.wait(lambda: heard.said, "it should say")
    source.stop()
    assert not is_alive(starts(tmp_path)[0])


BROKEN = [
    ('peer.sendall(b"\\1\\0")\nos._exit(3)', "middle"),
    (
        "peer.sendall(HEADER.pack(MESSAGE, 1 << 30) + ENTRY.pack(0, 1, 1, 1))\nos._exit(3)",
        "middle",
    ),
    (
        'for word in ("why", "because\\x1b[2J"): print(word, file=sys.stderr)\nos._exit(3)',
        "exit code 3: because?[2J",
    ),
    ("os.kill(os.getpid(), signal.SIGSEGV)", "exit code -11"),
]


@pytest.mark.parametrize(("damage", "reason"), BROKEN)
def test_a_child_that_breaks_is_started_again(tmp_path: Path, damage: str, reason: str) -> None:
    body = """
        hello()
        box.event("topic", topic="/a", type="b")
        channel()
        message(b"%d" % start)
        if start == 1:
            time.sleep(0.01)
            DAMAGE
            wait()
        wait()
        box.event("bye")
    """
    body = textwrap.dedent(body).replace("DAMAGE", damage.replace("\n", "\n    "))
    heard = Heard()
    with Ros2Source(fake_child(tmp_path, body)) as source:
        source.start(heard)
        heard.wait(lambda: len(heard.taken) == 2, "the second child should be heard")
    assert [taken.payload for taken in heard.taken] == [b"1", b"2"]
    [said] = heard.said
    assert reason in said
    assert "restarting it" in said
    assert said.isprintable()
    [lost] = heard.losses
    assert (lost.topic, lost.cause, lost.count) == ("/a", Cause.CONNECTION, None)
    assert 0 < lost.first <= lost.last <= time.time_ns()
    assert heard.gone == ["/a"]
    assert [topic for topic, *_ in heard.came] == ["/a", "/a"]


def test_an_outage_that_never_ends_is_told_at_the_end(tmp_path: Path) -> None:
    child = fake_child(
        tmp_path,
        """
        if start == 1:
            hello()
            channel()
            box.say("dying")
            os._exit(1)
        print("not again", flush=True)
        os._exit(4)
        """,
    )
    heard = Heard()
    with Ros2Source(child) as source:
        source.start(heard)
        heard.wait(lambda: len(starts(tmp_path)) > 2, "it should be tried again")
        # A child may be too slow in ending for its words to be heard; others come.
        heard.wait(
            lambda: any("exit code 4: not again" in said for said in heard.said),
            "it should say so",
        )
        assert not heard.losses
    [lost] = heard.losses
    assert (lost.topic, lost.cause) == ("/a", Cause.CONNECTION)


def test_stop_does_not_wait_for_a_child_that_does_not_greet(tmp_path: Path) -> None:
    child = fake_child(
        tmp_path,
        """
        if start == 1:
            hello()
            os._exit(1)
        time.sleep(60)
        """,
    )
    source = Ros2Source(child)
    source.start(Heard())
    wait_for(lambda: len(starts(tmp_path)) == 2)
    must_return(source.stop)


def test_no_python_has_rclpy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    missing = tmp_path / "nothing"
    with pytest.raises(MissingDependencyError, match="cannot be started: No such file"):
        Ros2Source(str(missing)).start(Heard())
    monkeypatch.setenv(PYTHON_VARIABLE, str(missing))
    with pytest.raises(MissingDependencyError, match=r"setup\.bash.*venv.*HYBRIDLOG_ROS2_PYTHON="):
        Ros2Source().start(Heard())
    with pytest.raises(MissingDependencyError, match="No module named 'rclpy'"):
        Ros2Source(sys.executable).start(Heard())


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('box.event("failed", missing=False, why="RCLError: no\\nroom")', "RCLError: no room"),
        ('peer.sendall(b"\\1")', "did not load rclpy within"),
    ],
)
def test_ros_that_does_not_come_up(tmp_path: Path, limit: Limit, body: str, reason: str) -> None:
    limit(ros2_hello_s=2.0)
    with pytest.raises(SourceError, match=reason):
        Ros2Source(fake_child(tmp_path, body + "\nwait()")).start(Heard())


@pytest.mark.parametrize("domain", ["-1", "233", "1000000000", "x"])
def test_a_domain_that_is_none(domain: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(UsageError, match=f"domains from 0 to 232, not '{domain}'"):
        Ros2Source().start(Heard())


def test_which_pythons_are_tried(tmp_path: Path) -> None:
    python = tmp_path / "python3"
    python.write_text("")
    python.chmod(0o755)
    assert candidates({PYTHON_VARIABLE: "mine", "ROS_DISTRO": "kilted"}) == ["mine"]
    assert candidates({}) == [sys.executable]
    found = candidates({"ROS_DISTRO": "kilted", "PATH": str(tmp_path)})
    assert found[0] == str(python)
    assert found[-1] == sys.executable
