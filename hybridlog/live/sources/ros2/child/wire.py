"""How the child in the ROS environment and the recorder speak with each other.

Both ends are from one installation, on one machine, over one socket. From the child come
frames: kind and length, then the body. Messages are packed by the hundred, large ones go
alone, so that the reader can take a payload from the socket without a copy in between.
All else is an object in JSON. To the child go lines of JSON; the end of its input is its
order to hand over what it has, and to end.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

import json
import struct
from typing import Any

EVENT = 1
"""Body: an object in JSON; its `event` says what it tells."""

MESSAGES = 2
"""Body: how many (uint32), an `ENTRY` for each, then their payloads one after the other."""

MESSAGE = 3
"""Body: one `ENTRY`, then its payload."""

HEADER = struct.Struct("<II")
"""Kind and length of the body, bytes."""

COUNT = struct.Struct("<I")

ENTRY = struct.Struct("<IIqqq")
"""Channel, bytes of payload, received and sent (ns since the epoch), the sender's number.

`sent` is 0 and the number -1 where the middleware knows none.
"""

MAX_PAYLOAD = 1 << 30
"""Bytes of the largest message that is handed over."""

MAX_BATCH = 16 << 20
"""Bytes of the largest body of a frame that holds many messages or an event."""

LARGE = 32 << 10
"""Payloads from this many bytes on travel alone."""


class WireError(Exception):
    """The other end says what it must not."""


def event_frame(event: dict[str, Any]) -> bytes:
    """An event as it travels."""
    body = json.dumps(event).encode("ascii")
    return HEADER.pack(EVENT, len(body)) + body


def parse_object(body: bytes) -> dict[str, Any]:
    """The object that a line or the body of an event is.

    Raises:
        WireError: It is none.
    """
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise WireError(f"what should be JSON is not: {error}") from error
    if not isinstance(found, dict):
        raise WireError("a JSON value that is no object")
    return found


def check_frame(kind: int, length: int) -> None:
    """Believes a frame's header, or not.

    Raises:
        WireError: No such kind, or a body that cannot be so short or so long.
    """
    if kind == EVENT:
        low, high = 2, MAX_BATCH
    elif kind == MESSAGES:
        low, high = COUNT.size, MAX_BATCH
    elif kind == MESSAGE:
        low, high = ENTRY.size, ENTRY.size + MAX_PAYLOAD
    else:
        raise WireError(f"a frame of kind {kind}, which does not exist")
    if not low <= length <= high:
        raise WireError(f"a frame of kind {kind} and {length} bytes, more or less than can be")
