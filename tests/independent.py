"""Logs as other people's readers see them: the `rosbags` and `mcap` packages."""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from hybridlog_storage.messages import Channel, Schema


class Seen(NamedTuple):
    """One message."""

    topic: str
    log_time: int
    payload: bytes


def read(path: Path) -> list[Seen]:
    """Every message of a log, in no particular order."""
    if path.is_dir():
        return [m for p in sorted(path.iterdir()) if p.suffix in {".db3", ".mcap"} for m in read(p)]
    if path.suffix == ".mcap":
        return read_mcap(path)
    if path.suffix == ".db3":
        return read_sqlite(path)
    return read_bag(path)


def read_bag(path: Path) -> list[Seen]:
    """A ROS 1 bag; topic names as the bag spells them."""
    from rosbags.rosbag1 import Reader

    with Reader(path) as reader:
        return [Seen(c.topic, t, bytes(data)) for c, t, data in reader.messages()]


def read_mcap(path: Path) -> list[Seen]:
    """An MCAP file."""
    from mcap.reader import make_reader

    reader = make_reader(io.BytesIO(path.read_bytes()))
    return [Seen(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]


def read_sqlite(path: Path) -> list[Seen]:
    """A ROS 2 sqlite3 bag, by SQL."""
    connection = sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)
    try:
        rows = connection.execute(
            "SELECT t.name, m.timestamp, m.data FROM messages m JOIN topics t ON t.id = m.topic_id"
        ).fetchall()
    finally:
        connection.close()
    return [Seen(topic, time, bytes(data)) for topic, time, data in rows]


def write_mcap(
    path: Path,
    said: Iterable[tuple[Any, ...]],
    silent: Iterable[Channel] = (),
    attachments: Iterable[tuple[int, int, str, str, bytes]] = (),
    **options: Any,
) -> Path:
    """An MCAP file of messages: channel, log time and payload of each, and its publish time.

    Channels that may be silent come first, attachments last.
    """
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        schemas: dict[Schema | None, int] = {None: 0}
        ids: dict[Channel, int] = {}

        def id_of(channel: Channel) -> int:
            kind = channel.schema
            if kind is not None and kind not in schemas:
                schemas[kind] = writer.register_schema(kind.name, kind.encoding, kind.data)
            if channel not in ids:
                about = (channel.topic, channel.message_encoding, schemas[kind])
                ids[channel] = writer.register_channel(*about, dict(channel.metadata))
            return ids[channel]

        for channel in silent:
            id_of(channel)
        for channel, time, payload, *publish in said:
            writer.add_message(id_of(channel), time, payload, *(publish or [time]))
        for attachment in attachments:
            writer.add_attachment(*attachment)
        writer.finish()
    return path
