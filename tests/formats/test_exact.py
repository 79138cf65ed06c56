from __future__ import annotations

import os
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader, make_reader
from msgspec.structs import replace
from rosbags.rosbag1 import Reader

from hybridlog.formats.mcap.writer import McapWriter
from hybridlog.formats.rosbag1.writer import BagWriter
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel
from tests.formats.batches import STRING, batch, many, ros1_channels
from tests.formats.test_mcap import Seen, official


def test_mcap_carries_everything(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    channels = [*ros1_channels(), Channel("plain", "json", None), Channel("plain", "", None)]
    first, second = many(400, channels=5), many(300, channels=5, start=2 * 10**18)
    with McapWriter(path, profile="ros1") as writer:
        writer.write(first, channels)
        # The same channels again as other objects, in another order.
        turned = [Channel(c.topic, c.message_encoding, c.schema, c.metadata) for c in channels][
            ::-1
        ]
        second.channel[:] = 4 - second.channel
        writer.write(replace(second, buffer=memoryview(bytearray(second.buffer))), turned)
    second.channel[:] = 4 - second.channel
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        assert header.profile == "ros1"
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 700
        assert len(summary.channels) == 5
        assert len(summary.schemas) == 2
        assert all(index.compression == "zstd" for index in summary.chunk_indexes)
    assert official(path) == [
        Seen(
            one.topic,
            one.message_encoding,
            one.schema and (one.schema.name, one.schema.encoding, one.schema.data),
            tuple(sorted((k, v) for k, v in one.metadata.items() if k != "hybridlog.x")),
            int(source.log_time[row]),
            int(source.publish_time[row]),
            int(source.sequence[row]),
            bytes(source.payload(row)),
        )
        for source in (first, second)
        for row in range(len(source))
        for one in [channels[source.channel[row]]]
    ]


def test_bag_carries_everything(tmp_path: Path) -> None:
    path = tmp_path / "out.bag"
    channels = ros1_channels()
    # Enough for several chunks of a mebibyte.
    source = batch(
        [bytes([row % 251]) * 9_000 for row in range(300)],
        [row % 3 for row in range(300)],
        [10**18 + row for row in range(300)],
    )
    with BagWriter(path) as writer:
        writer.write(source.take(slice(0, 150)), channels)
        writer.write(source.take(slice(150, 300)), ros1_channels())
    content = path.read_bytes()
    assert b"# caf\xe9, in Latin-1" in content
    assert b"hybridlog" not in content
    # rosbags wants definitions in UTF-8; the bytes of the Latin-1 one were seen above.
    path.write_bytes(content.replace(b"caf\xe9", b"cafe"))
    with Reader(path) as reader:
        assert reader.message_count == 300
        assert len(reader.connections) == 3
        found = sorted(reader.messages(), key=lambda item: item[1])
        for row, (connection, time, data) in enumerate(found):
            original = channels[source.channel[row]]
            assert time == source.log_time[row]
            assert data == source.payload(row)
            assert connection.topic == original.topic
            assert connection.digest == original.metadata["md5sum"]
            assert connection.ext.callerid == original.metadata.get("callerid")  # type: ignore[union-attr]
            assert connection.ext.latching == (  # type: ignore[union-attr]
                1 if "latching" in original.metadata else None
            )


@pytest.mark.parametrize(
    ("channel", "time", "message"),
    [
        (Channel("/a", "cdr", STRING), 5, "--format mcap"),
        (Channel("/a", "ros1", None), 5, "without a definition"),
        (ros1_channels()[0], 2**32 * 10**9, "2106"),
    ],
)
def test_what_a_bag_cannot_hold(tmp_path: Path, channel: Channel, time: int, message: str) -> None:
    with pytest.raises(UsageError, match=message), BagWriter(tmp_path / "out.bag") as writer:
        writer.write(batch([b"x"], [0], [time]), [channel])
    assert list(tmp_path.iterdir()) == []


def test_mcap_to_a_pipe_is_read_without_seeking() -> None:
    read, write = os.pipe()
    with open(write, "wb", buffering=0) as pipe, McapWriter(pipe) as writer:  # noqa: PTH123
        writer.write(many(100), ros1_channels())
    with open(read, "rb") as stream:  # noqa: PTH123
        assert len(list(NonSeekingReader(stream).iter_messages())) == 100
