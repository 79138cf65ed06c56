"""The ROS 1 source against the real master and rospy, as Debian packs them.

The packages are fetched once into the cache and unpacked there, which needs apt but neither
root nor an installation.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import xmlrpc.client
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from hybridlog.live.sources.ros1.source import Ros1Source
from tests.debian import libraries, unpack
from tests.live.sources.ros1_peers import Collector
from tests.peer_cache import made_once
from tests.servers.mongods import free_port
from tests.waiting import wait_for

PACKAGES = (
    "python3-rosmaster",
    "python3-rospy",
    "python3-std-msgs",
    "python3-sensor-msgs",
)
_OF_ROS = re.compile("^Source: ros-", re.MULTILINE)


class Ros1(NamedTuple):
    """Where ROS 1 lies."""

    python: str
    environment: dict[str, str]


def ros1() -> Ros1 | str:
    """ROS 1, or why it cannot be had."""
    place = made_once("ros1-debian", lambda place: unpack(place, PACKAGES, _without_ros))
    return place if isinstance(place, str) else _in(place / "tree")


def _in(root: Path) -> Ros1:
    own_python = root / "usr/bin/python3"
    environment = {
        "PYTHONPATH": str(root / "usr/lib/python3/dist-packages"),
        "LD_LIBRARY_PATH": libraries(root),
    }
    if own_python.exists():
        # Debian's Python was missing, too.
        environment["PYTHONHOME"] = str(root / "usr")
    else:
        own_python = Path("/usr/bin/python3")
    return Ros1(str(own_python), environment)


def _without_ros(status: str) -> str:
    """What dpkg says of a system, as if that had nothing of ROS: a tree has all or nothing."""
    packages = status.split("\n\n")
    return "\n\n".join(package for package in packages if not _OF_ROS.search(package))


PUBLISHER = """
import hashlib, io, json, sys
import rospy
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import String

order = json.loads(sys.argv[1])
rospy.init_node(order["node"], disable_signals=True)
if order["type"] == "image":
    kind, make = CompressedImage, lambda n, size: CompressedImage(data=bytes([n % 256]) * size)
else:
    kind, make = String, lambda n, size: String(("%d " % n).ljust(size, "x"))
publisher = rospy.Publisher(order["topic"], kind, queue_size=0, latch=order["latch"])
number = 0
print(json.dumps({"definition": kind._full_text, "md5sum": kind._md5sum}), flush=True)
for line in sys.stdin:
    command = json.loads(line)
    while publisher.get_num_connections() < command.get("connections", 0):
        rospy.sleep(0.01)
    hashes = []
    for _ in range(command["count"]):
        message = make(number, command["size"])
        publisher.publish(message)
        number += 1
        payload = io.BytesIO()
        message.serialize(payload)
        hashes.append(hashlib.sha256(payload.getvalue()).hexdigest())
    print(json.dumps(hashes), flush=True)
rospy.signal_shutdown("done")
"""


MASTER = "import rosmaster; rosmaster.rosmaster_main()"


pytestmark = pytest.mark.peer("ROS 1")


@pytest.fixture(scope="session")
def debian() -> Ros1:
    found = ros1()
    if isinstance(found, str):
        pytest.skip(
            f"ROS 1 was NOT tested with real peers, {found}: apt-get install {' '.join(PACKAGES)}"
        )
    return found


class _Master:
    """`rosmaster --core` on a port of its own."""

    def __init__(self, debian: Ros1) -> None:
        self.debian = debian
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("ROS_")},
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            **debian.environment,
        }

    def __enter__(self) -> _Master:
        self._process = subprocess.Popen(
            [self.debian.python, "-c", MASTER, "--core", "-p", str(self.port)],
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        wait_for(self._answers)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait(20)

    def _answers(self) -> bool:
        try:
            with xmlrpc.client.ServerProxy(self.uri) as master:
                return bool(master.getPid("/test"))
        except OSError:
            return False


class _Publisher:
    def __init__(
        self, master: _Master, topic: str, type_name: str = "text", *, latch: bool = False
    ) -> None:
        order = {"node": "talker", "topic": topic, "type": type_name, "latch": latch}
        self._process = subprocess.Popen(
            [master.debian.python, "-c", PUBLISHER, json.dumps(order)],
            env=master.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.facts = self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def publish(self, count: int, size: int = 20, connections: int = 1) -> list[str]:
        """Has messages sent; gives a hash of each payload."""
        assert self._process.stdin is not None
        command = {"count": count, "size": size, "connections": connections}
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        return list(self._answer())

    def __enter__(self) -> _Publisher:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate(timeout=20)


@pytest.fixture(scope="module")
def master(debian: Ros1) -> Iterator[_Master]:
    with _Master(debian) as running:
        yield running


@contextmanager
def _listening(master: _Master, sink: Collector) -> Iterator[Collector]:
    with Ros1Source(master.uri, poll_s=0.2) as source:
        source.start(sink)
        yield sink


def _hashes(sink: Collector, topic: str) -> list[str]:
    return [sha256(payload).hexdigest() for payload in sink.payloads(topic)]


def _only(topic: str) -> Collector:
    return Collector(wanted=lambda name, type_name: name == topic)


@pytest.mark.parametrize(
    ("type_name", "count", "size"),
    [("text", 2000, 300), ("image", 3, 20_000_000)],
)
def test_payloads_are_those_that_were_published(
    master: _Master, type_name: str, count: int, size: int
) -> None:
    topic = f"/exact_{type_name}_{size}"
    with (
        _Publisher(master, topic, type_name) as publisher,
        _listening(master, _only(topic)) as sink,
    ):
        hashes = publisher.publish(count, size)
        sink.wait(lambda: len(sink.taken) == count)
        assert _hashes(sink, topic) == hashes
    channel = sink.taken[0].channel
    assert channel.schema is not None
    assert channel.schema.data.decode() == publisher.facts["definition"]
    assert channel.metadata["md5sum"] == publisher.facts["md5sum"]
    assert channel.metadata["callerid"] == "/talker"
    numbers = [taken.sequence for taken in sink.taken]
    assert numbers == ([None] * count if type_name == "text" else list(range(1, count + 1)))
    assert sink.losses == []


def test_a_late_subscriber_gets_what_is_latched(master: _Master) -> None:
    with _Publisher(master, "/latched", latch=True) as publisher:
        (*_, last) = publisher.publish(3, connections=0)
        with _listening(master, _only("/latched")) as sink:
            sink.wait(lambda: len(sink.taken) == 1)
            assert _hashes(sink, "/latched") == [last]
    assert sink.taken[0].channel.metadata["latching"] == "1"
