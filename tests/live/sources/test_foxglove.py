"""The Foxglove source: against the SDK's own server, and against servers that misbehave."""

from __future__ import annotations

import base64
import json
import random
import shutil
import socket
import ssl
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hybridlog.live.sources.base import Cause, PeerError
from hybridlog.live.sources.foxglove.protocol import parse_channel
from hybridlog.live.sources.foxglove.source import FoxgloveSource
from hybridlog_storage.errors import MissingDependencyError, UsageError
from hybridlog_storage.messages import Schema
from tests.calls import Calls
from tests.limits import Limit
from tests.live.sources.heard import DEADLINE_S, Heard, Listening, must_return
from tests.servers.test_tls import authority, certificate
from tests.waiting import wait_for

pytest.importorskip(
    "picows", reason="picows is not installed: nothing of the Foxglove source is tested"
)
pytest.importorskip(
    "websockets", reason="websockets is not installed: nothing of the Foxglove source is tested"
)

from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.typing import Subprotocol

# A server that sends whatever bytes a test wants.


def frame(opcode: int, payload: bytes, *, is_last: bool = True, length: int | None = None) -> bytes:
    """A websocket frame of a server, perhaps with a length that is a lie."""
    size = len(payload) if length is None else length
    head = bytes([opcode | (0x80 if is_last else 0)])
    if size < 126:
        head += bytes([size])
    elif size < 1 << 16:
        head += struct.pack(">BH", 126, size)
    else:
        head += struct.pack(">BQ", 127, size)
    return head + payload


def text(message: object) -> bytes:
    return frame(Opcode.TEXT, json.dumps(message).encode())


def body(subscription: int, log_time: int, payload: bytes) -> bytes:
    return struct.pack("<BIQ", 1, subscription, log_time) + payload


def message(subscription: int, log_time: int, payload: bytes) -> bytes:
    return frame(Opcode.BINARY, body(subscription, log_time, payload))


def channel(number: int = 1, topic: str = "/a", **others: object) -> dict[str, object]:
    return {"id": number, "topic": topic, "encoding": "json", "schemaName": "T", **others}


def advertise(*channels: object) -> bytes:
    return text({"op": "advertise", "channels": list(channels)})


class Peer:
    def __init__(self, made: socket.socket) -> None:
        self.socket = made
        self.socket.settimeout(DEADLINE_S)
        self.protocol = ServerProtocol(
            subprotocols=[Subprotocol("foxglove.websocket.v1")], max_size=None
        )
        self.frames: list[Frame] = []

    def shake_hands(self) -> None:
        while self.protocol.state is State.CONNECTING:
            self.protocol.receive_data(self.socket.recv(1 << 16))
            for request in self.protocol.events_received():
                self.protocol.send_response(self.protocol.accept(request))  # type: ignore[arg-type]
            self.send(*self.protocol.data_to_send())

    def send(self, *pieces: bytes) -> None:
        self.socket.sendall(b"".join(pieces))

    def hear(self) -> Frame:
        """The next frame of the client; the answers of websockets are not sent."""
        while not self.frames:
            data = self.socket.recv(1 << 16)
            if not data:
                raise EOFError
            self.protocol.receive_data(data)
            self.frames += [e for e in self.protocol.events_received() if isinstance(e, Frame)]
        return self.frames.pop(0)

    def subscribed(self) -> dict[int, int]:
        """What the client subscribes to next: channel by subscription."""
        request = json.loads(bytes(self.hear().data))
        assert request["op"] == "subscribe"
        return {s["channelId"]: s["id"] for s in request["subscriptions"]}

    def offer(self, *channels: object) -> dict[int, int]:
        self.send(advertise(*channels))
        return self.subscribed()

    def wait(self) -> None:
        try:
            while (heard := self.hear()).opcode is not Opcode.CLOSE:
                pass
            self.send(frame(Opcode.CLOSE, bytes(heard.data)))
        except (OSError, EOFError):
            pass


Script = Callable[[Peer], None]


