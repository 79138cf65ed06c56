"""Client of the ROS master: topics, types, registrations."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from hybridlog.live.sources.ros1.network import PeerError
from hybridlog.live.sources.ros1.rpc import call

if TYPE_CHECKING:
    from hybridlog.live.sources.ros1.network import Network


class State(NamedTuple):
    """State of the ROS system at one time.

    Attributes:
        publishers: Names of each topic's publishers.
        ours: Topics that this node is registered for.
    """

    publishers: dict[str, frozenset[str]]
    ours: frozenset[str]


class Master:
    """Calls the master. Every call may raise `PeerError`.

    Args:
        network: Makes connections.
        uri: The master's address.
        caller: Name of this node.
        api: Address of this node, where the master announces publishers.
    """

    def __init__(self, network: Network, uri: str, caller: str, api: str) -> None:
        self._network = network
        self._uri = uri
        self._caller = caller
        self._api = api

    async def state(self) -> State:
        """All topics with their publishers."""
        answer = await self._call("getSystemState")
        if not isinstance(answer, list) or len(answer) != 3:
            raise PeerError("its answer is not that of a ROS master")
        publishers = {topic: nodes for topic, nodes in _lists(answer[0]).items() if nodes}
        subscribers = _lists(answer[1])
        ours = frozenset(t for t, nodes in subscribers.items() if self._caller in nodes)
        return State(publishers, ours)

    async def types(self) -> dict[str, str]:
        """Types of all topics; unknown ones are missing or `*`."""
        answer = await self._call("getTopicTypes")
        pairs = answer if isinstance(answer, list) else [None]
        types: dict[str, str] = {}
        for pair in pairs:
            if not isinstance(pair, list) or [type(part) for part in pair] != [str, str]:
                raise PeerError("its answer is not that of a ROS master")
            types[pair[0]] = pair[1]
        return types

    async def subscribe(self, topic: str) -> list[str]:
        """Registers this node for a topic, and returns its publishers' addresses."""
        answer = await self._call("registerSubscriber", topic, "*", self._api)
        if not isinstance(answer, list):
            raise PeerError("its answer is not that of a ROS master")
        return [uri for uri in answer if isinstance(uri, str)]

    async def unsubscribe(self, topic: str) -> None:
        """Takes back the registration for a topic."""
        await self._call("unregisterSubscriber", topic, self._api)

    async def _call(self, method: str, *arguments: object) -> object:
        return await call(self._network, self._uri, method, self._caller, *arguments)


def _lists(value: object) -> dict[str, frozenset[str]]:
    """Topics and their nodes in an answer to `getSystemState`."""
    lists: dict[str, frozenset[str]] = {}
    for pair in value if isinstance(value, list) else [None]:
        if (
            not isinstance(pair, list)
            or len(pair) != 2
            or not isinstance(pair[0], str)
            or not isinstance(pair[1], list)
        ):
            raise PeerError("its answer is not that of a ROS master")
        lists[pair[0]] = frozenset(node for node in pair[1] if isinstance(node, str))
    return lists
