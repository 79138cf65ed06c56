"""The parts of the ROS 2 child that need no ROS."""

from __future__ import annotations

import ast
import json
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from hybridlog.live.sources.ros2.child import child
from hybridlog.live.sources.ros2.child import middleware as qos
from hybridlog.live.sources.ros2.child.child import Child, Outbox
from hybridlog.live.sources.ros2.child.definitions import Definitions, UnknownTypeError
from hybridlog.live.sources.ros2.child.middleware import VARIABLES, Offer, Profile
from tests.imports import ROOT, imports_of

GAPS = "hybridlog.live.sources.sequence_gaps"
CHILD = "hybridlog.live.sources.ros2.child"
FOLDER = ROOT.joinpath(*CHILD.split("."))
A, B = b"a" * 16, b"b" * 16


def test_messages_and_events_leave_in_their_order() -> None:
    sent, at, found = bytearray(), 0, []
    peer: Any = SimpleNamespace(sendall=sent.extend)
    box = Outbox(peer)
    sizes = [0, 5, 32 << 10, 3, 3 << 20, *[20_000] * 100, 1]
    for number, size in enumerate(sizes):
        box.message(0, bytes([number % 256]) * size, 10 + number, 0, number)
    box.event("end")
    while at < len(sent):
        kind, size = child.HEADER.unpack_from(sent, at)
        body = bytes(sent[at + child.HEADER.size :][:size])
        found.append((kind, body[child.ENTRY.size :] if kind == child.MESSAGE else body))
        at += child.HEADER.size + size
    wanted = [(child.MESSAGE, bytes([n % 256]) * size) for n, size in enumerate(sizes)]
    assert found == [*wanted, (child.EVENT, b'{"event": "end"}')]


def test_the_profile_is_there_while_ros_comes_up_and_no_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    environment: dict[str, str] = {"PATH": "x"}
    with qos.default_profile(environment) as is_used:
        assert is_used
        [name] = {environment[variable] for variable in VARIABLES}
        tree = ET.parse(name)
    assert environment == {"PATH": "x"}
    assert not Path(name).exists()
    found = {element.tag.rpartition("}")[2]: element.text for element in tree.iter()}
    assert int(found["receiveBufferSize"] or 0) >= 1 << 17


@pytest.mark.parametrize("name", [*VARIABLES, "FASTDDS_BUILTIN_TRANSPORTS", "ROS2_EASY_MODE"])
def test_what_the_user_has_set_up_is_left_alone(tmp_path: Path, name: str) -> None:
    environment = {name: "theirs"}
    assert qos.is_set_up(environment, tmp_path)
    with qos.default_profile(environment) as is_used:
        assert not is_used
        assert environment == {name: "theirs"}
    assert environment == {name: "theirs"}
    assert not qos.is_set_up({name: ""}, tmp_path)
    (tmp_path / "DEFAULT_FASTDDS_PROFILES.xml").touch()
    assert qos.is_set_up({}, tmp_path)


def test_offers_are_written_as_bags_have_them() -> None:
    text = qos.offered_text(
        [Profile(3, 0, 1, 1, 2**63 - 1, 10_000_000_000, 1, 2**63 - 1), Profile(depth=5)]
    )
    assert text.startswith(
        "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 1\n"
        "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
        "  lifespan:\n    sec: 10\n    nsec: 0\n  liveliness: 1\n"
        "  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
        "  avoid_ros_namespace_conventions: false\n- history: 1\n  depth: 5\n"
    )


def packages(folder: Path, files: dict[str, str]) -> Definitions:
    for name, text in files.items():
        path = folder / "share" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return Definitions([folder / "missing", folder / "share"])


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("c/msg/Top", "package c is not installed"),
        ("a/msg/Nothing", "has no msg/Nothing"),
        ("a/msg/Needy", "package c is not installed"),
        ("a/msg/Wrong", "which is not a type"),
        ("a/msg/../../x", "not a type name"),
        ("../msg/X", "not a type name"),
        ("a/msg/\x1b[31m", "not a type name"),
        ("std_msgs/String", "not a type name"),
        ("", "not a type name"),
    ],
)
def test_types_that_cannot_be_said(tmp_path: Path, name: str, reason: str) -> None:
    definitions = packages(
        tmp_path,
        {"a/msg/Top.msg": "", "a/msg/Needy.msg": "c/X x", "a/msg/Wrong.msg": "a/b/c/d x"},
    )
    with pytest.raises(UnknownTypeError, match=reason):
        definitions.find(name)


