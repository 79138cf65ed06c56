"""The parts of rclpy that a recorder needs: graph, raw subscriptions, waiting.

No other module imports rclpy. Subscriptions are polled: an executor creates a task per
message, and has a fifth of the speed.

On one computer Fast DDS transports messages through shared memory of the publisher: half a
megabyte for all its topics. A larger message or a burst is overwritten before it is read. A
subscriber with UDP addresses only gets messages through a socket, whose buffer it can enlarge.
Discovery still uses shared memory. So there is a default profile, unless the user has one; other
middlewares ignore it.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from hybridlog.live.sources.ros2.child.definitions import TypeName

_ID = 16
"""Length of a publisher's id in bytes; some releases pad it with zeros."""


class Offer(NamedTuple):
    """A publisher.

    Attributes:
        publisher: Its id, as in its messages.
        node: Name of its node with the namespace; empty until it is known.
        type_hash: Hash of the type's description; empty in older releases.
    """

    publisher: bytes
    node: str
    profile: Profile
    type_hash: str


class Subscription(NamedTuple):
    """A raw subscription; `take` returns the next message and its information, or None."""

    inner: Any
    profile: Profile
    take: Callable[[], tuple[bytes, dict[str, Any]] | None]


class Middleware:
    """A node without services, parameters or log topic.

    Attributes:
        implementation: Name of the middleware, such as `rmw_fastrtps_cpp`.
    """

    def __init__(self) -> None:
        import rclpy  # type: ignore[import-not-found]
        from rclpy.impl.implementation_singleton import (  # type: ignore[import-not-found]
            rclpy_implementation,
        )
        from rclpy.signals import SignalHandlerOptions  # type: ignore[import-not-found]

        self._rclpy = rclpy
        self._native = rclpy_implementation
        self._silent = _no_callbacks()
        name = f"hybridlog_recorder_{os.getpid()}"
        self._own = f"/{name}"
        with default_profile():
            rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
            self._context = rclpy.get_default_context()
            self._node = rclpy.create_node(
                name,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
        self._guard = self._node.create_guard_condition(lambda: None)
        self._wait_set: Any = None
        self._open: list[Subscription] = []
        self._at: dict[int, Subscription] = {}
        self.implementation = str(rclpy.get_rmw_implementation_identifier())

    def wake(self) -> None:
        """Ends a wait; thread safe, even while the node closes."""
        with suppress(self._native.InvalidHandle):
            self._guard.trigger()

    def publishers(self) -> dict[tuple[str, str], list[Offer]]:
        """All publishers of other nodes, by topic and type."""
        found: dict[tuple[str, str], list[Offer]] = {}
        for topic, _ in self._node.get_topic_names_and_types():
            # rclpy raises errors of many kinds, such as for a name of DDS that ROS refuses.
            with suppress(Exception):
                for info in self._node.get_publishers_info_by_topic(topic):
                    offer = _offer(info)
                    if offer.node != self._own:
                        found.setdefault((topic, str(info.topic_type)), []).append(offer)
        return found

    def subscribe(self, topic: str, kind: TypeName, profile: Profile) -> Subscription:
        """Subscribes to serialized messages; raises ImportError, or any error of rclpy."""
        handle = self._node.create_subscription(
            message_class(kind),
            topic,
            lambda _: None,  # never called: the node does not spin
            self._quality(profile),
            raw=True,
            event_callbacks=self._silent,
        )
        found = Subscription(
            handle, profile, partial(handle.handle.take_message, handle.msg_type, True)
        )
        self._open.append(found)
        self._wait_set = None
        return found

    def close_one(self, subscription: Subscription) -> None:
        """Ends a subscription; messages that were not taken are gone."""
        self._open.remove(subscription)
        self._wait_set = None
        self._node.destroy_subscription(subscription.inner)

    def wait(self, seconds: float) -> list[Subscription]:
        """Waits, with a time limit, and returns the subscriptions that have messages."""
        if self._wait_set is None:
            self._at = {sub.inner.handle.pointer: sub for sub in self._open}
            self._wait_set = self._native.WaitSet(
                len(self._open), 1, 0, 0, 0, 0, self._context.handle
            )
        wait_set = self._wait_set
        wait_set.clear_entities()
        add = wait_set.add_subscription
        for sub in self._open:
            add(sub.inner.handle)
        wait_set.add_guard_condition(self._guard.handle)
        wait_set.wait(int(seconds * 1e9))
        return [self._at[pointer] for pointer in wait_set.get_ready_entities("subscription")]

    def close(self) -> None:
        """Removes the nodes from the graph."""
        self._wait_set = None
        self._node.destroy_node()
        self._rclpy.shutdown()

    def _quality(self, profile: Profile) -> Any:
        """The rclpy object of a profile."""
        from rclpy.duration import Duration  # type: ignore[import-not-found]
        from rclpy.qos import QoSProfile  # type: ignore[import-not-found]

        return QoSProfile(
            **{
                name: Duration(nanoseconds=value) if name in DURATIONS else value
                for name, value in profile._asdict().items()
            }
        )


def _no_callbacks() -> Any:
    """Event callbacks that keep rclpy from logging unhandled events."""
    try:
        module = import_module("rclpy.event_handler")
    except ImportError:
        module = import_module("rclpy.qos_event")  # its name in Humble
    return module.SubscriptionEventCallbacks(use_default_callbacks=False)


def _offer(info: Any) -> Offer:
    """A publisher from the information in the graph."""
    quality = info.qos_profile
    profile = Profile(
        history=int(quality.history),
        depth=int(quality.depth),
        reliability=int(quality.reliability),
        durability=int(quality.durability),
        deadline=int(quality.deadline.nanoseconds),
        lifespan=int(quality.lifespan.nanoseconds),
        liveliness=int(quality.liveliness),
        liveliness_lease_duration=int(quality.liveliness_lease_duration.nanoseconds),
        avoid_ros_namespace_conventions=bool(quality.avoid_ros_namespace_conventions),
    )
    node = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
    if "_NODE_NAME_UNKNOWN_" in node:
        node = ""
    type_hash = getattr(info, "topic_type_hash", None)
    known = type_hash is not None and type_hash.version > 0
    return Offer(
        publisher=publisher_id(bytes(info.endpoint_gid)),
        node=node,
        profile=profile,
        type_hash=str(type_hash) if known else "",
    )


def publisher_id(gid: bytes) -> bytes:
    """A publisher's id, cut to the common length in graph and messages."""
    return gid[:_ID]


def message_class(kind: TypeName) -> Any:
    """The Python class of a type; ImportError without one."""
    found: Any = import_module(f"{kind.package}.{kind.folder}")
    # The event of an action's service is Name.Impl.SendGoalService.Event.
    steps = {
        "": [],
        "Event": ["Event"],
        "FeedbackMessage": ["Impl", "FeedbackMessage"],
        "SendGoal_Event": ["Impl", "SendGoalService", "Event"],
        "GetResult_Event": ["Impl", "GetResultService", "Event"],
    }[kind.part]
    for step in [kind.name, *steps]:
        try:
            found = getattr(found, step)
        except AttributeError as error:
            name = "/".join(kind[:3])
            raise ImportError(f"the installed Python module of {name} has no {step}") from error
    return found


VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""Variables with the file name of a profile; releases before 3 know the second."""

_OTHERS = ("FASTDDS_BUILTIN_TRANSPORTS", "ROS2_EASY_MODE")
_FILES = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")

_KERNEL_LIMIT = Path("/proc/sys/net/core/rmem_max")
"""Of socket buffers, bytes."""

BUFFER = 32 << 20
"""Socket buffer in bytes, if the kernel allows it."""

_MIN_BUFFER = 1 << 17
"""Fast DDS refuses socket buffers smaller than one datagram."""

_PROFILE = """\
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>hybridlog_udp</transport_id>
      <type>UDPv4</type>
      <receiveBufferSize>{size}</receiveBufferSize>
    </transport_descriptor>
    <transport_descriptor>
      <transport_id>hybridlog_shm</transport_id>
      <type>SHM</type>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="hybridlog" is_default_profile="true"><rtps>
    <defaultUnicastLocatorList><locator><udpv4/></locator></defaultUnicastLocatorList>
    <userTransports>
      <transport_id>hybridlog_udp</transport_id>
      <transport_id>hybridlog_shm</transport_id>
    </userTransports>
    <useBuiltinTransports>false</useBuiltinTransports>
  </rtps></participant>
</profiles></dds>
"""


def is_set_up(environment: MutableMapping[str, str], folder: Path) -> bool:
    """Tells whether the user has chosen a profile or a transport of Fast DDS.

    It looks for profiles in `folder`, too, the working directory of the child.
    """
    named = any(environment.get(name) for name in (*VARIABLES, *_OTHERS))
    return named or any((folder / name).exists() for name in _FILES)


@contextmanager
def default_profile(environment: MutableMapping[str, str] = os.environ) -> Iterator[bool]:
    """Provides the profile while Fast DDS starts; yields False if it does not apply."""
    if is_set_up(environment, Path.cwd()):
        yield False
        return
    try:
        limit = int(_KERNEL_LIMIT.read_text(encoding="ascii"))
        number, name = tempfile.mkstemp(prefix="hybridlog-", suffix=".xml")
    except (OSError, ValueError):
        # No folder is writable. Fast DDS starts without the profile, and may lose more.
        yield False
        return
    try:
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(_PROFILE.format(size=max(_MIN_BUFFER, min(BUFFER, limit))))
        environment.update(dict.fromkeys(VARIABLES, name))
        yield True
    finally:
        for variable in VARIABLES:
            environment.pop(variable, None)
        Path(name).unlink(missing_ok=True)


KEEP_LAST = 1
RELIABLE, BEST_EFFORT = 1, 2
TRANSIENT_LOCAL, VOLATILE = 1, 2
AUTOMATIC = 1

DEPTH = 4000
"""Messages that the middleware queues for a subscription, while the recorder reads others.

The queue takes memory only for messages that it holds.
"""

DEPTH_OF_BYTES = 256
"""The same for types with byte arrays, such as images and point clouds, which are large."""

_SECOND = 1_000_000_000


class Profile(NamedTuple):
    """Quality of service of one end of a topic.

    Attributes:
        history: 1 for keep last, 2 for keep all, or 0 or 3 when unknown.
        depth: Length of the queue, for keep last.
        reliability: `RELIABLE`, `BEST_EFFORT`, or another number that is unknown.
        durability: `TRANSIENT_LOCAL`, `VOLATILE`, or another number.
        deadline: Maximum time between two messages, ns; 0 or the greatest number for none.
        lifespan: Time for which a message is delivered, ns.
        liveliness: `AUTOMATIC`, 3 for manual by topic, or another number.
        liveliness_lease_duration: Time after which a silent publisher counts as dead, ns.
        avoid_ros_namespace_conventions: The DDS topic has the plain name.
    """

    history: int = KEEP_LAST
    depth: int = DEPTH
    reliability: int = RELIABLE
    durability: int = VOLATILE
    deadline: int = 0
    lifespan: int = 0
    liveliness: int = AUTOMATIC
    liveliness_lease_duration: int = 0
    avoid_ros_namespace_conventions: bool = False


DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")


def request(offers: Sequence[Profile], depth: int) -> Profile:
    """A request that is compatible with all publishers, of which there is at least one.

    It has the reliability and durability that all of them offer. A deadline or a lease would only
    exclude publishers.
    """
    reliable = all(offer.reliability == RELIABLE for offer in offers)
    lasting = all(offer.durability == TRANSIENT_LOCAL for offer in offers)
    return Profile(
        depth=depth,
        reliability=RELIABLE if reliable else BEST_EFFORT,
        durability=TRANSIENT_LOCAL if lasting else VOLATILE,
    )


def offered_text(offers: Sequence[Profile]) -> str:
    """Profiles of publishers as a YAML list, as in the metadata of bags."""
    lines: list[str] = []
    for offer in offers:
        mark = "- "
        for name, value in zip(Profile._fields, offer, strict=True):
            if name in DURATIONS:
                lines += [
                    f"  {name}:",
                    f"    sec: {value // _SECOND}",
                    f"    nsec: {value % _SECOND}",
                ]
            else:
                shown = str(value).lower() if isinstance(value, bool) else str(value)
                lines.append(f"{mark}{name}: {shown}")
            mark = "  "
    return "\n".join(lines)
