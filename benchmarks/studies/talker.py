"""A ROS 1 node that speaks at a fixed rate, whoever listens: `python -m benchmarks.studies.talker`.

It is as roscpp is: a queue a connection, of which the oldest goes when it is full, but not
what is half sent. One thread for all topics.
"""

from __future__ import annotations

import json
import random
import signal
import socket
import struct
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple
from xmlrpc.server import SimpleXMLRPCServer

from hybridlog.live.sources.ros1.source import decode_header, encode_header

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
        seconds: How long.
        queue: Messages a connection may have waiting.
    """

    topics: int
    size: int
    hz: float
    seconds: float
    queue: int = 10

    @property
    def megabytes_per_s(self) -> float:
        """What is offered."""
        return self.topics * self.size * self.hz / 1e6


@dataclass(slots=True)
class _Connection:
    socket: socket.socket
    waiting: deque[bytes | memoryview] = field(default_factory=deque)
    is_half_sent: bool = False

    def put(self, message: bytes, queue: int) -> None:
        if len(self.waiting) >= queue + self.is_half_sent:
            del self.waiting[int(self.is_half_sent)]
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
    """Waits until each topic has a listener, then speaks.

    Attributes:
        uri: Where it can be asked for its topics.
    """

    def __init__(self, load: Load) -> None:
        self._load = load
        self._listening = socket.create_server(("127.0.0.1", 0), backlog=64)
        self._connections: list[list[_Connection]] = [[] for _ in range(load.topics)]
        self._server = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False, allow_none=True)
        self.uri = f"http://127.0.0.1:{self._server.server_address[1]}/"
        port = self._listening.getsockname()[1]
        self._server.register_function(
            lambda *_: [1, "", ["TCPROS", "127.0.0.1", port]], "requestTopic"
        )

    def run(self) -> int:
        """Says everything; how many messages that were."""
        for work in (self._server.serve_forever, self._accept):
            threading.Thread(target=work, daemon=True).start()
        print(self.uri, flush=True)
        deadline = time.monotonic() + _PATIENCE_S
        while not all(self._connections):
            if time.monotonic() > deadline:
                raise SystemExit("nobody listens")
            time.sleep(0.02)
        time.sleep(_SETTLE_S)
        print("speaking", flush=True)
        return self._speak()

    def _accept(self) -> None:
        while True:
            peer, _ = self._listening.accept()
            length = struct.unpack("<I", peer.recv(4, socket.MSG_WAITALL))[0]
            topic = decode_header(peer.recv(length, socket.MSG_WAITALL))["topic"]
            about = {"callerid": "/talker", "latching": "0", "md5sum": _MD5, "type": TYPE}
            about |= {"message_definition": DEFINITION, "topic": topic}
            peer.sendall(encode_header(about))
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            peer.setblocking(False)
            self._connections[int(topic.removeprefix("/t"))].append(_Connection(peer))

    def _speak(self) -> int:
        load = self._load
        # Random bytes, other ones in each message: a part of one long row of them.
        row = memoryview(random.Random(1).randbytes(_ROW + load.size))
        length = load.size - _HEAD.size
        sequence = 0
        begin = time.perf_counter()
        while sequence < int(load.seconds * load.hz):
            wait = begin + sequence / load.hz - time.perf_counter()
            if wait > 0.0003:
                time.sleep(wait)
            sequence += 1
            at = sequence * _STEP % _ROW
            for connections in self._connections:
                message = _message(sequence, row[at : at + length])
                for connection in connections:
                    connection.put(message, load.queue)
                    connection.flush()
            self._flush()
        deadline = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline and any(c.waiting for c in self._all()):
            self._flush()
            time.sleep(0.001)
        time.sleep(1)
        return sequence * load.topics

    def _all(self) -> list[_Connection]:
        return [connection for connections in self._connections for connection in connections]

    def _flush(self) -> None:
        for connection in self._all():
            connection.flush()


def _message(sequence: int, data: memoryview) -> bytes:
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    head = _HEAD.pack(sequence, seconds, nanoseconds, 0, len(data))
    return b"".join((struct.pack("<I", _HEAD.size + len(data)), head, data))


def main() -> None:
    """Speaks as the argument says, tells what it did, and stays until it is killed."""
    print(Talker(Load(*json.loads(sys.argv[1]))).run(), flush=True)
    signal.pause()


if __name__ == "__main__":
    main()
