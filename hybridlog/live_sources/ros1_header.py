"""Which ROS 1 types publishers number."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

_FIELD: Final = re.compile(r"^[ \t]*([\w/]+(?:\[\d*\])?)[ \t]+(\w+)[ \t]*(=?)", re.MULTILINE)
_TYPES: Final = frozenset({"Header", "std_msgs/Header", "roslib/Header"})


def is_numbered(channel: Channel) -> bool:
    """Whether a publisher writes its own count into the first four bytes of each message.

    rospy and roscpp do so where the first field of a type is `Header header`. Publishers
    that say that they latch are left out: rospy counts the message that it repeats for one
    late subscriber, and all others then see a gap where nothing is missing.
    """
    schema = channel.schema
    if channel.message_encoding != "ros1" or schema is None or schema.encoding != "ros1msg":
        return False
    if channel.metadata.get("latching") == "1":
        return False
    head, _, _ = schema.data.decode(errors="replace").partition("\n=====")
    for found in _FIELD.finditer(head):
        kind, name, equals = found.groups()
        if not equals:
            return kind in _TYPES and name == "header"
    return False
