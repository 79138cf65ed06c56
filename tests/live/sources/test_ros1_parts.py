"""The parts of the ROS 1 source by themselves: headers, addresses, counting, cutting."""

from __future__ import annotations

import random
import select
import socket
import struct

import pytest

from hybridlog.live.sources.base import Cause, PeerError, endpoint_of, one_line
from hybridlog.live.sources.ros1.source import (
    channel_of,
    decode_header,
    encode_header,
)
from hybridlog.live.sources.ros1.stream import Stream
from hybridlog.live.sources.sequence_gaps import has_sequence_numbers
from hybridlog_storage.messages import Channel, Schema
from tests.live.sources.ros1_peers import Collector, framed

# Headers


def test_any_bytes_are_a_header_or_an_error() -> None:
    draw = random.Random(1)
    whole = encode_header({"callerid": "/a", "type": "std_msgs/String", "md5sum": "*"})[4:]
    for _ in range(2000):
        body = bytearray(whole)
        for _ in range(draw.randrange(4)):
            body[draw.randrange(len(body))] = draw.randrange(256)
        try:
            fields = decode_header(bytes(body[: draw.randrange(len(body) + 1)]))
        except PeerError:
            continue
        channel_of("/t", fields)


@pytest.mark.parametrize(
    ("definition", "numbered"),
    [
        ("Header header\nfloat32 x\n", True),
        ("std_msgs/Header header", True),
        (
            "# a comment: Foo bar\n\n  \nint8 A=1\nstring B=Header header\n\tHeader  header # c",
            True,
        ),
        ("float32 x\nHeader header\n", False),
        ("Header head\n", False),
        ("Header[] header\n", False),
        ("uint32 seq\ntime stamp\nstring frame_id\n", False),
        ("", False),
        ("\n=====\nMSG: std_msgs/Header\nHeader header", False),
        ("#" * 10000, False),
    ],
)
def test_types_that_publishers_number(definition: str, numbered: bool) -> None:
    fields = {"type": "a/B", "message_definition": definition}
    assert has_sequence_numbers(channel_of("/t", fields)) is numbered
    assert not has_sequence_numbers(channel_of("/t", {**fields, "latching": "1"}))
    ros2 = Schema("a/B", "ros2msg", definition.encode())
    assert not has_sequence_numbers(Channel("/t", "cdr", ros2))


@pytest.mark.parametrize("text", ["\x1b[2J", "a\nb", "\x9b1m", "\u202eabc", "x" * 5000, "\ud800"])
def test_what_peers_say_is_shown_harmlessly(text: str) -> None:
    line = one_line(text)
    assert line.isprintable()
    assert len(line) < 500
    assert one_line(text.encode(errors="replace")).isprintable()


@pytest.mark.parametrize(
    ("uri", "endpoint"),
    [
        ("http://robot:11311", ("robot", 11311)),
        ("http://10.0.0.1:1/x", ("10.0.0.1", 1)),
        ("http://[::1]:80/", ("::1", 80)),
        ("http://::1:4711/", ("::1", 4711)),
        ("http://robot/", ("robot", 11311)),
        ("http://[::1]", ("::1", 11311)),
    ],
)
def test_addresses(uri: str, endpoint: tuple[str, int]) -> None:
    assert endpoint_of(uri, 11311) == endpoint


@pytest.mark.parametrize(
    "uri",
    [
        "",
        "robot:11311",
        "https://robot:1",
        "http://",
        "http://:11311",
        "http://robot:0",
        "http://robot:65536",
        "http://robot:99999999999999999999",
        "http://robot:1x",
        "http://robot:²",
        "http://user:word@robot:1",
        "http://[::1:80",
        "http://robot:11311/\r\nX: y",
    ],
)
def test_what_is_no_address(uri: str) -> None:
    with pytest.raises(PeerError, match="not an address"):
        endpoint_of(uri)


_NUMBERED = Channel(
    "/topic", "ros1", Schema("a/B", "ros1msg", b"Header header\n"), {"callerid": "/node"}
)
_PLAIN = Channel("/topic", "ros1", Schema("a/B", "ros1msg", b"string data\n"))


class _Pipe:
    def __init__(self, channel: Channel = _PLAIN, limit: int = 1 << 30) -> None:
        self.peer, ours = socket.socketpair()
        ours.setblocking(False)
        self.peer.setblocking(False)
        self.sink = Collector()
        self.ends: list[str] = []
        self.stream = Stream(ours, channel, self.sink, limit, self.ends.append)
        self.alive = True

    def send(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            try:
                view = view[self.peer.send(view) :]
            except BlockingIOError:
                pass
            self.read()

    def read(self) -> None:
        while self.alive and select.select([self.stream.socket], [], [], 0)[0]:
            self.alive = self.stream.read()

    def hang_up(self) -> None:
        self.peer.close()
        self.read()
        assert not self.alive
        self.stream.close()

    def payloads(self) -> list[bytes]:
        return [taken.payload for taken in self.sink.taken]


def _payload(draw: random.Random, number: int) -> bytes:
    size = draw.choice([0, 1, 3, 4, 20, 500, 70_000, 65_536, 300_000, 262_140, 262_144])
    return (struct.pack("<I", number) + draw.randbytes(size))[:size]


@pytest.mark.parametrize("channel", [_PLAIN, _NUMBERED], ids=["plain", "numbered"])
@pytest.mark.parametrize("seed", range(2))
def test_messages_come_out_as_they_went_in(seed: int, channel: Channel) -> None:
    draw = random.Random(seed)
    payloads = [_payload(draw, number) for number in range(60)]
    data = framed(*payloads)
    pipe = _Pipe(channel)
    pos = 0
    while pos < len(data):
        size = draw.choice([1, 2, 3, 5, 100, 4096, 65_536, 200_000, 1 << 20])
        pipe.send(data[pos : pos + size])
        pos += size
    pipe.hang_up()
    assert pipe.payloads() == payloads
    assert {id(taken.channel) for taken in pipe.sink.taken} == {id(channel)}
    assert [taken.received for taken in pipe.sink.taken] == sorted(
        taken.received for taken in pipe.sink.taken
    )
    numbers = [taken.sequence for taken in pipe.sink.taken]
    if channel is _PLAIN:
        assert set(numbers) == {None}
    else:
        expected = [n if len(payload) >= 4 else None for n, payload in enumerate(payloads)]
        assert numbers == expected
    assert pipe.ends == [""]


@pytest.mark.parametrize("size", [0xFFFFFFFF, 1001])
def test_a_message_that_is_too_long_ends_the_connection(size: int) -> None:
    pipe = _Pipe(limit=1000)
    pipe.send(framed(bytes(1000), b"x") + struct.pack("<I", size) + bytes(2000))
    assert pipe.payloads() == [bytes(1000), b"x"]
    assert not pipe.alive
    (loss,) = pipe.sink.losses
    assert (loss.cause, loss.count) == (Cause.UNREADABLE, 1)
    assert str(size) in loss.reason
    pipe.hang_up()


def test_a_connection_that_is_reset() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        peer = socket.create_connection(server.getsockname())
        ours, _ = server.accept()
    ours.setblocking(False)
    sink, ends = Collector(), list[str]()
    stream = Stream(ours, _PLAIN, sink, 1000, ends.append)
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    peer.close()
    assert not stream.read()
    stream.close()
    (loss,) = sink.losses
    assert (loss.cause, loss.count) == (Cause.CONNECTION, None)
    assert "the connection broke" in ends[0]
