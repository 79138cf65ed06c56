"""The tree of a message against its values, and lines of text logs against those written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.drawing.tree import MAX_NODES, MAX_SHOWN, MAX_TEXT, tree
from hybridlog.view.routes.pictures import beside
from tests.odd_messages import HOSTILE, LOGS, LONG, MS, START, ros_channel
from tests.ros_values import ROS1, ROS2, message_of, plain_of


def at(odd: hl.Store, topic: str, second: float) -> Any:
    return odd.topic(topic).at(START + int(second * 1000) * MS)


def named(node: Any) -> dict[str, Any]:
    return {item["name"]: item for item in node["items"]}


def nodes_of(node: Any) -> int:
    return 1 + sum(map(nodes_of, node.get("items", ())))


def test_every_kind_of_field_has_its_exact_text(odd: hl.Store) -> None:
    found = named(tree(at(odd, "/own", 3)))
    texts = {name: (node["type"], node["text"]) for name, node in found.items() if "text" in node}
    assert texts == {
        "ok": ("bool", "false"),
        "id": ("uint64", "18446744073709551612"),
        "ratio": ("float32", "0.3"),
        "name": ("string", "name 3"),
        "at": ("time", "2025-06-03T08:00:03.000000005Z"),
        "took": ("duration", "-2.5 s"),
    }
    assert found["axis"]["texts"] == ["3", "nan", "-inf"]
    assert found["axis"]["type"] == "float64[3]"
    assert found["flags"]["texts"] == ["true", "false"]
    assert [node["text"] for node in found["words"]["items"]] == ["w", ""]
    assert found["data"]["type"] == f"uint8[{LONG}]"
    assert found["path"]["n"] == 40
    assert named(found["path"]["items"][2])["x"]["text"] == "2.375"


def test_long_arrays_are_shown_in_parts(odd: hl.Store) -> None:
    message = at(odd, "/own", 0)
    whole = tree(message)
    place = [item["name"] for item in whole["items"]].index("data")
    first = whole["items"][place]
    assert (first["begin"], first["n"], len(first["texts"])) == (0, LONG, 64)
    part = tree(message, [place], begin=4000, count=500)
    assert part["texts"] == [str(k * 7 % 256) for k in range(4000, 4500)]
    assert tree(message, [place], begin=LONG - 2, count=9)["texts"] == [
        str(k * 7 % 256) for k in (LONG - 2, LONG - 1)
    ]
    assert len(tree(message, [place], count=10**9)["texts"]) == MAX_SHOWN
    assert tree(message, [place], begin=10**15)["texts"] == []
    assert tree(message, [place, 4001])["text"] == str(4001 * 7 % 256)
    path = [item["name"] for item in whole["items"]].index("path")
    assert len(whole["items"][path]["items"]) == 16
    part = tree(message, [path], begin=38, count=5)
    assert [named(point)["x"]["text"] for point in part["items"]] == ["38", "39"]


def test_json_is_shown_as_it_is(odd: hl.Store) -> None:
    found = named(tree(at(odd, "/loose", 0)))
    assert found["<b>"]["text"] == "<script>alert(1)</script>"
    assert found["big"]["text"] == str(2**70)
    assert found["exact"]["text"] == "9007199254740993"
    assert found["none"]["text"] == "null"
    assert (found["empty"]["n"], found["empty"]["items"]) == (0, [])
    assert (found["nothing"]["n"], found["nothing"]["items"]) == (0, [])
    assert found["1.5"]["text"] == "1.5"
    assert found["lone"]["text"] == "?"
    kinds = [item.get("text", item.get("n")) for item in found["mixed"]["items"]]
    assert kinds == ["1", "a", "null", 1, 1]
    # Elements that lack a field lack it here.
    assert [list(named(item)) for item in found["mixed"]["items"][3:]] == [["k"], ["other"]]
    assert tree(at(odd, "/loose", 4))["items"][0]["name"] == "value"


def test_an_answer_is_bounded(odd: hl.Store) -> None:
    deep, many, grid = (tree(at(odd, "/loose", second)) for second in (1, 2, 3))
    for one in (deep, many, grid):
        assert nodes_of(one) <= MAX_NODES + 1
        assert len(json.dumps(one)) < 1 << 20
        assert named(one)["n"]["type"] == "integer"  # the last field is there all the same
    path: list[int] = []
    node = deep
    for _ in range(200):
        if not node.get("items"):
            if "text" in node:
                break
            node = tree(at(odd, "/loose", 1), path)  # closed: asked for on its own
            continue
        path.append(0)
        node = node["items"][0]
    assert (node["text"], len(path)) == ("bottom", 121)
    keys = named(many)["many"]
    assert (keys["n"], len(keys["items"])) == (3000, MAX_SHOWN)
    rest = tree(at(odd, "/loose", 2), [0], begin=2990)
    assert [item["name"] for item in rest["items"]] == [f"key {n}" for n in range(2990, 3000)]


def _compare(node: Any, value: Any) -> None:
    if isinstance(value, dict):
        items = named(node)
        assert list(items) == list(value)
        for name, inner in value.items():
            _compare(items[name], inner)
    elif isinstance(value, list | bytes | np.ndarray):
        assert node["n"] == len(value)
        shown = node["texts"] if "texts" in node else node["items"]
        for item, inner in zip(shown, value, strict=False):
            _compare({"text": item} if isinstance(item, str) else item, inner)
    elif node.get("type") not in {"time", "duration"}:
        text = node["text"]
        if isinstance(value, bool):
            assert text == str(value).lower()
        elif isinstance(value, int | float):
            kind = np.float32 if node.get("type") == "float32" else type(value)
            assert str(kind(text)) == str(kind(value)) or float(text) == float(value)
        else:
            assert text == value[:MAX_TEXT]


def test_random_messages(tmp_path: Path) -> None:
    wanted: dict[str, list[Any]] = {}
    with hl.open(tmp_path / "store", create=True) as opened:
        with opened.start("random") as recording:
            for ros, types in ((1, ROS1), (2, ROS2)):
                write = types.serialize_ros1 if ros == 1 else types.serialize_cdr
                read = types.deserialize_ros1 if ros == 1 else types.deserialize_cdr
                for name in ("sensor_msgs/msg/JointState", "diagnostic_msgs/msg/DiagnosticArray"):
                    topic = f"/ros{ros}/{name}"
                    channel = ros_channel(topic, name, ros)
                    for seed in range(6):
                        message = message_of(types, name, np.random.default_rng(seed))
                        payload = bytes(write(message, name))
                        recording.write(channel, payload, log_time=START + seed)
                        value = plain_of(types, name, read(payload, name))
                        wanted.setdefault(topic, []).append(value)
        for topic, values in wanted.items():
            for found, value in zip(opened.query([topic]), values, strict=True):
                _compare(tree(found), value)


@pytest.mark.parametrize("topic", ["/rosout", "/rosout2", "/fox", HOSTILE])
def test_pages_of_rows_meet_without_missing_or_repeating_one(odd: hl.Store, topic: str) -> None:
    """Pages of 7, while 5 messages share each time."""
    query = odd.query([topic])
    want = [(one.log_time_ns, one.seq) for one in query]
    assert len(want) >= len(LOGS)
    found: list[tuple[int, int]] = []
    place = 0, -1
    while page := [(one.log_time_ns, one.seq) for one in beside(query, *place, 7)]:
        found += page
        place = page[-1]
    assert found == want
    found, place = [], (want[-1][0] + 1, 0)
    while page := [(m.log_time_ns, m.seq) for m in beside(query, *place, 7, before=True)]:
        found = page + found
        place = page[0]
    assert found == want
