"""Latching channels: late subscribers receive their last messages."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

_TRANSIENT_LOCAL = re.compile(r"durability:\s*(?:1|transient_local)\b")
_MAX_DEPTH = 1000


def depth_of(channel: Channel) -> int:
    """Number of a channel's last messages that a late subscriber gets; 0 without latching.

    A ROS 1 connection latches one message. A ROS 2 channel mixes the publishers of its
    topic, whose number the depth does not show: all messages count, up to a limit.
    """
    metadata = channel.metadata
    if metadata.get("latching") in {"1", "true"}:
        return 1
    if _TRANSIENT_LOCAL.search(metadata.get("offered_qos_profiles", "")):
        return _MAX_DEPTH
    return 0
