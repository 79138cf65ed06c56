"""Events of services, and messages of actions, as rosbag2 records them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from tests.formats.test_rosbag2 import MESSAGES, TOPICS, database
from tests.independent import write_mcap
from tests.schema.test_definition import DUMMY

CASES = Path(__file__).parents[1] / "cases"
RULE = "=" * 80 + "\n"
BASE = 1_700_000_000 * 10**9
# As in the packages, with their comments and empty lines; rosbag2 stores files as they are,
# behind a header line, and then what they refer to.
TRIGGER = """\
---
bool success   # indicate successful run of triggered service
string message # informational, e.g. for error messages
"""
FIBONACCI = """\
# Goal
int32 order
geometry_msgs/Point start
---
# Result
int32[] sequence
---
# Feedback
int32[] partial_sequence
my_pkg/Region region
"""
REGION = "# corners\ngeometry_msgs/Point low\ngeometry_msgs/Point high\n\nuint32 UNKNOWN=0\n"
POINT = "# This contains the position of a point in free space\nfloat64 x\nfloat64 y\nfloat64 z\n"
NESTED = f"\n{RULE}MSG: my_pkg/msg/Region\n{REGION}\n{RULE}MSG: geometry_msgs/msg/Point\n{POINT}"
TEXTS = {
    "std_srvs/srv/Trigger": f"{RULE}SRV: std_srvs/srv/Trigger\n{TRIGGER}",
    "my_pkg/action/Fibonacci": f"{RULE}ACTION: my_pkg/action/Fibonacci\n{FIBONACCI}{NESTED}",
}


def _types() -> Any:
    """The derived types, written out by hand."""
    store = get_typestore(Stores.ROS2_KILTED)
    trigger = TRIGGER.split("---\n")
    goal, result, feedback = FIBONACCI.split("---\n")
    uuid = "unique_identifier_msgs/UUID goal_id\n"
    texts = {
        "my_pkg/msg/Region": REGION,
        "std_srvs/srv/Trigger_Request": f"uint8 {DUMMY}\n",
        "std_srvs/srv/Trigger_Response": trigger[1],
        "my_pkg/action/Fibonacci_Goal": goal,
        "my_pkg/action/Fibonacci_Result": result,
        "my_pkg/action/Fibonacci_Feedback": feedback,
        "my_pkg/action/Fibonacci_FeedbackMessage": uuid
        + "my_pkg/action/Fibonacci_Feedback feedback\n",
        "my_pkg/action/Fibonacci_SendGoal_Request": uuid + "my_pkg/action/Fibonacci_Goal goal\n",
        "my_pkg/action/Fibonacci_SendGoal_Response": "bool accepted\n"
        "builtin_interfaces/Time stamp\n",
        "my_pkg/action/Fibonacci_GetResult_Request": uuid,
        "my_pkg/action/Fibonacci_GetResult_Response": "int8 status\n"
        "my_pkg/action/Fibonacci_Result result\n",
    }
    for name in list(texts):
        if name.endswith("_Request"):
            stem = name.removesuffix("_Request")
            texts[f"{stem}_Event"] = (
                "service_msgs/ServiceEventInfo info\n"
                f"{stem}_Request[<=1] request\n{stem}_Response[<=1] response\n"
            )
    for name, text in texts.items():
        if _own(name) not in store.fielddefs:
            store.register(get_types_from_msg(_own(text), _own(name)))
    return store


def _own(text: str) -> str:
    """Names of types as rosbags takes them."""
    return text.replace("/srv/", "/msg/")


STORE = _types()
T = STORE.types


def _point(x: float) -> Any:
    return T["geometry_msgs/msg/Point"](x=x, y=0.0, z=-x)


def _region(x: float) -> Any:
    return T["my_pkg/msg/Region"](low=_point(x), high=_point(x + 1))


def _event(stem: str, number: int, request: Any, response: Any) -> tuple[str, bytes]:
    info = T["service_msgs/msg/ServiceEventInfo"](
        event_type=number,
        stamp=T["builtin_interfaces/msg/Time"](sec=-1, nanosec=number),
        client_gid=np.arange(16, dtype=np.uint8),
        sequence_number=7,
    )
    kind = f"{stem}_Event"
    message = T[_own(kind)](
        info=info,
        request=[request] if number in {0, 1} else [],
        response=[response] if number in {2, 3} else [],
    )
    return kind, bytes(STORE.serialize_cdr(message, _own(kind)))


def _messages() -> Iterator[tuple[str, str, bytes]]:
    """Topic, type and payload."""
    uuid = T["unique_identifier_msgs/msg/UUID"](uuid=np.arange(16, dtype=np.uint8))
    fibonacci = "my_pkg/action/Fibonacci"
    for number in range(4):
        request = T["std_srvs/msg/Trigger_Request"](**{DUMMY: 0})
        response = T["std_srvs/msg/Trigger_Response"](success=True, message="done")
        yield "/trigger/_service_event", *_event("std_srvs/srv/Trigger", number, request, response)
        goal = T[f"{fibonacci}_Goal"](order=number, start=_point(2.0))
        request = T[f"{fibonacci}_SendGoal_Request"](goal_id=uuid, goal=goal)
        time = T["builtin_interfaces/msg/Time"](sec=3, nanosec=4)
        response = T[f"{fibonacci}_SendGoal_Response"](accepted=True, stamp=time)
        topic = "/fibonacci/_action/send_goal/_service_event"
        yield topic, *_event(f"{fibonacci}_SendGoal", number, request, response)
        result = T[f"{fibonacci}_Result"](sequence=np.array([0, 1, number], np.int32))
        request = T[f"{fibonacci}_GetResult_Request"](goal_id=uuid)
        response = T[f"{fibonacci}_GetResult_Response"](status=4, result=result)
        topic = "/fibonacci/_action/get_result/_service_event"
        yield topic, *_event(f"{fibonacci}_GetResult", number, request, response)
        feedback = T[f"{fibonacci}_Feedback"](
            partial_sequence=np.arange(number, dtype=np.int32), region=_region(5)
        )
        kind = f"{fibonacci}_FeedbackMessage"
        message = T[kind](goal_id=uuid, feedback=feedback)
        yield "/fibonacci/_action/feedback", kind, bytes(STORE.serialize_cdr(message, kind))


def _interface(kind: str) -> str:
    return next(name for name in TEXTS if kind.startswith(f"{name}_"))


def _mcap(path: Path) -> None:
    channels: dict[str, Channel] = {}
    said = []
    for number, (topic, kind, data) in enumerate(_messages()):
        schema = Schema(kind, "ros2msg", TEXTS[_interface(kind)].encode())
        channel = channels.setdefault(topic, Channel(topic, "cdr", schema))
        said.append((channel, BASE + number, data, BASE))
    write_mcap(path, said)


def _db3(path: Path) -> None:
    """The definition lies under the name of the service or action."""
    messages = [*_messages()]
    kinds = {topic: kind for topic, kind, _ in messages}
    topics = {topic: number for number, topic in enumerate(kinds, 1)}
    database(
        path,
        "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)",
        "INSERT INTO schema VALUES(4, 'kilted')",
        TOPICS,
        MESSAGES,
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, "
        "encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)",
        *(f"INSERT INTO topics VALUES({topics[t]}, '{t}', '{kinds[t]}', 'cdr')" for t in topics),
        *(
            f"INSERT INTO message_definitions VALUES({n}, '{name}', 'ros2msg', '{text}', '')"
            for n, (name, text) in enumerate(TEXTS.items())
        ),
        rows=[(n + 1, topics[t], BASE + n, data) for n, (t, _, data) in enumerate(messages)],
    )


@pytest.mark.parametrize("name", ["events.mcap", "events.db3"])
def test_services_and_actions(tmp_path: Path, name: str) -> None:
    (_mcap if name.endswith("mcap") else _db3)(tmp_path / name)
    with hl.open(tmp_path / "store", create=True) as store:
        report = store.record(tmp_path / name)
        assert not report.damage
        assert report.entry.messages == 16

        def rows(topic: str) -> list[Any]:
            found = [message.fields for message in store.topic(topic)]
            types = [m["info"]["event_type"] for m in found if "info" in m]
            assert types == [0, 1, 2, 3][: len(types)]
            return found

        trigger = rows("/trigger/_service_event")
        assert [len(m["request"]) for m in trigger] == [1, 1, 0, 0]
        assert trigger[3]["response"] == [{"success": True, "message": "done"}]
        assert trigger[2]["info"]["stamp"] == 2 - 10**9
        sent = rows("/fibonacci/_action/send_goal/_service_event")
        assert sent[1]["request"][0]["goal"]["order"] == 1
        assert sent[1]["request"][0]["goal_id"]["uuid"] == list(range(16))
        assert sent[2]["response"] == [{"accepted": True, "stamp": 3 * 10**9 + 4}]
        got = rows("/fibonacci/_action/get_result/_service_event")
        assert got[3]["response"] == [{"status": 4, "result": {"sequence": [0, 1, 3]}}]
        feedback = rows("/fibonacci/_action/feedback")
        assert feedback[2]["feedback"]["partial_sequence"] == [0, 1]
        assert feedback[0]["feedback"]["region"]["low"]["x"] == 5.0
        query = store.topic("/fibonacci/_action/send_goal/_service_event")
        assert query.where("request.goal.order >= 1").count() == 1
        assert query.to_arrow().num_rows == 4


def test_the_log_of_a_service_event(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        report = store.record(CASES / "rosbag2_2365_srv_event.mcap")
        assert report.entry.messages == 5
        found = [message.fields for message in store.topic("/add/_service_event")]
        assert [m["info"]["event_type"] for m in found] == [0, 1, 2, 3, 0]
        assert found[0]["request"] == [{"a": 3, "b": 4}]
        assert found[2]["response"] == [{"sum": 7}]
        table = store.topic("/add/_service_event").to_arrow()
        assert table["info.event_type"].to_pylist() == [0, 1, 2, 3, 0]
