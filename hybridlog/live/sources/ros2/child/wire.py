"""Protocol between the child in the ROS environment and the recorder.

Both ends come from one installation and share one socket. The child sends frames: kind and
length, then the body. Small messages are packed by the hundred. Large ones have their own
frame, so that the reader can receive a payload without a copy. Everything else is a JSON
object. The recorder sends lines of JSON. At the end of its input the child passes on its
remaining messages and ends.
"""

from __future__ import annotations

import json
import struct
from typing import Any

EVENT = 1
"""Body: a JSON object; its `event` names the kind of event."""

MESSAGES = 2
"""Body: number of messages (uint32), an `ENTRY` for each, then their payloads."""

MESSAGE = 3
"""Body: one `ENTRY`, then the payload."""

HEADER = struct.Struct("<II")
"""Kind of the frame, and length of its body in bytes."""

COUNT = struct.Struct("<I")

ENTRY = struct.Struct("<IIqqq")
"""Channel, payload bytes, receive and send time (ns since the epoch), sequence number.

The send time is 0 and the number -1 if the middleware does not know them.
"""

MAX_PAYLOAD = 1 << 30
"""Bytes of the largest payload."""

MAX_BATCH = 16 << 20
"""Bytes of the largest body of a frame with several messages or an event."""

LARGE = 32 << 10
"""Payloads from this size on have their own frame, bytes."""


class WireError(Exception):
    """The other end violates the protocol."""


def event_frame(event: dict[str, Any]) -> bytes:
    """The frame of an event."""
    body = json.dumps(event).encode("ascii")
    return HEADER.pack(EVENT, len(body)) + body


def parse_object(body: bytes) -> dict[str, Any]:
    """Parses a JSON object.

    Raises:
        WireError: The text is not a JSON object.
    """
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise WireError(f"invalid JSON: {error}") from error
    if not isinstance(found, dict):
        raise WireError("a JSON value that is not an object")
    return found


def check_frame(kind: int, length: int) -> None:
    """Checks the header of a frame.

    Raises:
        WireError: The kind is unknown, or the length is impossible.
    """
    if kind == EVENT:
        low, high = 2, MAX_BATCH
    elif kind == MESSAGES:
        low, high = COUNT.size, MAX_BATCH
    elif kind == MESSAGE:
        low, high = ENTRY.size, ENTRY.size + MAX_PAYLOAD
    else:
        raise WireError(f"a frame of unknown kind {kind}")
    if not low <= length <= high:
        raise WireError(f"a frame of kind {kind} with an impossible length of {length} bytes")
