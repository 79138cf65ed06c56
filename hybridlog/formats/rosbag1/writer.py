"""Writes ROS 1 bags with unchanged messages and the connection headers of the source."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast

from rosbags.rosbag1.reader import RecordType
from rosbags.rosbag1.writer import Header, WriteChunk
from rosbags.rosbag1.writer import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hybridlog.formats.mcap.writer import source_metadata
from hybridlog.formats.writing import Answer, LogWriter, Target, destination, failures, path_of
from hybridlog_storage.disk.files import beside
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

    from hybridlog_storage.messages import Batch, Channel, Schema

_TIME_LIMIT = 2**32 * 10**9
_LARGEST_DEFINITION = 256 << 10


def write_bag(answer: Answer, target: Target) -> None:
    """Write one ROS 1 bag."""
    with BagWriter(target) as bag:
        bag.write_answer(answer)


class BagWriter(LogWriter):
    """Writes one ROS 1 bag, version 2.0, with its index.

    Only channels of ROS 1 messages (`message_encoding` is `ros1`) fit into a bag. Its header is
    written last, so it is no stream.
    """

    def __init__(self, target: Target) -> None:
        path = path_of(target, "bag", "a file")
        self._connections: dict[tuple[object, ...], Connection] = {}
        self._name = os.fspath(path)
        with failures(self._name):
            self._final, is_file = destination(path)
            if not is_file:
                raise UsageError(f"bag is no stream, as {path} is: name a file with -o.")
            self._unfinished = beside(self._final)
            self._writer = _ExactWriter(self._unfinished.path)
            self._writer.open()

    def write(self, batch: Batch, channels: Sequence[Channel]) -> None:
        """Append messages in the order of the rows."""
        if len(batch) == 0:
            return
        if int(batch.log_time.max()) >= _TIME_LIMIT or int(batch.log_time.min()) < 0:
            raise UsageError(
                "a ROS 1 bag holds times from 1970 to 2106 only, and a message lies outside; "
                "write --format mcap"
            )
        view = memoryview(batch.buffer)
        with failures(self._name):
            connections = {
                number: self._connection(channels[number]) for number in set(batch.channel.tolist())
            }
            write = self._writer.write
            for channel, start, length, log_time in zip(
                batch.channel.tolist(),
                batch.offset.tolist(),
                batch.length.tolist(),
                batch.log_time.tolist(),
                strict=True,
            ):
                write(connections[channel], log_time, view[start : start + length])

    def declare(self, channels: Sequence[Channel]) -> None:
        """Add channels, which need have no messages; those that fit into no bag are left out."""
        with failures(self._name):
            for channel in channels:
                if channel.message_encoding == "ros1" and channel.schema is not None:
                    self._connection(channel)

    def _connection(self, channel: Channel) -> Connection:
        """The connection of a channel; channels that a bag tells alike share one."""
        schema = channel.schema
        if channel.message_encoding != "ros1" or schema is None:
            raise UsageError(
                f"{channel.topic} has {channel.message_encoding or 'unknown'} messages"
                f"{'' if schema else ' without a definition'}, and a ROS 1 bag holds "
                "ROS 1 messages only; nothing is converted, so that every byte stays as it "
                "came: write --format mcap"
            )
        metadata = source_metadata(channel)
        said = (metadata.get(name) for name in ("md5sum", "callerid", "latching"))
        key = (channel.topic, schema.name, schema.data, *said)
        if key not in self._connections:
            md5sum = metadata.get("md5sum") or _md5sum(schema)
            self._connections[key] = self._writer.add(channel.topic, schema, md5sum, metadata)
        return self._connections[key]

    def commit(self) -> None:
        """Complete the bag."""
        with failures(self._name):
            self._writer.close()
            with self._unfinished.path.open("rb") as file:
                os.fsync(file.fileno())
            self._unfinished.publish(self._final)

    def abort(self) -> None:
        """Remove the file."""
        with suppress(OSError):
            self._writer.abort()
        self._unfinished.remove()


class _ExactWriter(RosbagsWriter):
    """The rosbags writer with unchanged connection headers and bounded memory."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._headers: list[tuple[str, Header]] = []

    def add(self, topic: str, schema: Schema, md5sum: str, metadata: dict[str, str]) -> Connection:
        """Add a connection with the unchanged bytes of its definition."""
        header = Header()
        header.set_string("topic", topic)
        header.set_string("type", schema.name)
        header.set_string("md5sum", md5sum)
        header["message_definition"] = schema.data
        for key, value in metadata.items():
            # A field of a bag header is `key=value`.
            if key and "=" not in key and key not in header:
                header.set_string(key, value)
        self._headers.append((topic, header))
        latching = metadata.get("latching", "")
        return self.add_connection(
            topic,
            schema.name,
            msgdef=schema.data.decode(errors="replace"),
            md5sum=md5sum,
            callerid=metadata.get("callerid"),
            # Only distinguishes connections; the header has the unchanged text.
            latching=int.from_bytes(latching.encode()) if latching else None,
        )

    # In rosbags this static method builds the header from the connection's fields.
    def write_connection(self, connection: Connection, bio: BinaryIO) -> None:  # type: ignore[override]
        """Write a connection record with the unchanged header."""
        topic, fields = self._headers[connection.id]
        header = Header()
        header.set_uint32("conn", connection.id)
        header.set_string("topic", topic)
        header.write(bio, RecordType.CONNECTION)
        fields.write(bio)

    def write_chunk(self, chunk: WriteChunk) -> None:
        """Write a chunk; store only the counts of its index, for the end of the bag."""
        super().write_chunk(chunk)
        for number, entries in chunk.connections.items():
            counted = cast("list[tuple[int, int]]", range(len(entries)))
            chunk.connections[number] = counted


def _md5sum(schema: Schema) -> str:
    """The ROS 1 hash of a definition; `*`, which matches any, if it cannot be computed."""
    if len(schema.data) > _LARGEST_DEFINITION or "/" not in schema.name:
        return "*"
    package, _, name = schema.name.replace("/msg/", "/").partition("/")
    kind = f"{package}/msg/{name}"
    try:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema.data.decode(), kind))
        return store.generate_msgdef(kind)[1]
    except Exception:  # any error of the parser for a hostile definition
        return "*"