class Server(Listening):
    """Plays a script for each connection, the last one for ever."""

    def __init__(self, *scripts: Script, port: int = 0, is_raw: bool = False) -> None:
        super().__init__(self._serve_one, port=port)
        self.scripts = list(scripts)
        self.is_raw = is_raw
        self.tls: ssl.SSLContext | None = None
        self.failures: list[BaseException] = []
        self.url = f"ws://127.0.0.1:{self.port}"

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        if self.failures:
            raise self.failures[0]

    def _serve_one(self, made: socket.socket) -> None:
        script = self.scripts.pop(0) if len(self.scripts) > 1 else self.scripts[0]
        if self.tls is not None:
            made = self.tls.wrap_socket(made, server_side=True)
        with made:
            peer = Peer(made)
            try:
                if not self.is_raw:
                    peer.shake_hands()
                script(peer)
            except (OSError, EOFError):
                raise  # the client is gone, which each test looks for at its own end
            except BaseException as error:
                self.failures.append(error)


def hear(
    until: Callable[[Heard], object],
    *scripts: Script,
    heard: Heard | None = None,
    server: Server | None = None,
) -> Heard:
    """What a source hears of a server, until something has come."""
    heard = heard or Heard()
    with server or Server(*scripts) as server, FoxgloveSource(server.url) as source:
        source.start(heard)
        heard.until(until)
    return heard


def saying(payload: bytes, time: int = 0, number: int = 1) -> Script:

    def script(peer: Peer) -> None:
        peer.send(message(peer.offer(channel(number))[number], time, payload))
        peer.wait()

    return script


@pytest.fixture(autouse=True)
def _quick(limit: Limit) -> Iterator[None]:
    """Try again sooner; and nothing is left behind."""
    limit(foxglove_pause_s=0.02)
    yield
    assert [t.name for t in threading.enumerate() if t.name == "hybridlog-foxglove"] == []


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("robot:8765", "does not begin with ws://"),
        ("ws://", "names no host"),
        ("ws://robot:0", "port 0"),
        ("ws://robot:port", "not the address"),
        ("ws://robot:8765/#x", "'#'"),
        ("ws://robot\x1b[31m:8765", "not the address"),
        ("ws://me@robot:8765", "without a password"),
        ("", "does not begin"),
    ],
)
def test_an_address_that_is_none_is_refused_with_the_cure(url: str, words: str) -> None:
    with pytest.raises(UsageError, match=r"wss?://") as caught:
        FoxgloveSource(url).start(Heard())
    assert words in str(caught.value)
    assert str(caught.value).isprintable()


def test_without_picows_the_message_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "hybridlog.live.sources.foxglove.connection", False)
    monkeypatch.setitem(sys.modules, "picows", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'hybridlog\[foxglove\]'"):
        FoxgloveSource("ws://127.0.0.1:1").start(Heard())


TEXT, OCTETS = "string data", b"\0\xff\n"
IN_BASE64 = base64.b64encode(OCTETS).decode()


@pytest.mark.parametrize(
    ("entry", "expected", "problem"),
    [
        ({"encoding": "ros1", "schemaEncoding": "ros1msg"}, ("ros1msg", TEXT.encode()), ""),
        ({"encoding": "ros1"}, ("ros1msg", TEXT.encode()), ""),
        ({"encoding": "cdr"}, ("ros2msg", TEXT.encode()), ""),
        ({"encoding": "cdr", "schemaEncoding": "ros2idl"}, ("ros2idl", TEXT.encode()), ""),
        ({"schema": '{"\u00e9": 1}'}, ("jsonschema", '{"\u00e9": 1}'.encode()), ""),
        ({"encoding": "protobuf", "schema": IN_BASE64}, ("protobuf", OCTETS), ""),
        ({"encoding": "flatbuffer", "schema": IN_BASE64}, ("flatbuffer", OCTETS), ""),
        ({"encoding": "own", "schemaEncoding": "mine"}, ("mine", TEXT.encode()), ""),
        ({"schema": ""}, ("", b""), ""),
        ({"schema": "", "schemaName": ""}, None, ""),
        ({"schema": "", "schemaName": None}, None, ""),
        # A broken definition leaves a channel without.
        ({"encoding": "protobuf", "schema": "!!!!"}, ("", b""), "base64"),
        ({"encoding": "protobuf", "schema": "abc"}, ("", b""), "base64"),
        ({"encoding": "protobuf", "schema": "\u00e9"}, ("", b""), "base64"),
        ({"schema": {"type": "object"}}, ("", b""), "not text"),
        ({"schema": "\ud800"}, ("", b""), "not text"),
    ],
)
def test_definitions_become_schemas(
    entry: dict[str, object], expected: tuple[str, bytes] | None, problem: str
) -> None:
    found = parse_channel(channel(**{"schema": TEXT, **entry}))
    assert found.channel.schema == (None if expected is None else Schema("T", *expected))
    assert problem in found.problem
    assert bool(found.problem) == bool(problem)
    assert found.channel.message_encoding == entry.get("encoding", "json")
    assert found.channel.has_publish_time


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (5, "'id'"),
        (None, "'id'"),
        ({}, "'id'"),
        ({**channel(), "id": True}, "'id'"),
        ({**channel(), "id": -1}, "'id'"),
        ({**channel(), "id": 1 << 64}, "'id'"),
        ({**channel(), "id": 1.0}, "'id'"),
        ({**channel(), "topic": None}, "topic"),
        ({**channel(), "topic": "\ud800"}, "topic"),
        ({**channel(), "topic": ""}, "topic"),
        ({**channel(), "encoding": []}, "encoding"),
    ],
)
def test_a_channel_that_is_none_is_refused(entry: object, words: str) -> None:
    with pytest.raises(PeerError, match=words):
        parse_channel(entry)


