"""Index documents and catalog entries of chunks, together and each by itself."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.index.indexing import ChunkIndexer, Documents
from hybridlog_storage.messages import Batch, Channel, Schema
from hybridlog_storage.segments.chunk import StoredChunk

STAMPED = (
    b"std_msgs/Header header\nint16 value\nint16[] values\n" + b"=" * 80 + b"\n"
    b"MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
)
CHANNELS = {
    1: Channel("/stamped", "ros1", Schema("test/Stamped", "ros1msg", STAMPED)),
    2: Channel("/plain", "ros1", Schema("std_msgs/Int32", "ros1msg", b"int32 data\n")),
    3: Channel("/stamped", "json", None, has_publish_time=False),
    4: Channel("/opaque", "own", None),
}


def stamped(stamp: int, frame: bytes, values: int) -> bytes:
    head = np.array([7, *divmod(stamp, 10**9), len(frame)], "<u4").tobytes() + frame
    body = np.array([3], "<i2").tobytes() + np.array([values], "<u4").tobytes()
    return head + body + np.arange(values, dtype="<i2").tobytes()


PAYLOADS: dict[int, st.SearchStrategy[bytes]] = {
    1: st.one_of(
        st.builds(
            stamped,
            st.integers(0, 2**32 * 10**9 - 1),
            st.sampled_from([b"", b"base", b"\xff"]),
            st.sampled_from([0, 1, 5, 40]),
        ),
        st.just(b"short"),
    ),
    2: st.sampled_from([b"\1\0\0\0", b"", b"\1\0\0\0\0"]),
    3: st.sampled_from([b'{"header": {"stamp": 5}}', b'{"a": [1, 2]}', b"{", b""]),
    4: st.binary(max_size=5),
}
TIMES = st.integers(0, 2**63 - 1)
MESSAGES = st.sampled_from(sorted(PAYLOADS)).flatmap(
    lambda number: st.tuples(st.just(number), PAYLOADS[number], TIMES, TIMES)
)
CHUNKS = st.lists(st.lists(MESSAGES, min_size=1, max_size=6), min_size=1, max_size=5)

Message = tuple[int, bytes, int, int]
RECORDING = "0123456789abcdef" * 2


def chunk_of(messages: Sequence[Message], number: int) -> StoredChunk:
    length = np.array([len(payload) for _, payload, _, _ in messages], np.int64)
    batch = Batch(
        b"".join(payload for _, payload, _, _ in messages),
        np.cumsum(length) - length,
        length,
        np.array([channel for channel, _, _, _ in messages], np.int32),
        np.array([log_time for _, _, log_time, _ in messages], np.int64),
        np.array([publish_time for _, _, _, publish_time in messages], np.int64),
        np.zeros(len(messages), np.uint32),
    )
    return StoredChunk(
        segment=1 + number // 2,
        number=number % 2,
        offset=1000 * number,
        length=50,
        trailer=5,
        batch=batch,
        seq=np.arange(len(messages)),
        compressed_size=9,
    )


def by_topic(parts: Iterable[Documents]) -> Mapping[str, list[bytes]]:
    found: dict[str, list[bytes]] = defaultdict(list)
    for part in parts:
        for table in part.tables:
            found[part.topic] += [row.tobytes() for row in table]
    return {name: sorted(rows) for name, rows in found.items()}


@given(CHUNKS)
def test_chunks_together_are_what_they_are_apart(chunks: list[list[Message]]) -> None:
    stored = [chunk_of(messages, number) for number, messages in enumerate(chunks)]
    indexer = ChunkIndexer(RECORDING)
    documents, entries = indexer.documents_of(stored, CHANNELS)
    apart = [indexer.documents_of([chunk], CHANNELS) for chunk in stored]
    assert by_topic(documents) == by_topic(part for parts, _ in apart for part in parts)
    assert entries == [entry for _, (entry,) in apart]


@given(CHUNKS)
def test_an_entry_says_what_is_in_its_chunk(chunks: list[list[Message]]) -> None:
    stored = [chunk_of(messages, number) for number, messages in enumerate(chunks)]
    _, entries = ChunkIndexer(RECORDING).documents_of(stored, CHANNELS)
    for chunk, entry, messages in zip(stored, entries, chunks, strict=True):
        assert (entry.segment, entry.number) == (chunk.segment, chunk.number)
        assert entry.messages == len(messages)
        assert set(entry.stats) == {channel for channel, _, _, _ in messages}
        for number, stats in entry.stats.items():
            own = [message for message in messages if message[0] == number]
            log_times = [log_time for _, _, log_time, _ in own]
            publish_times = [publish_time for _, _, _, publish_time in own]
            assert stats.messages == len(own)
            assert stats.payload_bytes == sum(len(payload) for _, payload, _, _ in own)
            assert (stats.first, stats.last) == (min(log_times), max(log_times))
            assert stats.longest == max(log_times) - min(log_times)
            published = (min(publish_times), max(publish_times)) if number != 3 else (None, None)
            assert (stats.first_publish, stats.last_publish) == published
            if number == 1:
                read = [message for message in own if message[1] != b"short"]
                assert stats.unreadable == len(own) - len(read)
                stamps = [stamp_of(payload) for _, payload, _, _ in read]
                skews = [
                    log_time - stamp
                    for (_, _, log_time, _), stamp in zip(read, stamps, strict=True)
                    if stamp
                ]
                assert (stats.stamped, stats.unset) == (len(read), stamps.count(0))
                assert stats.first_stamp == min(stamps, default=None)
                assert stats.last_stamp == max(stamps, default=None)
                assert stats.skew_min == min(skews, default=None)
                assert stats.skew_max == max(skews, default=None)
                assert stats.skew_sum == pytest.approx(float(sum(skews)), rel=1e-9, abs=1e4)


def stamp_of(payload: bytes) -> int:
    seconds, nanoseconds = np.frombuffer(payload, "<u4", 2, 4).tolist()
    return int(seconds * 10**9 + nanoseconds)
