"""The ROS master as a subscriber needs it: who publishes what, and who may be told."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from hybridlog.live.sources.ros1.network import PeerError
from hybridlog.live.sources.ros1.rpc import call

if TYPE_CHECKING:
    from hybridlog.live.sources.ros1.network import Network


class State(NamedTuple):
    """What the master knows at a moment.

    Attributes:
        publishers: Names of the nodes that publish each topic.
        ours: Topics that we are registered for.
    """

    publishers: dict[str, frozenset[str]]
    ours: frozenset[str]


class Master:
    """Calls the master. Every call may raise `PeerError`.

    Args:
        network: Makes connections.
        uri: The master's address.
        caller: Our node's name.
        api: Our address, where the master tells of new publishers.
    """

    def __init__(self, network: Network, uri: str, caller: str, api: str) -> None:
        self._network = network
        self._uri = uri
        self._caller = caller
        self._api = api

    async def state(self) -> State:
        """All topics with their nodes."""
        answer = await self._call("getSystemState")
        if not isinstance(answer, list) or len(answer) != 3:
            raise PeerError("its answer is none that a ROS master gives")
        publishers = {topic: nodes for topic, nodes in _lists(answer[0]).items() if nodes}
        subscribers = _lists(answer[1])
        ours = frozenset(t for t, nodes in subscribers.items() if self._caller in nodes)
        return State(publishers, ours)

    async def types(self) -> dict[str, str]:
        """Types of all topics; those that nobody has told are missing, or are `*`."""
        answer = await self._call("getTopicTypes")
        pairs = answer if isinstance(answer, list) else [None]
        types: dict[str, str] = {}
        for pair in pairs:
            if not isinstance(pair, list) or [type(part) for part in pair] != [str, str]:
                raise PeerError("its answer is none that a ROS master gives")
            types[pair[0]] = pair[1]
        return types

    async def subscribe(self, topic: str) -> list[str]:
        """Registers us for a topic, again if need be; gives its publishers' addresses."""
        answer = await self._call("registerSubscriber", topic, "*", self._api)
        if not isinstance(answer, list):
            raise PeerError("its answer is none that a ROS master gives")
        return [uri for uri in answer if isinstance(uri, str)]

    async def unsubscribe(self, topic: str) -> None:
        """Takes our registration back."""
        await self._call("unregisterSubscriber", topic, self._api)

    async def _call(self, method: str, *arguments: object) -> object:
        return await call(self._network, self._uri, method, self._caller, *arguments)


def _lists(value: object) -> dict[str, frozenset[str]]:
    """Topics and their nodes, as they stand in the answer on the system's state."""
    lists: dict[str, frozenset[str]] = {}
    for pair in value if isinstance(value, list) else [None]:
        if (
            not isinstance(pair, list)
            or len(pair) != 2
            or not isinstance(pair[0], str)
            or not isinstance(pair[1], list)
        ):
            raise PeerError("its answer is none that a ROS master gives")
        lists[pair[0]] = frozenset(node for node in pair[1] if isinstance(node, str))
    return lists