SIZES = [0, 1, 99, 112, 113, 125, 126, 65522, 65523, 65536, 70_000, 131_072, 300_000, 3_000_001]


def test_every_size_comes_byte_for_byte_however_it_is_cut() -> None:
    random.seed(4)
    sizes = [*SIZES, *(random.randrange(2000) for _ in range(300)), *SIZES[::-1]]
    payloads = [random.randbytes(size) for size in sizes]

    def script(peer: Peer) -> None:
        peer.send(text({"op": "serverInfo", "name": "x", "capabilities": ["time"]}))
        number = peer.offer(channel(7))[7]
        stream = b"".join(
            [message(number, at, payload) for at, payload in enumerate(payloads)]
            # Clocks, pings, other operations and unknown kinds lie in between.
            + [
                frame(Opcode.BINARY, b"\x02" + (5).to_bytes(8, "little")),
                frame(Opcode.PING, b"hello"),
            ]
            + [text({"op": "parameterValues"}), frame(Opcode.BINARY, b"\x77" + bytes(100_000))]
            + [message(number, len(payloads), b"last")]
        )
        while stream:
            size = random.choice([1, 2, 3, 7, 100, 5000, 100_000, 1_000_000])
            peer.send(stream[:size])
            stream = stream[size:]
        assert bytes(peer.hear().data) == b"hello"
        peer.wait()

    before = time.time_ns()
    heard = hear(lambda h: len(h.taken) > len(payloads), script)
    assert heard.payloads() == [*payloads, b"last"]
    assert {type(taken.payload) for taken in heard.taken} == {bytes}
    assert [taken.sent for taken in heard.taken] == list(range(len(payloads) + 1))
    assert {taken.sequence for taken in heard.taken} == {None}
    assert len({id(taken.channel) for taken in heard.taken}) == 1
    times = [taken.received for taken in heard.taken]
    assert before <= times[0]
    assert times == sorted(times)
    assert heard.topics == [("/a", "T"), ("/a",)]
    assert (heard.said, heard.losses, heard.ends) == ([], [], [])


def test_only_what_is_wanted_is_subscribed_to() -> None:
    asked: list[dict[int, int]] = []

    def script(peer: Peer) -> None:
        asked.append(
            peer.offer(channel(1, "/a"), channel(2, "/b"), channel(3, "/a", schemaName="U"))
        )
        peer.send(*(message(number, 0, b"x") for number in asked[0].values()))
        peer.wait()

    heard = hear(lambda h: len(h.taken) == 2, script, heard=Heard(lambda topic, _: topic == "/a"))
    assert set(asked[0]) == {1, 3}
    assert heard.topics == [("/a", "T"), ("/a",)]
    types = [taken.channel.schema.name for taken in heard.taken if taken.channel.schema]
    assert types == ["T", "U"]


