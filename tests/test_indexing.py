"""What the catalog is told of the chunks of a segment, beside what a loop over them says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.index.indexing import ChunkIndexer
from hybridlog_storage.messages import Batch, Channel, Schema
from hybridlog_storage.segments.chunk import StoredChunk

STAMPED = (
    b"std_msgs/Header header\n" + b"=" * 80 + b"\n"
    b"MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
)
CHANNELS = {
    1: Channel("/stamped", "ros1", Schema("test/Stamped", "ros1msg", STAMPED)),
    2: Channel("/opaque", "own", None, has_publish_time=False),
}
Message = tuple[int, int | None, int, int]
"""Channel, stamp of one that can be read, log time and publish time."""
TIMES = st.integers(0, 2**63 - 1)
MESSAGES: st.SearchStrategy[Message] = st.tuples(
    st.sampled_from([1, 2]),
    st.one_of(st.just(0), st.none(), st.integers(1, 2**32 * 10**9 - 1)),
    TIMES,
    TIMES,
)


def payload_of(message: Message) -> bytes:
    channel, stamp, *_ = message
    if channel == 2 or stamp is None:
        return b"short"
    return np.array([7, *divmod(stamp, 10**9), 0], "<u4").tobytes()


def chunk_of(messages: Sequence[Message], number: int) -> StoredChunk:
    payloads = [payload_of(message) for message in messages]
    length = np.array([*map(len, payloads)], np.int64)
    channels, _, log_times, publish_times = zip(*messages, strict=True)
    batch = Batch(
        b"".join(payloads),
        np.cumsum(length) - length,
        length,
        np.array(channels, np.int32),
        np.array(log_times, np.int64),
        np.array(publish_times, np.int64),
        np.zeros(len(messages), np.uint32),
    )
    place = {"segment": 1, "number": number, "offset": 1000 * number}
    sizes = {"length": 50, "trailer": 5}
    return StoredChunk(**place, **sizes, batch=batch, seq=np.arange(len(messages)))


@given(st.lists(st.lists(MESSAGES, min_size=1, max_size=6), min_size=1, max_size=5))
def test_an_entry_says_what_is_in_its_chunk(chunks: list[list[Message]]) -> None:
    stored = [chunk_of(messages, number) for number, messages in enumerate(chunks)]
    _, decoded = ChunkIndexer("0123456789abcdef" * 2).documents_of(stored, CHANNELS)
    for found, messages in zip(decoded, chunks, strict=True):
        assert found.keys() == {channel for channel, *_ in messages}
        for number, stats in found.items():
            own = [message for message in messages if message[0] == number]
            _, stamps, log_times, _ = zip(*own, strict=True)
            if number == 1:
                read = [stamp for stamp in stamps if stamp is not None]
                skews = [at - stamp for stamp, at in zip(stamps, log_times, strict=True) if stamp]
                assert stats.unreadable == len(own) - len(read)
                assert (stats.stamped, stats.unset) == (len(read), read.count(0))
                assert stats.first_stamp == min(filter(None, read), default=None)
                assert stats.last_stamp == max(filter(None, read), default=None)
                assert stats.skew_min == min(skews, default=None)
                assert stats.skew_max == max(skews, default=None)
                assert stats.skew_sum == pytest.approx(float(sum(skews)), rel=1e-9, abs=1e4)
