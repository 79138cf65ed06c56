"""A ROS 1 master, as far as one publisher and one recorder need it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from socketserver import ThreadingMixIn
from types import TracebackType
from typing import Any, Self
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True
    block_on_close = False


class Master:
    """Runs in a thread, on loopback; knows publishers and subscribers, and no parameters.

    Attributes:
        uri: For `ROS_MASTER_URI`.
    """

    def __init__(self) -> None:
        self._publishers: dict[str, dict[str, str]] = {}
        self._subscribers: dict[str, dict[str, str]] = {}
        self._types: dict[str, str] = {}
        self._lock = threading.Lock()
        self._server = _Server(("127.0.0.1", 0), logRequests=False, allow_none=True)
        self.uri = f"http://127.0.0.1:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))

    def __enter__(self) -> Self:
        calls: dict[str, Callable[..., Any]] = {
            "getSystemState": self._state,
            "getTopicTypes": lambda _: list(map(list, self._types.items())),
            "getPublishedTopics": lambda *_: [
                [topic, self._types[topic]] for topic, nodes in self._publishers.items() if nodes
            ],
            "registerPublisher": self._publish,
            "unregisterPublisher": lambda _, topic, api: self._leave(self._publishers, topic, api),
            "registerSubscriber": self._subscribe,
            "unregisterSubscriber": lambda _, topic, api: self._leave(
                self._subscribers, topic, api
            ),
            "registerService": lambda *_: 1,
            "unregisterService": lambda *_: 1,
            "getUri": lambda _: self.uri,
            "getPid": lambda _: 1,
            "setParam": lambda *_: 0,
            "hasParam": lambda *_: False,
            "subscribeParam": lambda *_: {},
            "unsubscribeParam": lambda *_: 1,
        }
        for name, call in calls.items():
            self._server.register_function(self._answer(call), name)
        self._server.register_function(lambda *_: [-1, "there are no parameters", 0], "getParam")
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def _answer(self, call: Callable[..., Any]) -> Callable[..., list[Any]]:
        def answered(*arguments: Any) -> list[Any]:
            with self._lock:
                return [1, "", call(*arguments)]

        return answered

    def _state(self, _: str) -> list[Any]:
        return [
            [[topic, sorted(nodes.values())] for topic, nodes in table.items() if nodes]
            for table in (self._publishers, self._subscribers)
        ] + [[]]

    def _publish(self, node: str, topic: str, kind: str, api: str) -> list[str]:
        self._types[topic] = kind
        self._publishers.setdefault(topic, {})[api] = node
        apis = list(self._publishers[topic])
        for subscriber in list(self._subscribers.get(topic, ())):
            threading.Thread(target=_tell, args=(subscriber, topic, apis), daemon=True).start()
        return list(self._subscribers.get(topic, ()))

    def _subscribe(self, node: str, topic: str, _: str, api: str) -> list[str]:
        self._subscribers.setdefault(topic, {})[api] = node
        return list(self._publishers.get(topic, ()))

    @staticmethod
    def _leave(table: dict[str, dict[str, str]], topic: str, api: str) -> int:
        return int(table.get(topic, {}).pop(api, None) is not None)


def _tell(subscriber: str, topic: str, apis: list[str]) -> None:
    try:
        with ServerProxy(subscriber) as node:
            node.publisherUpdate("/master", topic, apis)
    except OSError:
        return  # it has ended