def test_channels_that_go_and_come_again() -> None:
    def script(peer: Peer) -> None:
        first = peer.offer(channel(1))[1]
        peer.send(message(first, 0, b"1"))
        peer.send(text({"op": "unadvertise", "channelIds": [1, 77, "x", None, [1]]}))
        # The server's queue of messages may be behind its queue of announcements.
        peer.send(message(first, 0, b"2"))
        again = peer.offer(channel(1))[1]
        assert again != first
        peer.send(message(again, 0, b"3"), advertise(channel(1)))
        other = channel(1, schemaName="U")
        peer.send(advertise(other))
        assert json.loads(bytes(peer.hear().data)) == {
            "op": "unsubscribe",
            "subscriptionIds": [again],
        }
        changed = peer.subscribed()[1]
        peer.send(message(changed, 0, b"4"))
        peer.wait()

    heard = hear(lambda h: len(h.taken) == 4, script)
    assert heard.payloads() == [b"1", b"2", b"3", b"4"]
    came = ("/a", "T")
    assert heard.topics == [came, ("/a",), came, ("/a",), ("/a", "U"), ("/a",)]
    assert heard.said == heard.losses == []


REFUSALS = ["Unknown channel ID: {}", "Channel {} is not available; ignoring subscription"]


@pytest.mark.parametrize("words", REFUSALS)
def test_a_channel_that_is_offered_too_soon_is_asked_for_again(limit: Limit, words: str) -> None:
    limit(foxglove_retry_s=0.0)

    def script(peer: Peer) -> None:
        number = peer.offer(channel(7))[7]
        refusal = text({"op": "status", "level": 2, "message": words.format(7)})
        peer.send(refusal)
        assert peer.subscribed() == {7: number}
        peer.send(message(number, 0, b"1"), refusal, text({"op": "status", "message": "8"}))
        peer.wait()

    heard = hear(lambda h: len(h.said) == 2, script)
    assert heard.payloads() == [b"1"]
    assert "offers '/a', but does not send it" in heard.said[0]
    assert "says: 8" in heard.said[1]


NONSENSE = {
    "no message of Foxglove": [
        *(frame(Opcode.TEXT, sent) for sent in (b"{", b"\xff\xfe", b"[" * 100_000, b"9" * 10_000)),
        *map(text, ([1], {"op": 5}, {"op": "advertise"}, {"op": "unadvertise", "channelIds": 5})),
    ],
    "without number": [advertise(5, channel(2, ""))],
    "says: ?[31mbad news": [text({"op": "status", "level": 2, "message": "\x1b[31mbad\nnews"})],
    "is not base64": [advertise(channel(2, "/p", encoding="protobuf", schema="!"))],
    "of no subscription": [
        message(4711, 0, b"x"), *(frame(Opcode.BINARY, sent) for sent in (b"", b"\x01abc"))
    ],
}  # fmt: skip


@pytest.mark.parametrize("words", NONSENSE)
def test_nonsense_is_told_in_a_line_and_the_rest_goes_on(words: str) -> None:
    sent = NONSENSE[words]

    def script(peer: Peer) -> None:
        number = peer.offer(channel())[1]
        for piece in sent:
            peer.send(piece, message(number, 0, b"after"))
        peer.wait()

    heard = Heard()
    with Server(script) as server, FoxgloveSource(server.url) as source:
        source.start(heard)
        heard.until(lambda h: len(h.taken) == len(sent))
    assert heard.payloads() == [b"after"] * len(sent)
    assert heard.said_of(words), heard.said
    assert {*heard.said} == {heard.said[0]}
    assert all(line.startswith(server.url) and line.isprintable() for line in heard.said)
    assert all(len(line) < 400 for line in heard.said)
    # What may have been a message is a row, too.
    rows = [(loss.topic, loss.cause, loss.count) for loss in heard.losses]
    is_binary = words == "of no subscription"
    assert rows == [("", Cause.UNREADABLE, 1)] * (len(sent) if is_binary else 0)
    assert source.was_reached


