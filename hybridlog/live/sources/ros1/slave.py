"""The slave API of this node, and the socket where it listens."""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING, Final

from hybridlog.live.sources.base import one_line
from hybridlog.live.sources.network import Endpoint, reason_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from hybridlog.live.sources.network import Addresses, Network
    from hybridlog.live.sources.ros1.rpc import Method

_BACKLOG: Final = 64


async def listen(
    network: Network, environment: Mapping[str, str], say: Callable[[str], None]
) -> tuple[socket.socket, str]:
    """Opens the node's socket on `ROS_HOSTNAME` or `ROS_IP`; returns also its host for peers.

    Without these variables it listens on loopback. A master on another computer then cannot
    announce publishers, and polling finds them.
    """
    is_ipv6 = environment.get("ROS_IPV6") == "on"
    loopback = "::1" if is_ipv6 else "127.0.0.1"
    variable = "ROS_HOSTNAME" if environment.get("ROS_HOSTNAME") else "ROS_IP"
    host = environment.get(variable) or loopback
    try:
        return _bound(await network.addresses_of(host), is_ipv6=is_ipv6), host
    except OSError as error:
        if host == loopback:
            raise
        say(
            f"{variable}={one_line(host)} is not an address of this computer ({reason_of(error)}); "
            "the ROS master cannot announce publishers, so polling must find them"
        )
    return _bound(await network.addresses_of(loopback), is_ipv6=is_ipv6), loopback


def _bound(addresses: Addresses, *, is_ipv6: bool) -> socket.socket:
    """A socket that listens on the first address, if possible of the preferred family."""
    preferred = socket.AF_INET6 if is_ipv6 else socket.AF_INET
    family, address = min(addresses, key=lambda entry: entry[0] != preferred)
    made = socket.socket(family, socket.SOCK_STREAM)
    try:
        made.setblocking(False)
        made.bind(address)
        made.listen(_BACKLOG)
    except BaseException:
        made.close()
        raise
    return made


def uri_of(host: str, listening: socket.socket) -> str:
    """The node's address for calls."""
    return f"http://{Endpoint(host, listening.getsockname()[1])}/"


def methods(
    master_uri: str,
    topics: Callable[[], list[str]],
    changed: Callable[[str], None],
    say: Callable[[str], None],
) -> dict[str, Method]:
    """The slave API of a node that only subscribes.

    `topics` returns those that the node is registered for; `changed` is called with one whose
    publishers may have changed.
    """

    def publisher_update(arguments: tuple[object, ...]) -> list[object]:
        if len(arguments) == 3 and isinstance(arguments[1], str):
            changed(arguments[1])
            return [1, "", 0]
        return [-1, "publisherUpdate takes a caller, a topic and its publishers", 0]

    def shutdown(arguments: tuple[object, ...]) -> list[object]:
        caller = one_line(str(arguments[0])) if arguments else "a node"
        say(f"{caller} asks this node to shut down; only its own user can stop a recording")
        return [-1, "only its own user can stop a recorder", 0]

    def answer(value: Callable[[], object]) -> Method:
        return lambda _: [1, "", value()]

    return {
        "getBusInfo": answer(list),
        "getBusStats": answer(lambda: [[], [], []]),
        "getMasterUri": answer(lambda: master_uri),
        "getPid": answer(os.getpid),
        "getPublications": answer(list),
        "getSubscriptions": answer(lambda: [[topic, "*"] for topic in topics()]),
        "paramUpdate": answer(int),
        "publisherUpdate": publisher_update,
        "requestTopic": lambda _: [0, "this node publishes nothing", 0],
        "shutdown": shutdown,
    }