class FakeSubscription:
    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self.queue: list[tuple[bytes, dict[str, Any]]] = []
        self.is_closed = False

    def take(self) -> tuple[bytes, dict[str, Any]] | None:
        return self.queue.pop(0) if self.queue else None


class FakeRos:
    def __init__(self) -> None:
        self.graph: dict[tuple[str, str], list[Offer]] = {}
        self.made: list[FakeSubscription] = []

    def publishers(self) -> dict[tuple[str, str], list[Offer]]:
        return self.graph

    def subscribe(self, _topic: str, kind: Any, profile: Profile) -> FakeSubscription:
        if kind.name == "Bad":
            raise ImportError("no Python")
        self.made.append(FakeSubscription(profile))
        return self.made[-1]

    def close_one(self, subscription: FakeSubscription) -> None:
        subscription.is_closed = True

    def wait(self, _seconds: float) -> list[FakeSubscription]:
        return [made for made in self.made if made.queue]

    def wake(self) -> None:
        pass


class Rig:
    def __init__(self, folder: Path) -> None:
        self.ros: Any = FakeRos()
        self.events: list[dict[str, Any]] = []
        self.messages: list[tuple[Any, ...]] = []
        rig = self

        class Box(Outbox):
            def event(self, kind: str, **values: object) -> None:
                rig.events.append({"event": kind, **values})

            def message(self, *message: Any) -> None:
                rig.messages.append(message)

        peer: Any = SimpleNamespace(sendall=lambda _: None)
        self.box: Any = Box(peer)
        found = packages(
            folder,
            {
                "a/msg/T.msg": "int8 i",
                "a/msg/Arrays.msg": "string s\n a/T[] t",
                "a/msg/Bytes.msg": "uint8[] d",
                "a/msg/Bad.msg": "",
            },
        )
        self.child = Child(self.ros, self.box, found)

    def told(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.events if event["event"] == kind]


def offer(gid: bytes = A, node: str = "/n", type_hash: str = "", **profile: int) -> Offer:
    return Offer(gid, node, Profile(**profile), type_hash)  # type: ignore[arg-type]


def info(number: int | None, gid: bytes | None = A, **more: int) -> dict[str, Any]:
    now = time.time_ns()
    known: dict[str, Any] = {"source_timestamp": now, "received_timestamp": now, **more}
    known["publication_sequence_number"] = number
    if gid is not None:
        known["publisher_gid"] = {"data": gid + bytes(8)}
    return known


def live_topic(tmp_path: Path, *offers: Offer, kind: str = "a/msg/T") -> Rig:
    """One topic, subscribed to, after two looks."""
    rig = Rig(tmp_path)
    rig.ros.graph = {("/t", kind): list(offers)}
    rig.child.look()
    rig.child.subscribe("/t", kind)
    rig.child.look()
    return rig


def test_a_subscription_outlives_its_publishers(tmp_path: Path) -> None:
    rig = live_topic(tmp_path, offer())
    rig.ros.graph = {}
    rig.child.look()
    rig.child.look()
    assert len(rig.told("gone")) == 1
    rig.ros.graph = {("/t", "a/msg/T"): [offer(B)]}
    rig.child.look()
    assert len(rig.told("topic")) == 2
    assert len(rig.ros.made) == 1
    assert not rig.ros.made[0].is_closed


def test_a_publisher_that_offers_less_is_heard_too(tmp_path: Path) -> None:
    rig = live_topic(tmp_path, offer())
    rig.ros.made[0].queue = [(b"1", info(1)), (b"2", info(2))]
    rig.ros.graph = {("/t", "a/msg/T"): [offer(), offer(B, reliability=qos.BEST_EFFORT)]}
    rig.child.look()
    old, new = rig.ros.made
    assert new.profile.reliability == qos.BEST_EFFORT
    assert old.is_closed
    # What the old one held was taken before; what came between is counted.
    new.queue = [(b"x", info(1, B)), (b"5", info(5)), (b"6", info(6))]
    rig.child._take(0.0)
    assert [message[1] for message in rig.messages] == [b"1", b"2", b"x", b"5", b"6"]
    assert len(rig.told("channel")) == 2
    rig.child.account(final=True)
    assert [(lost["topic"], lost["count"]) for lost in rig.told("lost")] == [("/t", 2)]