def test_channels_without_end_are_bounded(limit: Limit) -> None:
    limit(foxglove_channels=10)

    def script(peer: Peer) -> None:
        found = peer.offer(*(channel(at, f"/{at}") for at in range(50)))
        assert len(found) == 10
        peer.send(message(found[9], 0, b"x"))
        peer.wait()

    heard = hear(lambda h: h.taken, script)
    assert heard.said_of("more than 10 channels")


def test_a_time_that_no_log_can_hold_is_replaced() -> None:
    heard = hear(lambda h: h.taken, saying(b"x", (1 << 64) - 1))
    assert heard.taken[0].sent == heard.taken[0].received
    assert heard.said_of("2262")


def test_a_message_over_the_limit_ends_the_connection_and_is_counted(limit: Limit) -> None:
    limit(foxglove_message_bytes=1 << 20)

    def first(peer: Peer) -> None:
        number = peer.offer(channel())[1]
        peer.send(message(number, 0, bytes((1 << 20) - 13)), message(number, 0, bytes(1 << 20)))
        peer.wait()

    heard = hear(lambda h: len(h.taken) == 2, first, saying(b"2"))
    assert heard.payloads() == [bytes((1 << 20) - 13), b"2"]
    lost, outage = heard.losses
    assert (lost.topic, lost.cause, lost.count) == ("", Cause.UNREADABLE, 1)
    assert "exceeds the limit" in lost.reason
    assert (outage.topic, outage.count) == ("/a", None)
    assert heard.said_of(f"announces a message of more than {1 << 20} bytes")


BREAKS = [
    (frame(2, body(0, 0, b"x"), length=1 << 62), "announces a message"),
    (frame(2, b"\x01", is_last=False, length=1 << 40), "announces a message of more than"),
    (frame(9, b"x", length=1 << 40), "violates the websocket protocol"),
    (b"\x82\x85abcd12345", "violates the websocket protocol"),
    (frame(0, b"x"), "messages in pieces"),
    (frame(2, b"", is_last=False) + frame(2, b"x"), "messages in pieces"),
    (frame(8, b"\x03\xe9going"), "closed the connection (going)"),
    (frame(8, b"\x03\xe9\x1b[2J"), "closed the connection (?[2J)"),
    (frame(8, b""), "closed the connection;"),
    (b"", "the connection broke"),
]  # fmt: skip


@pytest.mark.parametrize(("sent", "words"), BREAKS)
def test_a_connection_that_ends_is_made_anew(sent: bytes, words: str) -> None:
    def first(peer: Peer) -> None:
        peer.send(message(peer.offer(channel(1))[1], 0, b"1"), sent)
        if sent:
            peer.wait()

    heard = hear(lambda h: len(h.taken) == 2, first, saying(b"2", number=9))
    assert heard.payloads() == [b"1", b"2"]
    (line,) = heard.said
    assert words in line
    assert line.endswith("; trying again")
    assert line.isprintable()
    outage = heard.losses[-1]
    assert (outage.topic, outage.cause, outage.count) == ("/a", Cause.CONNECTION, None)
    assert heard.taken[0].received <= outage.first <= outage.last <= heard.taken[1].received
    assert heard.topics == [("/a", "T"), ("/a",)] * 2


@pytest.mark.parametrize("size", [100, 5_000_000])
def test_a_message_in_which_the_connection_breaks_belongs_to_the_outage(size: int) -> None:
    def first(peer: Peer) -> None:
        peer.send(message(peer.offer(channel(1))[1], 0, bytes(size))[:-1])

    heard = hear(lambda h: h.taken, first, saying(b"2"))
    assert heard.payloads() == [b"2"]
    (outage,) = heard.losses
    assert (outage.topic, outage.cause, outage.count) == ("/a", Cause.CONNECTION, None)
    assert heard.said_of("the connection broke")


