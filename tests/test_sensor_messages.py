"""Every type of sensor_msgs, of ROS 1 and ROS 2, through every output."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from tests.every_output import compare_every_output
from tests.ros_values import ROS1, ROS2, message_of, plain_of
from tests.some import EXHAUSTIVE

MESSAGES = 4
TYPES = sorted(
    (ros, name)
    for ros, store in ((1, ROS1), (2, ROS2))
    for name in store.fielddefs
    if name.startswith("sensor_msgs/")
)
SOME = [
    pytest.param(*one, marks=EXHAUSTIVE if number % 3 else []) for number, one in enumerate(TYPES)
]


def topic_of(ros: int, name: str) -> str:
    return f"/ros{ros}/{name.rpartition('/')[2]}"


def sent(ros: int, name: str) -> list[tuple[Any, bytes]]:
    """Messages of a type, as rosbags has them, and their payloads."""
    store = ROS1 if ros == 1 else ROS2
    found = []
    for seed in range(MESSAGES):
        message = message_of(store, name, np.random.default_rng([seed, len(name)]))
        write = store.serialize_ros1 if ros == 1 else store.serialize_cdr
        found.append((message, bytes(write(message, name))))
    return found


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("sensors") / "store", create=True) as opened:
        with opened.start("sensors") as recorder:
            for ros, name in TYPES:
                types = ROS1 if ros == 1 else ROS2
                text = types.generate_msgdef(name, ros_version=ros)[0].encode()
                spelled = name.replace("/msg/", "/") if ros == 1 else name
                encoding = "ros1" if ros == 1 else "cdr"
                channel = Channel(
                    topic_of(ros, name), encoding, Schema(spelled, f"ros{ros}msg", text)
                )
                for at, (_, payload) in enumerate(sent(ros, name)):
                    recorder.write(channel, payload, log_time=10**18 + at)
        yield opened


@pytest.mark.parametrize(("ros", "name"), SOME)
def test_every_value_in_every_output(store: hl.Store, tmp_path: Path, ros: int, name: str) -> None:
    types = ROS1 if ros == 1 else ROS2
    pairs = sent(ros, name)
    read = types.deserialize_ros1 if ros == 1 else types.deserialize_cdr
    wanted = [plain_of(types, name, read(payload, name)) for _, payload in pairs]
    query = store.topic(topic_of(ros, name))
    compare_every_output(query, wanted, [payload for _, payload in pairs], tmp_path)
    assert query.counters.unreadable == 0
