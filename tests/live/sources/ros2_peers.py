"""Peers for the tests of the ROS 2 source: a sink that remembers, a robot, a fake child."""

from __future__ import annotations

import json
import os
import random
import stat
import subprocess
import sys
import textwrap
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.peer_cache import made_once

if TYPE_CHECKING:
    from collections.abc import Iterator

WHEELS = (
    "ros-rclpy==9.1.2",
    "ros-rmw-fastrtps-cpp==9.3.3",
    "ros-std-msgs==5.5.1",
    "ros-sensor-msgs==5.5.1",
    "ros-geometry-msgs==5.5.1",
)


def ros2_python() -> str | None:
    """A Python that has rclpy: the one that is named, or one that is made once for all."""
    named = os.environ.get("HYBRIDLOG_TEST_ROS2_PYTHON")
    if named:
        return named
    version = f"{sys.version_info.major}{sys.version_info.minor}"
    place = made_once(f"ros2-{WHEELS[0].partition('==')[2]}-cp{version}", _make_ros2)
    return None if isinstance(place, str) else str(place / "bin" / "python")


def _make_ros2(place: Path) -> str:
    commands = (
        [sys.executable, "-m", "venv", str(place)],
        [str(place / "bin" / "python"), "-m", "pip", "install", "--quiet", *WHEELS],
    )
    try:
        for command in commands:
            subprocess.run(command, capture_output=True, check=True, timeout=200)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        return str(error)
    return ""


ROBOT = """
    import json, sys, time
    import rclpy
    from rclpy.qos import QoSProfile
    from rclpy.serialization import serialize_message
    from importlib import import_module

    rclpy.init()
    node = rclpy.create_node(sys.argv[1], enable_rosout=False, start_parameter_services=False)
    publishers = {}

    def make(name, kind, **quality):
        package, _, last = kind.partition("/msg/")
        found = getattr(import_module(package + ".msg"), last)
        publishers[name] = node.create_publisher(found, name, QoSProfile(**quality)), found

    def drop(name):
        node.destroy_publisher(publishers.pop(name)[0])

    def heard(name, by):
        deadline = time.monotonic() + 30
        while publishers[name][0].get_subscription_count() != by:
            assert time.monotonic() < deadline, name
            time.sleep(0.01)

    def text(name, words):
        publisher, kind = publishers[name]
        for word in words:
            publisher.publish(kind(data=word))

    def texts(name, count):
        text(name, ["message %d" % number for number in range(count)])

    def images(name, count, size):
        publisher, kind = publishers[name]
        for number in range(count):
            publisher.publish(kind(height=number, data=bytes([number]) * size))
            time.sleep(0.01)

    def call(name, prefixes):
        from rcl_interfaces.srv import ListParameters
        from rclpy.service_introspection import ServiceIntrospectionState

        def answer(request, response):
            response.result.names = request.prefixes
            return response

        service = node.create_service(ListParameters, name, answer)
        client = node.create_client(ListParameters, name)
        for end in (service, client):
            end.configure_introspection(
                node.get_clock(), QoSProfile(depth=10), ServiceIntrospectionState.CONTENTS
            )
        deadline = time.monotonic() + 30
        while not node.count_subscribers(name + "/_service_event"):
            assert time.monotonic() < deadline, name
            time.sleep(0.01)
        time.sleep(0.5)  # the graph knows of a subscription before both ends have met it
        future = client.call_async(ListParameters.Request(prefixes=prefixes))
        rclpy.spin_until_future_complete(node, future, timeout_sec=30)
        assert list(future.result().result.names) == prefixes

    def flood(names, rounds, size):
        kind = publishers[names[0]][1]
        message = serialize_message(kind(data=bytes(size)))
        for _ in range(rounds):
            for name in names:
                send(publishers[name][0], message)

    def send(publisher, message):
        # A reliable publisher refuses for a moment when its subscribers do not keep up.
        deadline = time.monotonic() + 30
        while True:
            try:
                return publisher.publish(message)
            except rclpy._rclpy_pybind11.RCLError:
                assert time.monotonic() < deadline
                time.sleep(0.01)

    print("ready", flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        locals()[order.pop("do")](**order)
        print("done", flush=True)
    # Whoever only dies is missed after a lease of twenty seconds.
    node.destroy_node()
    rclpy.shutdown()
"""


class Robot:
    """A ROS 2 node in a process of its own that does what it is told."""

    def __init__(self, python: str, name: str) -> None:
        self._process = subprocess.Popen(
            [python, "-c", textwrap.dedent(ROBOT), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._expect("ready")

    def _expect(self, word: str) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline().strip() == word

    def do(self, what: str, **arguments: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": what, **arguments}) + "\n")
        self._process.stdin.flush()
        self._expect("done")

    def end(self) -> None:
        try:
            self._process.communicate(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()


@contextmanager
def robot(python: str, name: str) -> Iterator[Robot]:
    found = Robot(python, name)
    try:
        yield found
    finally:
        found.end()


def domain() -> dict[str, str]:
    return {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        # Domains up to 101 have ports that nobody else takes.
        "ROS_DOMAIN_ID": str(random.SystemRandom().randint(1, 101)),
    }


FAKE = """\
#!{python}
import json, os, signal, socket, sys, time
from types import SimpleNamespace
from hybridlog.live.sources.ros2.child.child import *

peer = socket.socket(fileno=int(sys.argv[-1]))
file = peer.makefile("rb")
starts = os.path.join({folder!r}, "starts")
with open(starts, "a") as log:
    log.write("%d\\n" % os.getpid())
with open(starts) as log:
    start = len(log.readlines())

box = Outbox(peer)

def hello():
    box.event("hello", middleware="rmw_fake")

def channel(topic="/a", kind="std_msgs/msg/String", text=b"string data", offered="", hash=""):
    definition = SimpleNamespace(encoding="ros2msg", text=text)
    return box.channel(topic, kind, definition, offered, hash)

def message(payload, sequence=1):
    box.message(0, payload, 1_700_000_000_000_000_000, 0, sequence)
    box.flush()

def wait():
    while file.readline():
        pass

{body}
"""


def fake_child(folder: Path, body: str) -> str:
    """An interpreter that runs a script of ours whatever it is asked to run."""
    path = folder / "python"
    text = FAKE.format(python=sys.executable, folder=str(folder), body=textwrap.dedent(body))
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def starts(folder: Path) -> list[int]:
    path = folder / "starts"
    return [int(line) for line in path.read_text().split()] if path.exists() else []


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that waits to be reaped does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