def test_a_server_that_falls_silent_is_asked_and_then_left(
    limit: Limit,
) -> None:
    limit(foxglove_ping_s=0.15)
    asked: list[Opcode] = []

    def first(peer: Peer) -> None:
        asked.append(peer.hear().opcode)
        peer.wait()

    def second(peer: Peer) -> None:
        number = peer.offer(channel())[1]
        for _ in range(5):
            assert peer.hear().opcode is Opcode.PING
            peer.send(frame(Opcode.PONG, b""))
        peer.send(message(number, 0, b"1"))
        peer.wait()

    heard = hear(lambda h: h.taken, first, second)
    assert asked == [Opcode.PING]
    (line,) = heard.said
    assert "has been silent for" in line


def test_whatever_bytes_come_the_reader_ends_in_order(limit: Limit) -> None:
    limit(foxglove_pause_s=0.0)
    dice = random.Random(5)
    whole = [
        advertise(channel(), channel(2, "/b")),
        message(0, 1, bytes(100)),
        message(1, 2, bytes(70_000)),
        frame(Opcode.BINARY, body(0, 1, b"abc")[:5], is_last=False),
        frame(Opcode.PING, b"x"),
        frame(Opcode.CONT, body(0, 1, b"abc")[5:]),
        message(0, 3, b"y"),
        frame(Opcode.CLOSE, b""),
    ]

    def broken(peer: Peer) -> None:
        stream = bytearray(b"".join(whole))
        for _ in range(dice.randrange(4)):
            # Most of what can go wrong lies in the heads of frames.
            starts = [sum(map(len, whole[:at])) for at in range(len(whole))]
            place = (dice.choice(starts) + dice.randrange(12)) % len(stream)
            stream[place] = dice.randrange(256)
        peer.send(bytes(stream[: dice.choice([len(stream), dice.randrange(len(stream))])]))
        peer.socket.shutdown(socket.SHUT_WR)

    heard = hear(lambda h: b"end" in h.payloads("/end"), *[broken] * 300, end)
    assert heard.ends == []


def end(peer: Peer) -> None:
    peer.send(message(peer.offer(channel(1, "/end"))[1], 0, b"end"))
    peer.wait()


def answer(data: bytes) -> Script:
    def script(peer: Peer) -> None:
        peer.socket.recv(1 << 16)
        peer.send(data)
        peer.wait()

    return script


def other_subprotocol(peer: Peer) -> None:
    peer.protocol.available_subprotocols = None
    peer.shake_hands()
    peer.wait()


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (answer(b"HTTP/1.1 404 Not Found\r\nContent-Length: 5\r\n\r\nhello"), "404 Not Found)"),
        (answer(b"HTTP/1.1 401 Who\r\n\r\n"), "401 Who); start"),
        (answer(b"HTTP/1.1 200 \x1b[31m\r\n\r\n"), "cannot be reached (HTTP/1.1 200 ?[31m"),
        (answer(b"SSH-2.0-OpenSSH\r\n\r\n"), "SSH"),
        (answer(b"\x00" * 100_000), "cannot be reached"),
        (answer(b"HTTP/1.1 101 Yes\r\n\r\n"), "cannot be reached"),
        (answer(b"HTTP/1.1 101 Yes\r\n" + b"a: b\r\n" * 5000 + b"\r\n"), "cannot be reached"),
        (other_subprotocol, "does not speak Foxglove"),
        (lambda peer: None, "cannot be reached"),
    ],
)  # fmt: skip
def test_somebody_elses_server_is_told_and_tried_again(script: Script, words: str) -> None:
    server = Server(script, is_raw=True)
    heard = hear(lambda h: h.said_of(words), server=server)
    assert all(line.isprintable() and line.endswith("; trying again") for line in heard.said)
    assert heard.taken == []


def test_user_and_password_are_in_one_header_only() -> None:
    asked: list[bytes] = []

    def script(peer: Peer) -> None:
        asked.append(peer.socket.recv(1 << 16))

    server = Server(script, is_raw=True)
    server.url = f"ws://me:pa%C3%9F%40@127.0.0.1:{server.port}/x?y"
    assert FoxgloveSource(server.url).address == f"ws://127.0.0.1:{server.port}/x?y"
    heard = hear(lambda h: h.said, server=server)
    assert heard.said_of(f"ws://127.0.0.1:{server.port}/x?y")
    lines = asked[0].split(b"\r\n")
    assert lines[0] == b"GET /x?y HTTP/1.1"
    assert f"Host: 127.0.0.1:{server.port}".encode() in lines
    expected = base64.b64encode("me:pa\u00df@".encode())
    assert b"Authorization: Basic " + expected in lines