def test_a_topic_that_cannot_be_subscribed_to_again_is_said_to_be_lost(tmp_path: Path) -> None:
    rig = live_topic(tmp_path, offer())
    rig.ros.subscribe = lambda *_: 1 / 0
    rig.ros.graph = {("/t", "a/msg/T"): [offer(), offer(B, reliability=qos.BEST_EFFORT)]}
    rig.child.look()
    rig.child.look()
    rig.child.account(final=True)
    assert "rclpy cannot subscribe: division by zero" in rig.told("say")[0]["text"]
    [lost] = rig.told("lost")
    assert (lost["topic"], lost["cause"], lost["count"]) == ("/t", "unreadable", None)


@pytest.mark.parametrize(
    ("kind", "reason"), [("gone_msgs/msg/T", "not installed"), ("a/msg/Bad", "no Python")]
)
def test_a_type_that_nobody_knows_is_told_and_told_again(
    tmp_path: Path, kind: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = live_topic(tmp_path, offer(), kind=kind)
    [said] = rig.told("say")
    assert reason in said["text"]
    [lost] = rig.told("lost")
    assert (lost["topic"], lost["cause"], lost["count"]) == ("/t", "unreadable", None)
    later = time.monotonic() + 11
    monkeypatch.setattr(child.time, "monotonic", lambda: later)
    rig.child.look()
    assert len(rig.told("lost")) == 2
    rig.ros.graph = {}
    rig.child.look()
    assert len(rig.told("gone")) == 1
    rig.ros.graph = {("/t", kind): [offer()]}
    rig.child.look()
    assert len(rig.told("candidate")) == 2


def test_losses_name_the_publisher(tmp_path: Path) -> None:
    rig = live_topic(tmp_path, offer(node="/one"), offer(B, node="/two"))
    rig.ros.made[0].queue = [
        (b"", info(number, gid)) for number in (1, 2, 3, 7, 8) for gid in (A, B) if number != gid[0]
    ]
    rig.child._take(0.0)
    rig.child.look()
    rig.child.look()
    assert [(lost["count"], lost["detail"]) for lost in rig.told("lost")] == [
        (3, "from /one"),
        (3, "from /two"),
    ]


@pytest.mark.parametrize("late", [[3], [3, 4], [2, 1]])
def test_a_late_message_is_stored_and_no_loss(tmp_path: Path, late: list[int]) -> None:
    rig = live_topic(tmp_path, offer())
    rig.ros.made[0].queue = [(b"", info(number)) for number in (1, 2, 5, *late, 6, 7)]
    rig.child._take(0.0)
    rig.child.account(final=True)
    assert [lost["count"] for lost in rig.told("lost")] == [2]
    assert len(rig.messages) == 5 + len(late)


@pytest.mark.parametrize(
    ("numbers", "missing"), [([*range(1, 12), 14, 15], [2]), ([1, 2, 3, 500, 4, 501, 5, 503], [])]
)
def test_without_names_nobody_is_accused_when_publishers_mix(
    tmp_path: Path, numbers: list[int], missing: list[int]
) -> None:
    rig = live_topic(tmp_path, offer())
    rig.ros.made[0].queue = [(b"", info(number, None)) for number in numbers]
    rig.child._take(0.0)
    rig.child.look()
    rig.child.account(final=True)
    assert [lost["count"] for lost in rig.told("lost")] == missing
    assert {lost["detail"] for lost in rig.told("lost")} <= {"from /n"}
    assert len(rig.messages) == len(numbers)


def test_without_numbers_nothing_is_counted(tmp_path: Path) -> None:
    rig = live_topic(tmp_path, offer())
    rig.ros.made[0].queue = [(b"", info(None))]
    rig.child._take(0.0)
    rig.child.look()
    assert not rig.told("lost")
    assert rig.messages[0][4] == -1
    assert "does not number messages" in rig.told("say")[0]["text"]


def test_times_that_make_no_sense_are_not_believed(tmp_path: Path) -> None:
    rig = live_topic(tmp_path, offer())
    before = time.time_ns()
    rig.ros.made[0].queue = [
        (b"", info(1, received_timestamp=0, source_timestamp=0)),
        (b"", info(2, received_timestamp=before + 3600 * 10**9, source_timestamp=-5)),
        (b"", info(3, received_timestamp=before - 5 * 10**9, source_timestamp=7)),
        (b"", info(4, received_timestamp=2**63, source_timestamp=2**64)),
    ]
    rig.child._take(0.0)
    received = [message[2] for message in rig.messages]
    assert received[2] == before - 5 * 10**9
    assert all(before <= received[at] <= time.time_ns() for at in (0, 1, 3))
    assert [message[3] for message in rig.messages] == [0, 0, 7, 0]


def test_a_message_that_cannot_be_taken_costs_one(tmp_path: Path) -> None:
    rig = live_topic(tmp_path, offer())

    def fail() -> None:
        raise RuntimeError("serialized nonsense")

    rig.ros.made[0].queue = [(b"", {})]
    rig.ros.made[0].take = fail
    rig.child._take(0.0)
    [lost] = rig.told("lost")
    assert (lost["cause"], lost["count"]) == ("unreadable", 1)
    assert "serialized nonsense" in rig.told("say")[0]["text"]


def channels(rig: Rig) -> list[tuple[str, str]]:
    return [(event["hash"], event["definition"]) for event in rig.told("channel")]


def describe(folder: Path, type_hash: str) -> None:
    hashes = [
        {"type_name": "a/msg/Other", "hash_string": "RIHS01_other"},
        {"type_name": "a/msg/T", "hash_string": type_hash},
    ]
    path = folder / "share" / "a" / "msg" / "T.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"type_hashes": hashes}))


def test_each_version_of_a_type_is_a_channel_of_its_own(tmp_path: Path) -> None:
    """While several publish there is no definition that fits."""
    describe(tmp_path, "RIHS01_a")
    one, other = offer(type_hash="RIHS01_a"), offer(B, type_hash="RIHS01_b")
    rig = live_topic(tmp_path, one)
    for number, offers in enumerate([[one], [one, other], [other], [], [one]]):
        rig.ros.graph = {("/t", "a/msg/T"): offers} if offers else {}
        rig.child.look()
        rig.ros.made[0].queue = [(b"", info(number))]
        rig.child._take(0.0)
    assert channels(rig) == [
        ("RIHS01_a", "int8 i"),
        ("", ""),
        ("RIHS01_b", ""),
        ("RIHS01_a", "int8 i"),
    ]
    assert [message[0] for message in rig.messages] == [0, 1, 2, 2, 3]
    [said] = rig.told("say")
    assert "another version of a/msg/T" in said["text"]


def test_another_type_of_a_topic_waits_for_its_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = live_topic(tmp_path, offer())
    real = rig.ros.subscribe

    def subscribe(topic: str, kind: Any, profile: Profile) -> FakeSubscription:
        if not all(made.is_closed for made in rig.ros.made):
            raise RuntimeError("it has another type")
        return real(topic, kind, profile)  # type: ignore[no-any-return]

    rig.ros.subscribe = subscribe
    rig.ros.graph["/t", "a/msg/Bytes"] = [offer(B)]
    rig.child.look()
    rig.child.subscribe("/t", "a/msg/Bytes")
    assert "it has another type" in rig.told("say")[0]["text"]
    assert [(lost["topic"], lost["count"]) for lost in rig.told("lost")] == [("/t", None)]
    del rig.ros.graph["/t", "a/msg/T"]
    rig.child.look()
    later = time.monotonic() + 11
    monkeypatch.setattr(child.time, "monotonic", lambda: later)
    rig.child.look()
    rig.ros.made[1].queue = [(b"x", info(1, B))]
    rig.child._take(0.0)
    assert [message[1] for message in rig.messages] == [b"x"]
    assert not rig.told("gone")


def test_the_child_runs_under_older_pythons_and_with_nothing_installed() -> None:
    for path in [*FOLDER.glob("*.py"), ROOT.joinpath(*GAPS.split(".")).with_suffix(".py")]:
        name = path.stem
        ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 10))
        for used in imports_of(path, f"{CHILD}.{name}"):
            top = used.module.partition(".")[0]
            assert (
                used.typing
                or top in sys.stdlib_module_names
                or used.module.startswith((f"{CHILD}.", GAPS))
                or (name, top) == ("middleware", "rclpy")
            ), f"{name} imports {used.module}"
