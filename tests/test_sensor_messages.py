"""Every type of sensor_msgs, of ROS 1 and ROS 2, and all real logs, through every output."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

import hybridlog as hl
from hybridlog.query.query import Query, channels_of
from hybridlog_storage.messages import Channel, Schema
from tests.data import DATA, needs_data
from tests.every_output import compare_every_output
from tests.ros_values import ROS1, ROS2, message_of, plain_of
from tests.test_real_logs import WHOLE

MESSAGES = 4
TYPES = sorted(
    (ros, name)
    for ros, store in ((1, ROS1), (2, ROS2))
    for name in store.fielddefs
    if name.startswith("sensor_msgs/")
)


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


@pytest.mark.parametrize(("ros", "name"), TYPES)
def test_every_value_in_every_output(store: hl.Store, tmp_path: Path, ros: int, name: str) -> None:
    types = ROS1 if ros == 1 else ROS2
    pairs = sent(ros, name)
    read = types.deserialize_ros1 if ros == 1 else types.deserialize_cdr
    wanted = [plain_of(types, name, read(payload, name)) for _, payload in pairs]
    query = store.topic(topic_of(ros, name))
    compare_every_output(query, wanted, [payload for _, payload in pairs], tmp_path)
    assert query.counters.unreadable == 0


LOGS = [DATA / name for name in WHOLE]
BLOCK = 1 << 20  # payload bytes that are compared at once


@pytest.mark.exhaustive
@pytest.mark.timeout(7200)
@needs_data
@pytest.mark.parametrize("path", LOGS, ids=lambda path: str(path.relative_to(DATA)))
def test_every_value_of_real_logs(tmp_path: Path, path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        entry = store.record(path).entry
        for topic in sorted({c.topic for c in entry.channels if c.stats.messages}):
            query = store.topic(topic)
            channel = channels_of(query)[0]
            schema = channel.channel.schema
            if {other.channel.schema for other in channels_of(query)} != {schema}:
                continue
            if schema is None or channel.codec.reason is not None:
                continue
            if channel.channel.message_encoding not in {"ros1", "cdr"}:
                continue
            try:
                types, name = types_of(schema)
            except TypesysError:
                continue  # a service, which rosbags does not parse
            read = types.deserialize_cdr
            if channel.channel.message_encoding == "ros1":
                read = types.deserialize_ros1
            for number, block in enumerate(blocks(query)):
                raw = [message.raw for message in block]
                wanted = [plain_of(types, name, read(payload, name)) for payload in raw]
                folder = tmp_path / f"{topic.replace('/', '_')}{number}"
                folder.mkdir()
                compare_every_output(block, wanted, raw, folder)


def types_of(schema: Schema) -> tuple[Typestore, str]:
    """A definition as rosbags reads it, and the name of its type."""
    stores = {"ros1msg": Stores.ROS1_NOETIC, "ros2msg": Stores.ROS2_KILTED}
    standard = get_typestore(stores.get(schema.encoding, Stores.ROS2_KILTED)).fielddefs
    types = get_typestore(Stores.EMPTY)
    parts = schema.name.split("/")
    name = f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else schema.name
    text = schema.data.decode()
    found = get_types_from_idl(text) if "idl" in schema.encoding else get_types_from_msg(text, name)
    found = {**standard, **found}
    types.register({key: value for key, value in found.items() if key not in types.fielddefs})
    return types, name


def blocks(query: Query) -> Iterator[Query]:
    """A question in parts of about `BLOCK` bytes, between times at which a message came."""
    held, first, last = 0, None, None
    for message in query:
        if first is None:
            first = message.log_time_ns
        elif held >= BLOCK and message.log_time_ns != last:
            yield query.between(first, message.log_time_ns)
            held, first = 0, message.log_time_ns
        held += len(message.raw)
        last = message.log_time_ns
    if first is not None and last is not None:
        yield query.between(first, last + 1)


def test_all_types_are_there() -> None:
    assert len(TYPES) >= 54
    assert {ros for ros, _ in TYPES} == {1, 2}
