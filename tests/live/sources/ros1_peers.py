"""A ROS master and publishers in plain Python, which can be made to misbehave."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from socketserver import ThreadingMixIn
from typing import Any
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from hybridlog.live.sources.ros1.source import decode_header, encode_header
from hybridlog_storage.messages import Channel
from tests.live.sources.heard import Heard, Listening

STRING = {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}


class _Handler(SimpleXMLRPCRequestHandler):
    def setup(self) -> None:
        super().setup()
        self.connection.settimeout(5)


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, host: str, port: int = 0) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), _Handler, logRequests=False, allow_none=True)
        shown = f"[{host}]" if ":" in host else host
        self.uri = f"http://{shown}:{self.server_address[1]}/"
        self.thread = threading.Thread(target=self.serve_forever, args=(0.02,))

    def __enter__(self) -> _Server:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.thread.join()
        self.server_close()


class FakeMaster:
    """Knows publishers."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        self.host, self.port = host, port
        self.publishers: dict[str, dict[str, str]] = {}
        self.types: dict[str, str] = {}
        self.calls: list[str] = []
        self.server: _Server | None = None

    def __enter__(self) -> FakeMaster:
        self.server = _Server(self.host, self.port)
        self.port = self.server.server_address[1]
        for name, function in {
            "getSystemState": self._state,
            "getTopicTypes": self._topic_types,
            "lookupNode": self._look_up,
        }.items():
            self.server.register_function(function, name)
        self.server.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self.server is not None:
            self.server.__exit__()
            self.server = None

    @property
    def uri(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}"

    def add(self, topic: str, type_name: str, node: str, uri: str) -> None:
        self.types.setdefault(topic, type_name)
        self.publishers.setdefault(topic, {})[node] = uri

    def remove(self, topic: str, node: str) -> None:
        self.publishers[topic].pop(node, None)

    def _state(self, _: str) -> list[Any]:
        self.calls.append("getSystemState")
        publishers = [[t, list(nodes)] for t, nodes in self.publishers.items() if nodes]
        return [1, "", [publishers, [], []]]

    def _topic_types(self, _: str) -> list[Any]:
        return [1, "", [list(pair) for pair in self.types.items()]]

    def _look_up(self, _: str, node: str) -> list[Any]:
        for nodes in self.publishers.values():
            if node in nodes:
                return [1, "", nodes[node]]
        return [-1, "unknown node", ""]


class FakePublisher:
    """A node that publishes one topic; `script` does what it likes with each connection."""

    def __init__(
        self,
        script: Callable[[socket.socket], None],
        *,
        topic: str = "/topic",
        node: str = "",
        host: str = "127.0.0.1",
        fields: dict[str, str] | None = None,
        greets: bool = True,
        offer: list[Any] | None = None,
    ) -> None:
        self.script, self.topic, self.host = script, topic, host
        self.node = node = node or ("/node" if topic == "/topic" else f"/node{topic}")
        self.fields = {
            "callerid": node,
            "latching": "0",
            "message_definition": "string data\n",
            "topic": topic,
            **STRING,
            **(fields or {}),
        }
        self.greets, self.offer = greets, offer
        self.asked: list[dict[str, str]] = []
        self.connections = 0

    def __enter__(self) -> FakePublisher:
        self.server = _Server(self.host)
        self.server.register_function(self._request_topic, "requestTopic")
        self.server.__enter__()
        self.listening = Listening(self._serve, self.host)
        self.listening.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.server.__exit__()
        self.listening.__exit__()

    @property
    def uri(self) -> str:
        return self.server.uri

    def withdraw(self) -> None:
        """Takes no more subscribers, as a node does that has unadvertised the topic."""
        self.topic = ""

    def _request_topic(self, caller: str, topic: str, protocols: list[Any]) -> list[Any]:
        assert caller.startswith("/hybridlog_")
        assert protocols == [["TCPROS"]]
        if topic != self.topic:
            return [0, f"not a publisher of {topic}", []]
        if self.offer is not None:
            return [1, "", self.offer]
        return [1, "", ["TCPROS", self.host, self.listening.port]]

    def _serve(self, connection: socket.socket) -> None:
        length = int.from_bytes(connection.recv(4, socket.MSG_WAITALL), "little")
        self.asked.append(decode_header(connection.recv(length, socket.MSG_WAITALL)))
        if self.greets:
            connection.sendall(encode_header(self.fields))
        self.connections += 1
        self.script(connection)


def framed(*payloads: bytes) -> bytes:
    return b"".join(len(payload).to_bytes(4, "little") + payload for payload in payloads)


def until_closed(connection: socket.socket) -> None:
    while connection.recv(4096):
        pass


def sends(*payloads: bytes) -> Callable[[socket.socket], None]:
    """A script that sends some messages and then keeps quiet."""

    def script(connection: socket.socket) -> None:
        connection.sendall(framed(*payloads))
        until_closed(connection)

    return script


class Collector(Heard):
    def take(self, channel: Channel, payload: bytes, **about: Any) -> None:
        assert type(payload) is bytes
        assert about.get("sent") is None
        super().take(channel, payload, **about)

    def say(self, text: str) -> None:
        assert "\n" not in text
        super().say(text)

    def payloads(self, topic: str = "/topic") -> list[bytes]:
        return super().payloads(topic)

    def wait_for(self, *payloads: bytes, topic: str = "/topic") -> None:
        self.wait(lambda: len(self.payloads(topic)) >= len(payloads))
        assert self.payloads(topic) == list(payloads)

    def wait_said(self, *parts: str) -> str:

        def found() -> list[str]:
            return [line for line in self.said if all(part in line for part in parts)]

        self.wait(lambda: bool(found()))
        return found()[0]