def test_a_server_that_does_not_read_is_left(limit: Limit) -> None:
    limit(foxglove_unread_bytes=1 << 16)

    def script(peer: Peer) -> None:
        peer.offer(channel())
        flood = frame(Opcode.PING, bytes(125)) * 1000
        while True:
            peer.send(flood)

    heard = hear(lambda h: h.said, script, Peer.wait)
    assert "leaves more than 65536 bytes unread" in heard.said[0]


@pytest.mark.parametrize(("is_raw", "floods"), [(True, False), (False, False), (False, True)])
def test_a_server_does_not_hold_up_the_end(*, is_raw: bool, floods: bool) -> None:
    there = threading.Event()

    def script(peer: Peer) -> None:
        flood = message(peer.offer(channel())[1], 0, bytes(1000)) * 100 if floods else b""
        there.set()
        while floods:
            peer.send(flood)
        peer.wait()

    heard = Heard()
    with Server(script, is_raw=is_raw) as server, FoxgloveSource(server.url) as source:
        source.start(heard)
        assert there.wait(DEADLINE_S)
        must_return(source.stop)
        must_return(source.stop)
        assert [t for t in threading.enumerate() if t.name == "hybridlog-foxglove"] == []
    assert heard.said == []


def test_what_is_under_way_at_the_end_is_handed_over() -> None:
    def script(peer: Peer) -> None:
        number = peer.offer(channel())[1]
        peer.send(message(number, 0, b"1"))
        goodbye = peer.hear()
        assert goodbye.opcode is Opcode.CLOSE
        # A half of a large message, whose rest comes, and then the answer.
        large = message(number, 0, bytes(1_000_000))
        peer.send(message(number, 0, b"2"), large[:500_000])
        peer.send(large[500_000:], frame(Opcode.CLOSE, bytes(goodbye.data)))

    heard = Heard()
    with Server(script) as server, FoxgloveSource(server.url) as source:
        source.start(heard)
        heard.until(lambda h: h.taken)
        source.stop()
        assert heard.payloads() == [b"1", b"2", bytes(1_000_000)]
    assert heard.said == heard.losses == []


def test_a_sink_that_fails_is_told(monkeypatch: pytest.MonkeyPatch, calls: Calls) -> None:
    seen: list[object] = []
    monkeypatch.setattr(threading, "excepthook", lambda args: seen.append(args.exc_value))

    heard = Heard()
    calls.fail(heard, "take", RuntimeError("no more"))
    hear(lambda h: h.ends, saying(b"1"), heard=heard)
    assert "no more" in heard.ends[0]
    assert len(seen) == 1


