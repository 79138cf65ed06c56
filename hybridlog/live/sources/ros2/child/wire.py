"""Protocol between the child in the ROS environment and the recorder.

Both ends come from one installation and share one socket. The child sends frames: kind and
length, then the body: a message, or a JSON object. The recorder sends lines of JSON. At the
end of its input the child passes on its remaining messages and ends.
"""

from __future__ import annotations

import json
import struct
from typing import Any

EVENT = 1
"""Body: a JSON object; its `event` names the kind of event."""

MESSAGE = 2
"""Body: one `ENTRY`, then the payload."""

HEADER = struct.Struct("<II")
"""Kind of the frame, and length of its body in bytes."""

ENTRY = struct.Struct("<IIqqq")
"""Channel, payload bytes, receive and send time (ns since the epoch), sequence number.

The send time is 0 and the number -1 if the middleware does not know them.
"""

MAX_PAYLOAD = 1 << 30
"""Bytes of the largest payload."""

MAX_EVENT = 16 << 20
"""Bytes of the largest event."""


class WireError(Exception):
    """The other end violates the protocol."""


def event_frame(event: dict[str, Any]) -> bytes:
    """The frame of an event."""
    body = json.dumps(event).encode("ascii")
    return HEADER.pack(EVENT, len(body)) + body


def parse_object(body: bytes) -> dict[str, Any]:
    """Parses a JSON object."""
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise WireError(f"invalid JSON: {error}") from error
    if not isinstance(found, dict):
        raise WireError("a JSON value that is not an object")
    return found


def check_frame(kind: int, length: int) -> None:
    """Checks the header of a frame."""
    if kind == EVENT:
        low, high = 2, MAX_EVENT
    elif kind == MESSAGE:
        low, high = ENTRY.size, ENTRY.size + MAX_PAYLOAD
    else:
        raise WireError(f"a frame of unknown kind {kind}")
    if not low <= length <= high:
        raise WireError(f"a frame of kind {kind} with an impossible length of {length} bytes")
