"""Latching channels: a subscriber that joins late receives their last messages."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from hybridlog.arrays import is_video_type
from hybridlog.formats.yaml_values import YamlError, parse_yaml
from hybridlog_storage.errors import DefinitionError, PayloadError

if TYPE_CHECKING:
    from hybridlog_storage.messages import Buffer, Channel

KEEP_ALL: Final = 1 << 62
"""Depth of a publisher that keeps all of its messages."""

_TRANSIENT_LOCAL = re.compile(r"durability\W+(?:1|\w*transient_local)\b", re.IGNORECASE)
_MAX_TEXT = 32 << 10  # characters; profiles of more than a hundred publishers are counted only
_POLICIES = frozenset({"durability", "history", "depth"})


def depth_of(channel: Channel) -> int:
    """Number of last messages that a late subscriber receives; 0 without latching.

    A ROS 1 connection latches one message. A ROS 2 channel mixes the publishers of its topic:
    the depths of the transient-local ones are added, and an unknown depth counts as one.
    """
    metadata = channel.metadata
    if metadata.get("latching", "").lower() in {"1", "true"}:
        return 1
    return _offered_depth(metadata.get("offered_qos_profiles", ""))


def is_video(channel: Channel) -> bool:
    """True if a channel's messages are frames of video."""
    return channel.schema is not None and is_video_type(channel.schema.name)


def is_key_frame(channel: Channel, payload: Buffer) -> bool:
    """True if a message of a video channel is a key frame."""
    from hybridlog.arrays import bitstream
    from hybridlog.schema.codecs import codec_for

    try:
        form, data = bitstream.frame_of(codec_for(channel).decode(memoryview(payload)))
    except (PayloadError, DefinitionError):
        return False
    return bitstream.is_key_frame(form, data)


def publisher_of(channel: Channel) -> Hashable:
    """Identifies the publishers whose messages displace one another.

    A ROS 1 node may have several connections, for example after a restart.
    """
    caller = channel.metadata.get("callerid")
    return (channel.topic, caller) if caller else channel


@lru_cache(maxsize=256)
def _offered_depth(text: str) -> int:
    """The sum of the depths of the transient-local profiles in a YAML list."""
    if "durability" not in text:
        return 0
    if len(text) > _MAX_TEXT:
        return len(_TRANSIENT_LOCAL.findall(text))
    try:
        profiles = parse_yaml(text, _POLICIES)
        if isinstance(profiles, str):  # the list itself was quoted
            profiles = parse_yaml(profiles, _POLICIES)
    except YamlError:
        return len(_TRANSIENT_LOCAL.findall(text))
    listed = profiles if isinstance(profiles, list) else [profiles]
    depths = [_depth(one) for one in listed if isinstance(one, Mapping)]
    return min(sum(depths), KEEP_ALL)


def _depth(profile: Mapping[object, object]) -> int:
    """The depth of one profile, 0 for one that is not transient local.

    Policies are numbers of rmw or names: `1`, `transient_local`.
    """
    if not _is(profile.get("durability"), 1, "transient_local"):
        return 0
    if _is(profile.get("history"), 2, "keep_all"):
        return KEEP_ALL
    depth = profile.get("depth")
    return depth if isinstance(depth, int) and depth > 0 else 1


def _is(policy: object, number: int, name: str) -> bool:
    text = str(policy).lower()
    return text == str(number) or text.endswith(name)
