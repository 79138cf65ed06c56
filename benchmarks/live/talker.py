"""A ROS 1 node that speaks at a fixed rate, whoever listens: `python -m benchmarks.live.talker`.

It is as roscpp is: a queue a connection, of which the oldest goes when it is full, but not
what is half sent. Standard library only, one thread for all topics.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import socket
import struct
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

DEFINITION = (
    "Header header\nuint8[] data\n"
    + "=" * 80
    + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
)
TYPE = "hybridlog_benchmark/Blob"
_MD5 = "0" * 31 + "1"
_HEAD = struct.Struct("<IIIII")
"""Sequence, seconds, nanoseconds, length of the frame's name, length of the data."""
_ROW = 64 << 20
_STEP = 1_000_003
_PATIENCE_S = 20.0
_SETTLE_S = 1.5


class Load(NamedTuple):
    """What is said.

    Attributes:
        topics: How many, `/t0` and on.
        size: Bytes of a message.
        hz: Messages a second on each topic.
        seconds: How long; 0 until standard input ends.
        burst: So many come at once.
        queue: Messages a connection may have waiting.
        period: Bytes after which the data repeats, so that it can be compressed; 0 for
            data that does not.
    """

    topics: int
    size: int
    hz: float
    seconds: float
    burst: int = 1
    queue: int = 10
    period: int = 0

    @property
    def megabytes_per_s(self) -> float:
        """What is offered."""
        return self.topics * self.size * self.hz / 1e6

    @property
    def messages(self) -> int:
        """On all topics; what `seconds` says."""
        return -(-int(self.seconds * self.hz) // self.burst) * self.burst * self.topics


class Data:
    """Random bytes, other ones in each message: a part of one long row of them.

    Args:
        load: Of which size, and how random.
    """

    def __init__(self, load: Load) -> None:
        total = _ROW + load.size
        once = random.Random(1).randbytes(load.period or total)
        self._row = memoryview(once * -(-total // len(once)))
        self._size = max(load.size - _HEAD.size, 0)

    def of(self, sequence: int) -> memoryview:
        """What stands in a message."""
        begin = sequence * _STEP % _ROW
        return self._row[begin : begin + self._size]


@dataclass(slots=True)
class _Connection:
    socket: socket.socket
    waiting: deque[bytes | memoryview] = field(default_factory=deque)
    is_half_sent: bool = False
    dropped: int = 0

    def put(self, message: bytes, queue: int) -> None:
        if len(self.waiting) >= queue + self.is_half_sent:
            del self.waiting[int(self.is_half_sent)]
            self.dropped += 1
        self.waiting.append(message)

    def flush(self) -> None:
        while self.waiting:
            head = self.waiting[0]
            try:
                sent = self.socket.send(head)
            except BlockingIOError:
                return
            except OSError:
                self.waiting.clear()  # whoever listened is gone
                return
            if sent < len(head):
                self.waiting[0] = memoryview(head)[sent:]
                self.is_half_sent = True
            else:
                self.waiting.popleft()
                self.is_half_sent = False


class Talker:
    """Registers, waits until each topic has a listener, speaks.

    Args:
        load: What to say.
        master: URI of the master.
    """

    def __init__(self, load: Load, master: str) -> None:
        self._load = load
        self._master = ServerProxy(master)
        self._listening = socket.create_server(("127.0.0.1", 0), backlog=64)
        self._connections: list[list[_Connection]] = [[] for _ in range(load.topics)]
        self._server = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False, allow_none=True)
        self._uri = f"http://127.0.0.1:{self._server.server_address[1]}/"
        port = self._listening.getsockname()[1]
        self._server.register_function(
            lambda *_: [1, "", ["TCPROS", "127.0.0.1", port]], "requestTopic"
        )
        self._server.register_function(lambda *_: [1, "", os.getpid()], "getPid")
        self._ended = threading.Event()

    def run(self) -> dict[str, float]:
        """Says everything.

        Returns:
            Messages `sent` and `dropped`, `late_ms` at worst, `seconds`.
        """
        for work in (self._server.serve_forever, self._accept):
            threading.Thread(target=work, daemon=True).start()
        for topic in range(self._load.topics):
            self._master.registerPublisher("/talker", f"/t{topic}", TYPE, self._uri)
        deadline = time.monotonic() + _PATIENCE_S
        while not all(self._connections):
            if time.monotonic() > deadline:
                raise SystemExit("nobody listens")
            time.sleep(0.02)
        time.sleep(_SETTLE_S)
        print(json.dumps({"speaking": True}), flush=True)
        result = self._speak()
        for topic in range(self._load.topics):
            self._master.unregisterPublisher("/talker", f"/t{topic}", self._uri)
        return result

    def _accept(self) -> None:
        while True:
            peer, _ = self._listening.accept()
            length = struct.unpack("<I", peer.recv(4, socket.MSG_WAITALL))[0]
            asked = dict(_fields(peer.recv(length, socket.MSG_WAITALL)))
            topic = asked["topic"]
            peer.sendall(
                _header(
                    callerid="/talker",
                    latching="0",
                    md5sum=_MD5,
                    message_definition=DEFINITION,
                    topic=topic,
                    type=TYPE,
                )
            )
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            peer.setblocking(False)
            self._connections[int(topic.removeprefix("/t"))].append(_Connection(peer))

    def _speak(self) -> dict[str, float]:
        load = self._load
        data = Data(load)
        total = load.messages // load.topics if load.seconds else sys.maxsize
        if not load.seconds:
            threading.Thread(target=self._watch_input, daemon=True).start()
        sequence, late = 0, 0.0
        begin = time.perf_counter()
        while sequence < total and not self._ended.is_set():
            wait = begin + sequence / load.hz - time.perf_counter()
            if wait > 0.0003:
                time.sleep(wait)
            late = max(late, -wait)
            for _ in range(load.burst):
                sequence += 1
                for connections in self._connections:
                    message = _message(sequence, data.of(sequence))
                    for connection in connections:
                        connection.put(message, load.queue)
                        connection.flush()
            self._flush()
        seconds = time.perf_counter() - begin
        deadline = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline and any(c.waiting for c in self._all()):
            self._flush()
            time.sleep(0.001)
        time.sleep(1)
        return {
            "sent": sequence * load.topics,
            "dropped": sum(c.dropped + len(c.waiting) for c in self._all()),
            "late_ms": round(late * 1e3, 1),
            "seconds": round(seconds, 2),
        }

    def _watch_input(self) -> None:
        sys.stdin.read()
        self._ended.set()

    def _all(self) -> list[_Connection]:
        return [connection for connections in self._connections for connection in connections]

    def _flush(self) -> None:
        for connection in self._all():
            connection.flush()


def _message(sequence: int, data: memoryview) -> bytes:
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    head = _HEAD.pack(sequence, seconds, nanoseconds, 0, len(data))
    return b"".join((struct.pack("<I", _HEAD.size + len(data)), head, data))


def _header(**fields: str) -> bytes:
    lines = [f"{name}={value}".encode() for name, value in fields.items()]
    body = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    return struct.pack("<I", len(body)) + body


def _fields(body: bytes) -> list[tuple[str, str]]:
    found, at = [], 0
    while at < len(body):
        length = struct.unpack_from("<I", body, at)[0]
        name, _, value = body[at + 4 : at + 4 + length].decode().partition("=")
        found.append((name, value))
        at += 4 + length
    return found


def main() -> None:
    """Speaks as the arguments say; the last line of the output is what it did."""
    parser = argparse.ArgumentParser()
    parser.add_argument("master")
    for name, kind in Load.__annotations__.items():
        parser.add_argument(name, type=float if "float" in str(kind) else int)
    chosen = vars(parser.parse_args())
    master = chosen.pop("master")
    print(json.dumps(Talker(Load(**chosen), master).run()), flush=True)
    os._exit(0)  # its threads wait for peers


if __name__ == "__main__":
    main()