@pytest.fixture(scope="module")
def trusted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """An authority, and a certificate of it with its key."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed: wss:// is not tested")
    folder = tmp_path_factory.mktemp("tls")
    ours = authority(folder / "ours.pem")
    return ours, certificate(folder / "server.pem", ours)


def tls_server(script: Script, trusted: tuple[Path, Path]) -> Server:
    server = Server(script)
    server.tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.tls.load_cert_chain(trusted[1])
    server.url = server.url.replace("ws:", "wss:")
    return server


def test_tls_carries_messages_of_any_size(
    trusted: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(trusted[0]))
    payloads = [random.randbytes(size) for size in SIZES]

    def script(peer: Peer) -> None:
        number = peer.offer(channel())[1]
        peer.send(*(message(number, 0, payload) for payload in payloads))
        peer.wait()

    server = tls_server(script, trusted)
    heard = hear(lambda h: len(h.taken) == len(payloads), server=server)
    assert heard.payloads() == payloads
    assert heard.said == []


def test_a_certificate_that_nobody_vouches_for_is_refused(
    trusted: tuple[Path, Path],
) -> None:
    server = tls_server(Peer.wait, trusted)
    hear(lambda h: h.said_of("certificate verify failed"), server=server)


def test_a_server_without_tls_is_told() -> None:
    server = Server(answer(b"HTTP/1.1 400 Bad\r\n\r\n"), is_raw=True)
    server.url = server.url.replace("ws:", "wss:")
    hear(lambda h: h.said_of("TLS (wss://"), server=server)


@pytest.fixture
def sdk() -> Any:
    return pytest.importorskip(
        "foxglove", reason="foxglove-sdk is not installed: no real Foxglove server is tested"
    )


@pytest.mark.peer("Foxglove")
def test_a_program_with_the_sdk(sdk: Any) -> None:
    context = sdk.Context()
    server = sdk.start_server(host="127.0.0.1", port=0, context=context, name="real")
    text = b"string data"
    offers = {
        "/json": ("json", sdk.Schema(name="J", encoding="jsonschema", data=b'{"type":"object"}')),
        "/ros1": ("ros1", sdk.Schema(name="std_msgs/String", encoding="ros1msg", data=text)),
        "/ros2": ("cdr", sdk.Schema(name="std_msgs/msg/String", encoding="ros2msg", data=text)),
        "/proto": ("protobuf", sdk.Schema(name="p.P", encoding="protobuf", data=b"\n\x00\xff")),
        "/flat": ("flatbuffer", sdk.Schema(name="F", encoding="flatbuffer", data=b"\x00\xfe")),
        "/own": ("own", sdk.Schema(name="O", encoding="mine", data=b"as you like")),
    }
    channels = {
        topic: sdk.Channel(topic, message_encoding=encoding, schema=schema, context=context)
        for topic, (encoding, schema) in offers.items()
    }
    sizes = [0, 1, 125, 126, 65_535, 65_536, 640_000, 4_000_000]
    heard = Heard()
    try:
        with FoxgloveSource(f"ws://127.0.0.1:{server.port}") as source:
            source.start(heard)
            subscribed(heard, channels)
            sent = {topic: [random.randbytes(size) for size in sizes] for topic in channels}
            for topic, payloads in sent.items():
                for at, payload in enumerate(payloads):
                    channels[topic].log(payload, log_time=1_700_000_000_000_000_000 + at)
            heard.until(lambda h: len(h.taken) == len(channels) * len(sizes))
            for topic, payloads in sent.items():
                assert heard.payloads(topic) == payloads
            times = {taken.sent for taken in heard.taken}
            assert times == {1_700_000_000_000_000_000 + at for at in range(len(sizes))}
            for taken in heard.taken:
                encoding, schema = offers[taken.channel.topic]
                assert taken.channel.message_encoding == encoding
                assert taken.channel.schema == Schema(schema.name, schema.encoding, schema.data)

            # A channel that goes, one with the same topic and another type, and a status.
            channels["/json"].close()
            heard.until(lambda h: ("/json",) in h.topics)
            again = plain(sdk, "/json", context)
            heard.until(lambda h: [t[0] for t in h.topics if len(t) > 1].count("/json") == 2)
            until_taken(heard, lambda: again.log(b"again"), "/json", b"again")
            server.publish_status("careful", sdk.StatusLevel.Warning)
            heard.until(lambda h: h.said_of("says: careful"))
    finally:
        server.stop()
    assert heard.losses == []


def plain(sdk: Any, topic: str, context: Any) -> Any:
    schema = sdk.Schema(name="P", encoding="mine", data=b"as you like")
    return sdk.Channel(topic, message_encoding="own", schema=schema, context=context)


def subscribed(heard: Heard, channels: dict[str, Any]) -> None:
    heard.until(lambda h: {t[0] for t in h.topics} >= set(channels))
    wait_for(lambda: all(each.has_sinks() for each in channels.values()))


def until_taken(heard: Heard, log: Callable[[], None], topic: str, payload: bytes) -> None:
    """Log until it comes: the server takes a moment to know of a subscription."""
    deadline = time.monotonic() + DEADLINE_S
    while payload not in heard.payloads(topic):
        assert time.monotonic() < deadline, vars(heard)
        log()
        time.sleep(0.01)
