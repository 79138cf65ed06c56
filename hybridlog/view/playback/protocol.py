"""Messages of the Foxglove WebSocket protocol, as a server that plays recordings speaks it."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from struct import Struct, error
from typing import Annotated, Final

import msgspec

from hybridlog.live.sources.foxglove.protocol import MESSAGE_DATA, TIME
from hybridlog.schema.completion import with_nested
from hybridlog.view.playback.played import PlayedChannel

_BASE64 = frozenset({"protobuf", "flatbuffer"})
_DATA = Struct("<BIQ")  # opcode, subscription, log time
_TIME = Struct("<BQ")
_STATE = Struct("<BBQfBI")  # opcode, status, time, speed, did seek, length of the request's id
_CONTROL = Struct("<BBfBQI")  # opcode, command, speed, seeks, time, length of the id
_PLAYBACK_STATE: Final = 5
_PLAYBACK_CONTROL: Final = 3
_PLAY: Final = 0
_PAUSE: Final = 1


class RequestError(Exception):
    """A client violates the protocol; the message is for the client."""


class Status(IntEnum):
    """State of a playback."""

    PLAYING = 0
    PAUSED = 1
    ENDED = 3


class Level(IntEnum):
    """Severity of a status message."""

    WARNING = 1
    ERROR = 2


_Number = Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]


class Subscription(msgspec.Struct):
    """A subscription, and the channel that it is for."""

    id: _Number
    channel: _Number = msgspec.field(name="channelId")


class Subscribe(msgspec.Struct, tag_field="op", tag="subscribe"):
    """A request for channels."""

    subscriptions: list[Subscription]


class Unsubscribe(msgspec.Struct, tag_field="op", tag="unsubscribe"):
    """A request to end subscriptions, by their numbers."""

    subscriptions: list[_Number] = msgspec.field(name="subscriptionIds")


class SubscribeGraph(msgspec.Struct, tag_field="op", tag="subscribeConnectionGraph"):
    """A request for the publishers of the topics."""


class UnsubscribeGraph(msgspec.Struct, tag_field="op", tag="unsubscribeConnectionGraph"):
    """An end of that, which changes nothing: the graph never changes."""


@dataclass(frozen=True, slots=True)
class Control:
    """A request to play, to pause, to go to a time, or to change the speed.

    Attributes:
        plays: Play, or pause.
        speed: Seconds of log time a second, as asked.
        seek: Log time to go to, ns; None to stay.
        id: The client's name of the request.
    """

    plays: bool
    speed: float
    seek: int | None
    id: bytes


_Text = Subscribe | Unsubscribe | SubscribeGraph | UnsubscribeGraph
Request = _Text | Control


def server_info(name: str, session: str, begin: int, end: int) -> str:
    """The first message to a client.

    Args:
        name: Name of the server.
        session: Names this run of the server.
        begin: First log time that can be played, ns.
        end: Last log time, ns.
    """
    return json.dumps(
        {
            "op": "serverInfo",
            "name": name,
            "capabilities": ["playbackControl", "time", "connectionGraph"],
            "sessionId": session,
            "dataStartTime": _seconds(begin),
            "dataEndTime": _seconds(end),
        }
    )


def advertise(channels: Iterable[PlayedChannel]) -> str:
    """The message that offers channels. Channels without a definition have an empty one."""
    return json.dumps({"op": "advertise", "channels": [_described(each) for each in channels]})


def connection_graph(channels: Iterable[PlayedChannel]) -> str:
    """The message with the publishers of the topics, as far as the recordings name them."""
    publishers: dict[str, list[str]] = {}
    for each in channels:
        publishers.setdefault(each.channel.topic, []).extend(each.publishers)
    published = [{"name": t, "publisherIds": p} for t, p in publishers.items() if p]
    return json.dumps(
        {
            "op": "connectionGraphUpdate",
            "publishedTopics": published,
            "subscribedTopics": [],
            "advertisedServices": [],
            "removedTopics": [],
            "removedServices": [],
        }
    )


def status(level: Level, text: str) -> str:
    """A message for the user of the client."""
    return json.dumps({"op": "status", "level": level, "message": text})


def message_data(subscription: int, log_time: int, payload: memoryview) -> bytes:
    """A message of a subscription; its log time is in ns."""
    return b"".join((_DATA.pack(MESSAGE_DATA, subscription, log_time), payload))


def time_now(position: int) -> bytes:
    """The log time of the playback, ns."""
    return _TIME.pack(TIME, position)


def playback_state(
    status: Status, position: int, speed: float, *, did_seek: bool, request: bytes
) -> bytes:
    """A message with the state of the playback.

    Args:
        status: Its state.
        position: Log time, ns.
        speed: Seconds of log time a second.
        did_seek: The log time was set: what clients have shown no longer holds.
        request: Id of the request that this answers; empty if it answers none.
    """
    head = _STATE.pack(_PLAYBACK_STATE, status, position, speed, did_seek, len(request))
    return head + request


def parse(message: str | bytes) -> Request:
    """A message of a client.

    Raises:
        RequestError: It is malformed, or asks for what a playback does not have.
    """
    if isinstance(message, bytes):
        return _parse_binary(message)
    try:
        request: _Text = msgspec.json.decode(message, type=_Text)
    except (msgspec.MsgspecError, RecursionError, UnicodeError) as problem:
        raise RequestError(f"a message is no request to a playback: {problem}") from problem
    return request


def _parse_binary(message: bytes) -> Control:
    if message[:1] != bytes([_PLAYBACK_CONTROL]):
        raise RequestError("a playback takes no messages of clients")
    try:
        _, command, speed, seeks, position, length = _CONTROL.unpack_from(message)
    except error as problem:
        raise RequestError("a playback control request is cut short") from problem
    name = message[_CONTROL.size :]
    if command not in {_PLAY, _PAUSE} or len(name) != length:
        raise RequestError("a playback control request is malformed")
    return Control(command == _PLAY, speed, position if seeks else None, name)


def _seconds(time: int) -> dict[str, int]:
    return {"sec": time // 10**9, "nsec": time % 10**9}


def _described(each: PlayedChannel) -> dict[str, object]:
    channel = each.channel
    schema = None if channel.schema is None else with_nested(channel.schema)
    found: dict[str, object] = {
        "id": each.id,
        "topic": channel.topic,
        "encoding": channel.message_encoding,
        "schemaName": schema.name if schema is not None else "",
        "schema": "",
    }
    if schema is not None and schema.encoding:
        found["schemaEncoding"] = schema.encoding
        if schema.encoding in _BASE64:
            found["schema"] = base64.b64encode(schema.data).decode()
        else:
            found["schema"] = schema.data.decode("utf-8", "replace")
    return found
