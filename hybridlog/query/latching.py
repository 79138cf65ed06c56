"""Latching channels: a subscriber that joins late receives their last messages.

So they stand in front of the messages of a range; the frames of a video from its key frame too.
"""

from __future__ import annotations

import re
from bisect import insort
from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from hybridlog.arrays import is_video_type
from hybridlog_storage.errors import DefinitionError, PayloadError
from hybridlog_storage.messages import Batch, Buffer, Channel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.manifest import Channel as ListedChannel


KEEP_ALL: Final = 1 << 62
"""Depth of a publisher that keeps all of its messages."""

_POLICY = re.compile(r"\b(history|depth|durability)\W+(\w{1,60})")
"""A policy in a profile, whether it is written as YAML or JSON; a profile has each once."""

MAX_HELD: Final = 256 << 20
"""Payload bytes that are held; the last message of each publisher is held in any case."""

_BATCH = 2 << 20  # payload bytes


def depth_of(channel: Channel | ListedChannel) -> int:
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
    from hybridlog.arrays import video
    from hybridlog.schema.codecs import codec_for

    try:
        form, data = video.frame_of(codec_for(channel).decode(memoryview(payload)))
    except (PayloadError, DefinitionError):
        return False
    return video.is_key_frame(form, data)


def publisher_of(channel: Channel | ListedChannel, own: Hashable) -> Hashable:
    """Identifies the publishers whose messages displace one another; `own` stands for unknown ones.

    A ROS 1 node may have several connections, for example after a restart.
    """
    return channel.topic, channel.metadata.get("callerid") or own


@lru_cache(maxsize=256)
def _offered_depth(text: str) -> int:
    """The sum of the depths of the transient-local profiles in a list of them."""
    found, profile = 0, dict[str, str]()
    for name, value in (*_POLICY.findall(text.lower()), ("", "")):
        if name in profile or not name:
            found, profile = found + _depth(profile), {}
        profile[name] = value
    return min(found, KEEP_ALL)


def _depth(profile: Mapping[str, str]) -> int:
    """The depth of one profile, 0 for one that is not transient local.

    Policies are numbers of rmw or names: `1`, `transient_local`.
    """
    durability, history, depth = map(profile.get, ("durability", "history", "depth"), ("",) * 3)
    if durability != "1" and not durability.endswith("transient_local"):
        return 0
    if history == "2" or history.endswith("keep_all"):
        return KEEP_ALL
    return int(depth) if depth.isdecimal() and depth != "0" else 1


class _Held(NamedTuple):
    """A message; the order is that of log time and arrival."""

    log_time: int
    number: int
    is_key: bool
    channel: int
    publish_time: int
    sequence: int
    payload: bytes


class LatchedFront:
    """Holds the last messages of each publisher from before a slice until the log has ended.

    A log may be out of order, so only its end shows which messages are the last ones. Their log
    time becomes that of the slice's beginning, unless they keep their `original_times`. Messages of
    their channels with that very log time are held, too: of equal log times, the one that arrived
    last is current.

    Of video, the frames from the last key frame before the slice on are held, to which its first
    frames refer; none without such a key frame.

    Attributes:
        messages: Number of latched messages from before the slice.
        left_out: Number of those that were in force and could not be held.
    """

    def __init__(self, begin: int, *, original_times: bool) -> None:
        self._begin = begin
        self._original_times = original_times
        self._depths: list[int] = []
        self._channels: list[Channel] = []
        self._publishers: list[Hashable] = []
        self._last: dict[Hashable, list[_Held]] = defaultdict(list)
        self._at_begin: list[_Held] = []
        self._size = 0
        self._number = 0
        self.messages = 0
        self.left_out = 0

    def split(
        self, batch: Batch, inside: NDArray[np.bool_], channels: Sequence[Channel]
    ) -> NDArray[np.bool_]:
        """Take the messages to hold from the next ones of the log.

        `inside` is true for those of the slice. Returns bool[n], true for messages to write at
        once.
        """
        for channel in channels[len(self._depths) :]:
            self._depths.append(KEEP_ALL if is_video(channel) else depth_of(channel))
            self._channels.append(channel)
            self._publishers.append(publisher_of(channel, channel))
        is_latched = np.array(self._depths, np.int64)[batch.channel] > 0
        hold = is_latched & (batch.log_time < self._begin)
        if not self._original_times:
            hold |= is_latched & (batch.log_time == self._begin) & inside
        for row in np.flatnonzero(hold).tolist():
            hold[row] = self._hold(batch, row)
        return inside & ~hold

    def _hold(self, batch: Batch, row: int) -> bool:
        """Hold a message; False for one that is to be written at once."""
        number, payload = int(batch.channel[row]), bytes(batch.payload(row))
        channel = self._channels[number]
        self._number += 1
        held = _Held(
            int(batch.log_time[row]),
            self._number,
            is_video(channel) and is_key_frame(channel, payload),
            number,
            int(batch.publish_time[row]),
            int(batch.sequence[row]),
            payload,
        )
        is_before = held.log_time < self._begin
        if not is_before and self._size + len(payload) > MAX_HELD:
            return False
        last = self._last[self._publishers[number]] if is_before else self._at_begin
        insort(last, held)
        self._size += len(payload)
        keys = (place for place, one in enumerate(last) if one.is_key)
        cut = max(len(last) - self._depths[number], 0, *keys) if is_before else 0
        self._size -= sum(len(one.payload) for one in last[:cut])
        del last[:cut]
        while is_before and self._size > MAX_HELD and len(last) > 1:
            self._size -= len(last.pop(0).payload)
            self.left_out += 1
        return True

    def batches(self) -> Iterator[Batch]:
        """The held messages, in order; `channel` indexes the log's channels."""
        front = sorted(
            held
            for last in self._last.values()
            for held in last
            if last[0].is_key or not is_video(self._channels[held.channel])
        )
        self.messages += len(front)
        everything = [*front, *self._at_begin]
        ends = np.cumsum([len(held.payload) for held in everything]) // _BATCH
        for _, group in groupby(zip(ends.tolist(), everything, strict=True), itemgetter(0)):
            yield self._moved(_batch_of([held for _, held in group]))

    def _moved(self, batch: Batch) -> Batch:
        """The messages with the log time of the beginning, where they are from before it."""
        if self._original_times:
            return batch
        moved = batch.take(slice(None))
        moved.log_time = np.maximum(batch.log_time, self._begin)
        # Without publish times, they repeat the log times.
        has_own = np.array([one.has_publish_time for one in self._channels])[batch.channel]
        moved.publish_time = np.where(has_own, batch.publish_time, moved.log_time)
        return moved


def _batch_of(group: Sequence[_Held]) -> Batch:
    length = np.fromiter((len(held.payload) for held in group), np.int64, len(group))
    return Batch(
        buffer=b"".join(held.payload for held in group),
        offset=np.cumsum(length) - length,
        length=length,
        channel=np.array([held.channel for held in group], np.int32),
        log_time=np.array([held.log_time for held in group], np.int64),
        publish_time=np.array([held.publish_time for held in group], np.int64),
        sequence=np.array([held.sequence for held in group], np.uint32),
    )
