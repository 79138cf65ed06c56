"""Messages of the Foxglove WebSocket protocol, as a server that plays recordings speaks it.

Times are log times in ns, speeds seconds of log time a second.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from struct import Struct, error
from typing import Annotated, Any, Final, NamedTuple

import msgspec

from hybridlog.live.sources.foxglove.protocol import MESSAGE_DATA
from hybridlog.view.playback.played import PlayedChannel

_BASE64 = frozenset({"protobuf", "flatbuffer"})
_DATA = Struct("<BIQ")  # opcode, subscription, log time
_TIME = Struct("<BQ")  # opcode 2, time
_STATE = Struct("<BBQfBI")  # opcode, status, time, speed, did seek, length of the request's id
_CONTROL = Struct("<BBfBQI")  # opcode, command, speed, seeks, time, length of the id
_PLAYBACK_STATE: Final = 5
_PLAYBACK_CONTROL: Final = 3
_PLAY, _PAUSE = 0, 1

PLAYING, PAUSED, ENDED = 0, 1, 3
"""States of a playback."""
_ERROR = 2  # severity of a status


class RequestError(Exception):
    """A client violates the protocol; the message is for the client."""


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


class Control(NamedTuple):
    """A request, by its id: play or pause, a speed, and a log time to go to; None to stay."""

    plays: bool
    speed: float
    seek: int | None
    id: bytes


_Text = Subscribe | Unsubscribe
Request = _Text | Control


def server_info(name: str, session: str, begin: int, end: int) -> str:
    """The first message to a client: the server, this run of it, first and last log time."""
    return json.dumps(
        {
            "op": "serverInfo",
            "name": name,
            "capabilities": ["playbackControl", "time"],
            "sessionId": session,
            "dataStartTime": {"sec": begin // 10**9, "nsec": begin % 10**9},
            "dataEndTime": {"sec": end // 10**9, "nsec": end % 10**9},
        }
    )


def advertise(channels: Iterable[PlayedChannel]) -> str:
    """The message that offers channels. Channels without a definition have an empty one."""
    return json.dumps({"op": "advertise", "channels": [_described(each) for each in channels]})


def _described(each: PlayedChannel) -> dict[str, Any]:
    channel = each.channel
    schema = None if channel.schema is None else channel.schema
    found = {"id": each.id, "topic": channel.topic, "encoding": channel.message_encoding}
    if schema is None or not schema.encoding:
        return {**found, "schemaName": schema.name if schema else "", "schema": ""}
    text = schema.data.decode("utf-8", "replace")
    if schema.encoding in _BASE64:
        text = base64.b64encode(schema.data).decode()
    more = {"schemaName": schema.name, "schemaEncoding": schema.encoding, "schema": text}
    return {**found, **more}


def problem(text: str) -> str:
    """A message for the user of the client: what went wrong."""
    return json.dumps({"op": "status", "level": _ERROR, "message": text})


def message_data(subscription: int, log_time: int, payload: memoryview) -> bytes:
    """A message of a subscription."""
    return b"".join((_DATA.pack(MESSAGE_DATA, subscription, log_time), payload))


def time_now(position: int) -> bytes:
    """The time of the playback."""
    return _TIME.pack(2, position)


def playback_state(state: int, time: int, speed: float, *, did_seek: bool, request: bytes) -> bytes:
    """A message with the state of the playback, for the request of an id, or none.

    After a seek, what clients have shown no longer holds.
    """
    return _STATE.pack(_PLAYBACK_STATE, state, time, speed, did_seek, len(request)) + request


def parse(message: str | bytes) -> Request:
    """A message of a client; one that is malformed or unknown raises RequestError."""
    if isinstance(message, str):
        try:
            request: _Text = msgspec.json.decode(message, type=_Text)
        except (msgspec.MsgspecError, RecursionError, UnicodeError) as problem:
            raise RequestError(f"a message is no request to a playback: {problem}") from problem
        return request
    try:
        kind, command, speed, seeks, position, length = _CONTROL.unpack_from(message)
    except error as problem:
        raise RequestError("a message is no whole request to a playback") from problem
    name = message[_CONTROL.size :]
    if kind != _PLAYBACK_CONTROL or command not in {_PLAY, _PAUSE} or len(name) != length:
        raise RequestError("a message is no request to a playback, which takes no messages")
    return Control(command == _PLAY, speed, position if seeks else None, name)
