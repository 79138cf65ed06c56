"""Segments: what is written is what any MCAP reader reads, and what a crash leaves is kept."""

from __future__ import annotations

import io
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader

from hybridlog_storage import segment_writer
from hybridlog_storage.append_file import BLOCK, AppendFile
from hybridlog_storage.chunk import PackedChunk, StoredChunk
from hybridlog_storage.compression import Compressor
from hybridlog_storage.copying import COPIED_AT_ONCE
from hybridlog_storage.errors import DiskFullError, SegmentError, UsageError
from hybridlog_storage.messages import Batch, Buffer, Channel, LooseBatch, Schema
from hybridlog_storage.recovery import recover_segment
from hybridlog_storage.segment_check import SegmentCheck
from hybridlog_storage.segment_file import SegmentFile
from hybridlog_storage.segment_format import (
    END_METADATA,
    ChunkSummary,
    chunk_index_record,
    json_metadata,
    record_bytes,
)
from hybridlog_storage.segment_reader import SegmentReader
from hybridlog_storage.segment_writer import AT_WORK, RecordingWriter, SegmentSettings

RECORDING = {
    "id": "r",
    "key": 7,
    "name": "r",
    "tags": {"a": "b"},
    "source": {},
    "created": 1,
}
SCHEMA = Schema("std_msgs/String", "ros1msg", b"string data")
CHANNELS = [
    Channel("/small", "ros1", SCHEMA, {"callerid": "/n"}, has_publish_time=False),
    Channel("/large", "cdr", Schema("a/msg/B", "ros2msg", b"uint8[] data")),
    Channel("/json", "json", None),
]
Row = tuple[int, bytes, int, int, int]


def batch_of(rows: Sequence[Row]) -> Batch:
    """A batch with junk between the payloads."""
    buffer = bytearray(b"junk")
    offsets = []
    for _, payload, *_ in rows:
        offsets.append(len(buffer))
        buffer += payload + b"??"
    return Batch(
        bytes(buffer),
        np.array(offsets, np.int64),
        np.array([len(r[1]) for r in rows], np.int64),
        np.array([r[0] for r in rows], np.int32),
        np.array([r[2] for r in rows], np.int64),
        np.array([r[3] for r in rows], np.int64),
        np.array([r[4] for r in rows], np.uint32),
    )


def loose(rows: Sequence[Row]) -> LooseBatch:
    """The same, each payload in a buffer of its own, of any kind."""
    kinds = (bytes, bytearray, memoryview)
    channel, payloads, log_time, publish_time, sequence = zip(*rows, strict=True)
    return LooseBatch(
        np.fromiter((kinds[n % 3](p) for n, p in enumerate(payloads)), np.object_, len(rows)),
        np.array([len(payload) for payload in payloads], np.int64),
        np.array(channel, np.int32),
        np.array(log_time, np.int64),
        np.array(publish_time, np.int64),
        np.array(sequence, np.uint32),
    )


def write(
    directory: Path, batches: Sequence[Sequence[Row]], setup: SegmentSettings | None = None
) -> tuple[list[Path], list[StoredChunk]]:
    directory.mkdir(exist_ok=True)
    chunks: list[StoredChunk] = []
    writer = RecordingWriter(directory, RECORDING, lambda c, _: chunks.append(c), setup)
    for rows in batches:
        writer.append(batch_of(rows), CHANNELS)
    return writer.close(json_metadata(END_METADATA, {"status": "complete"})), chunks


def messages_in(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (channel.topic, m.sequence, m.data)
            for _, channel, m in make_reader(stream, validate_crcs=True).iter_messages()
        ]


def test_a_chunk_is_written_when_its_payloads_are_copied(tmp_path: Path) -> None:
    """By any thread and in any order; the chunks keep theirs."""
    chunks: list[StoredChunk] = []
    setup = SegmentSettings(chunk_size=3 * COPIED_AT_ONCE, compression="none")
    writer = RecordingWriter(
        tmp_path, RECORDING, lambda c, _: chunks.append(c), setup, on_written=lambda: None
    )
    payloads = [bytes([n]) * (COPIED_AT_ONCE + n) for n in range(20)]
    copies = [
        writer.place_one(CHANNELS[n % 2], payload, n, n, n) for n, payload in enumerate(payloads)
    ]
    # All closed chunks but none can be packed, and whoever placed did not wait.
    assert writer.waiting > 16 * COPIED_AT_ONCE
    time.sleep(0.05)
    assert not chunks
    threads = [threading.Thread(target=copy) for copy in reversed(copies)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (path,) = writer.close()
    assert writer.waiting == 0
    assert [chunk.seq.tolist() for chunk in chunks] == [
        [n, n + 2] for start in range(0, 20, 4) for n in (start, start + 1)
    ]
    assert messages_in(path) == [
        (CHANNELS[n % 2].topic, n, payload) for n, payload in enumerate(payloads)
    ]


@settings(max_examples=20, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 1, 40_000, COPIED_AT_ONCE - 1, COPIED_AT_ONCE, 1_500_000]),
            st.sampled_from([bytes, bytearray, memoryview]),
        ),
        max_size=30,
    )
)
def test_payloads_that_are_copied_at_once_and_those_that_are_not_share_chunks(
    tmp_path_factory: pytest.TempPathFactory,
    messages: list[tuple[int, Callable[[bytes], Buffer]]],
) -> None:
    tmp_path = tmp_path_factory.mktemp("segments")
    writer = RecordingWriter(tmp_path, RECORDING, lambda *_: None, on_written=lambda: None)
    payloads = [bytes([n + 1]) * size for n, (size, _) in enumerate(messages)]
    copies = []
    for n, payload in enumerate(payloads):
        buffer = messages[n][1](payload)
        copies.append(writer.place_one(CHANNELS[0], buffer, n, n, n))
        if len(payload) < COPIED_AT_ONCE and isinstance(buffer, bytearray):
            buffer[:] = bytes(len(buffer))  # it was copied, so this changes nothing
    for copy in reversed(copies):
        copy()
    (path,) = writer.close()
    assert messages_in(path) == [
        (CHANNELS[0].topic, n, payload) for n, payload in enumerate(payloads)
    ]


@settings(max_examples=20, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([1 << 20, 2 << 20, 8 << 20]),
            st.lists(st.sampled_from([0, 10, 30_000, 700_000, 1_200_000, 3_000_000]), max_size=9),
            st.sampled_from(["a batch", "loose", "one by one"]),
        ),
        max_size=5,
    )
)
def test_the_chunk_size_may_change_while_messages_come(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[int, list[int], str]]
) -> None:
    """No chunk exceeds the bound of when it was opened; nothing is lost or out of order."""
    chunks: list[StoredChunk] = []
    writer = RecordingWriter(
        tmp_path_factory.mktemp("segments"),
        RECORDING,
        lambda c, _: chunks.append(c),
        SegmentSettings(compression="none"),
        next_chunk_size=lambda: chunk_size,
        on_written=lambda: None,
    )
    payloads: list[bytes] = []
    opened_with: list[int] = []  # the bound when each message came
    for chunk_size, sizes, way in steps:
        first = len(payloads)
        payloads += [bytes([first + n + 1]) * size for n, size in enumerate(sizes)]
        opened_with += [chunk_size] * len(sizes)
        rows = [(0, payloads[n], n, n, n) for n in range(first, len(payloads))]
        if way == "a batch":
            writer.append(batch_of(rows), CHANNELS)
        elif way == "loose" and rows:
            writer.append(loose(rows), CHANNELS)
        else:
            copies = [
                writer.place_one(CHANNELS[0], payloads[n], n, n, n)
                for n in range(first, len(payloads))
            ]
            for copy in reversed(copies):
                copy()
    (path,) = writer.close()
    assert messages_in(path) == [
        (CHANNELS[0].topic, n, payload) for n, payload in enumerate(payloads)
    ]
    for number, chunk in enumerate(chunks):
        bound = opened_with[int(chunk.seq[0])]
        size = len(chunk.batch.buffer)
        assert size <= bound or len(chunk.batch) == 1
        # It was closed because the next message would not have found room; where chunks had
        # just become larger, in half of it.
        if number + 1 < len(chunks) and size < bound:
            assert size + 31 + len(payloads[int(chunks[number + 1].seq[0])]) > bound // 2


def test_topics_do_not_close_large_chunks_at_one_time(tmp_path: Path) -> None:
    """Their first ones after the change are of many sizes, those behind them are not."""
    chunks: list[StoredChunk] = []
    chunk_size = 100_000
    writer = RecordingWriter(
        tmp_path,
        RECORDING,
        lambda c, _: chunks.append(c),
        SegmentSettings(compression="none"),
        next_chunk_size=lambda: chunk_size,
        on_written=lambda: None,
    )
    topics = [Channel(f"/topic{n}", "ros1", None) for n in range(20)]

    def speak(times: int) -> None:
        for n in range(times):
            for topic in topics:
                writer.place_one(topic, bytes(5000), n, n, n)

    speak(30)
    chunk_size = 400_000
    speak(250)
    writer.close()
    of_topic: dict[int, list[int]] = {}
    for chunk in chunks:
        of_topic.setdefault(int(chunk.batch.channel[0]), []).append(len(chunk.batch))
    small, full = 100_000 // 5031, 400_000 // 5031
    begun = [sizes[2] for sizes in of_topic.values()]
    assert all(sizes[:2] == [small] * 2 for sizes in of_topic.values())
    assert all(set(sizes[3:-1]) == {full} for sizes in of_topic.values())
    assert all(full // 2 <= size <= full for size in begun)
    assert len(set(begun)) > 12


@pytest.mark.parametrize(("spare", "hurried"), [(1, False), (1, True), (2, False)])
def test_no_more_threads_pack_than_may_but_in_a_hurry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spare: int, hurried: bool
) -> None:
    is_alone = spare == 1 and not hurried
    side_by_side = threading.Barrier(2)
    met = []

    def compress(_: object, data: Buffer, *, hurried: bool) -> tuple[str, Buffer]:
        try:
            side_by_side.wait(0.1 if is_alone else 30)
        except threading.BrokenBarrierError:
            side_by_side.reset()
        else:
            met.append(hurried)
        return "", bytes(data)

    monkeypatch.setattr(Compressor, "compress", compress)
    monkeypatch.setattr(segment_writer, "_TURN_S", 30)
    writer = RecordingWriter(
        tmp_path,
        RECORDING,
        lambda *_: None,
        SegmentSettings(chunk_size=1 << 10),
        hurry=lambda: hurried,
        spare=threading.BoundedSemaphore(spare),
        on_written=lambda: None,
    )
    payloads = [bytes([n]) * 1024 for n in range(4)]
    for n, payload in enumerate(payloads):
        writer.place_one(CHANNELS[0], payload, n, n, n)()
    (path,) = writer.close()
    assert [data for _, _, data in messages_in(path)] == payloads
    assert met == ([] if is_alone else [hurried] * 4)


def test_packing_does_not_wait_for_who_keeps_all_processors(tmp_path: Path) -> None:
    spare = threading.BoundedSemaphore(1)
    with spare:  # as the index does, of which nobody knows how long it takes
        writer = RecordingWriter(
            tmp_path,
            RECORDING,
            lambda *_: None,
            SegmentSettings(chunk_size=1 << 10),
            spare=spare,
            on_written=lambda: None,
        )
        for n in range(4):
            writer.place_one(CHANNELS[0], bytes([n]) * 1024, n, n, n)()
        (path,) = writer.close()
    assert [data[0] for _, _, data in messages_in(path)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="released too many"):
        spare.release()  # it was given back as often as it was taken


def test_what_says_little_holds_little_memory_however_large_chunks_are(tmp_path: Path) -> None:
    """From its second chunk on, and until one is larger than those before."""
    chunk_size = 2 << 20
    writer = RecordingWriter(
        tmp_path,
        RECORDING,
        lambda *_: None,
        next_chunk_size=lambda: chunk_size,
        on_written=lambda: None,
    )
    payloads = []

    def place(*sizes: int) -> int:
        for size in sizes:
            payloads.append(bytes([len(payloads) % 251]) * size)
            n = len(payloads)
            writer.place_one(CHANNELS[0], payloads[-1], n, n, n)()
        (builder,) = writer._clusters.values()
        return len(builder._buffer)

    assert place(5000) == 2 << 20
    writer.flush()
    chunk_size = 8 << 20
    assert place(5000) < 100_000
    assert place(*[5000] * 100) < 2_000_000
    # What is copied outside of the lock needs a place that stays.
    assert place(COPIED_AT_ONCE) == 8 << 20
    writer.flush()
    assert place(5000) == 8 << 20
    (path,) = writer.close()
    assert [data for _, _, data in messages_in(path)] == payloads


@pytest.mark.parametrize("noise", [0.3, 0.1])
def test_chunks_that_wait_are_stored_as_they_are_once_there_is_a_hurry(
    tmp_path: Path, noise: float
) -> None:
    """Also those that were closed before: topics of one rate close theirs at one time.

    Not so what shrinks to a fifth, which is written sooner for it.
    """
    chunks: list[StoredChunk] = []
    hurried = False
    writer = RecordingWriter(
        tmp_path,
        RECORDING,
        lambda c, _: chunks.append(c),
        SegmentSettings(chunk_size=COPIED_AT_ONCE),
        hurry=lambda: hurried,
        on_written=lambda: None,
    )
    pieces = range(COPIED_AT_ONCE >> 10)
    payloads = [
        b"".join(os.urandom(int(noise * 1024)).ljust(1024, bytes([n])) for _ in pieces)
        for n in range(8)
    ]
    copies = [writer.place_one(CHANNELS[0], p, n, n, n) for n, p in enumerate(payloads)]
    for n, copy in enumerate(copies):
        if n == 4:
            while len(chunks) < 4:
                time.sleep(0.001)
            hurried = True
        copy()
    (path,) = writer.close()
    shrunk = [chunk.compressed_size < len(payloads[0]) / 2 for chunk in chunks]
    assert shrunk == [True] * 4 + [noise < 0.2] * 4
    assert [data for _, _, data in messages_in(path)] == payloads


def test_a_segment_has_no_more_chunks_than_a_summary_should(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However well they shrink."""
    monkeypatch.setattr(segment_writer, "_MOST_CHUNKS", 10)
    writer = RecordingWriter(tmp_path, RECORDING, lambda *_: None, SegmentSettings(chunk_size=2000))
    payloads = [bytes([n]) * 1500 for n in range(200)]
    for n, payload in enumerate(payloads):
        writer.append(batch_of([(0, payload, n, n, n)]), CHANNELS)
    paths = writer.close()
    assert [data for path in paths for _, _, data in messages_in(path)] == payloads
    chunks = []
    for path in paths:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        chunks.append(len(summary.chunk_indexes))
    # Those that wait together are written together, eight of them at most.
    assert sum(chunks) == 200
    assert all(10 <= count < 10 + AT_WORK for count in chunks[:-1])


def test_chunks_that_wait_are_written_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    together: list[int] = []
    append_chunks = SegmentFile.append_chunks

    def wait(segment: SegmentFile, chunks: Sequence[PackedChunk], end: int) -> list[StoredChunk]:
        assert go_on.wait(60)
        stored = append_chunks(segment, chunks, end)
        together.append(len(stored))
        return stored

    monkeypatch.setattr(SegmentFile, "append_chunks", wait)
    setup = SegmentSettings(chunk_size=100_000, compression="none", segment_size=1_000_000)
    chunks: list[StoredChunk] = []
    writer = RecordingWriter(
        tmp_path, RECORDING, lambda c, _: chunks.append(c), setup, on_written=lambda: None
    )
    payloads = [bytes([n]) * 100_000 for n in range(35)]
    for n, payload in enumerate(payloads):
        writer.place_one(CHANNELS[0], payload, n, n, n)
    writer.place_one(CHANNELS[1], b"last", 99, 99, 99)
    while not all(future.done() for future in writer._packed):
        time.sleep(0.01)
    go_on.set()
    paths = writer.close()
    # Alone only those that were there first; and segments end as if each had come by itself.
    assert sum(together) == 36
    assert len(together) <= 6
    assert max(together) in {9, 10}
    assert [chunk.segment for chunk in chunks] == [n // 10 for n in range(36)]
    found = [m for path in paths for m in messages_in(path)]
    assert found == [
        *((CHANNELS[0].topic, n, payload) for n, payload in enumerate(payloads)),
        (CHANNELS[1].topic, 99, b"last"),
    ]
    for chunk in chunks:
        data = paths[chunk.segment].read_bytes()
        assert data[chunk.offset] == Opcode.CHUNK
        assert int.from_bytes(data[chunk.offset + 1 : chunk.offset + 9], "little") == (
            chunk.length - 9
        )


def test_no_chunk_follows_one_that_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failing = threading.Event()

    def full(*_: object) -> None:
        failing.wait()
        raise DiskFullError("There is no room.")

    monkeypatch.setattr(SegmentFile, "append_chunks", full)
    writer = RecordingWriter(
        tmp_path,
        RECORDING,
        lambda *_: None,
        SegmentSettings(chunk_size=100_000),
        on_written=lambda: None,
    )
    for _ in range(50):
        writer.place_one(CHANNELS[0], bytes(100_000), 0, 0, 0)
    failing.set()
    with pytest.raises(DiskFullError) as caught:
        writer.flush()
    # It is told of once, not once a chunk that waited, and again to who goes on.
    assert len(caught.traceback) < 20
    with pytest.raises(DiskFullError):
        writer.place_one(CHANNELS[0], bytes(100_000), 0, 0, 0)
    # Nobody waits for a payload that nobody copies any more.
    writer.abort()
    assert writer.written.total() == 0


@given(
    numbers=st.lists(st.integers(0, 2**62), min_size=6, max_size=6),
    indexes=st.dictionaries(st.integers(1, 65535), st.integers(0, 2**32), max_size=40),
    compression=st.sampled_from(["", "lz4", "zstd"]),
)
def test_the_record_of_a_chunk_index_is_that_of_the_mcap_package(
    numbers: list[int], indexes: dict[int, int], compression: str
) -> None:
    first, last, offset, length, compressed_size, uncompressed_size = numbers
    chunk = ChunkSummary(
        first=first,
        last=last,
        offset=offset,
        length=length,
        indexes=indexes,
        compression=compression,
        compressed_size=compressed_size,
        uncompressed_size=uncompressed_size,
    )
    found = chunk_index_record(chunk)
    at, places = offset + length, {}
    for channel, size in indexes.items():
        places[channel], at = at, at + size
    assert found == record_bytes(
        ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=compression,
            compressed_size=compressed_size,
            message_end_time=last,
            message_index_length=sum(indexes.values()),
            message_index_offsets=places,
            message_start_time=first,
            uncompressed_size=uncompressed_size,
        )
    )


def expected(batches: Sequence[Sequence[Row]]) -> list[tuple[str, bytes, int, int, int]]:
    return sorted((CHANNELS[c].topic, p, t, pub, s) for rows in batches for c, p, t, pub, s in rows)


rows_of = st.lists(
    st.tuples(
        st.integers(0, 2),
        st.binary(max_size=80) | st.integers(0, 3000).map(bytes),
        st.integers(0, 2**62),
        st.integers(0, 2**62),
        st.integers(0, 2**32 - 1),
    ),
    max_size=30,
)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(batches=st.lists(rows_of, max_size=4), size=st.sampled_from([1024, 4096, 1 << 20]))
def test_official_readers_see_every_message(
    tmp_path_factory: pytest.TempPathFactory, batches: list[list[Row]], size: int
) -> None:
    paths, _ = write(
        tmp_path_factory.mktemp("r"),
        batches,
        SegmentSettings(chunk_size=size, large_payload=64, segment_size=6000),
    )
    seen = []
    counted = 0
    for path in paths:
        data = path.read_bytes()
        reader = make_reader(io.BytesIO(data), validate_crcs=True)
        for _, channel, m in reader.iter_messages():
            seen.append((channel.topic, m.data, m.log_time, m.publish_time, m.sequence))
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        counted += summary.statistics.message_count
        list(StreamReader(io.BytesIO(data), validate_crcs=True).records)
    assert sorted(seen) == expected(batches)
    assert counted == len(seen)


@settings(max_examples=30, deadline=None)
@given(batches=st.lists(rows_of, max_size=4))
def test_reader_gives_the_chunks_that_were_written(
    tmp_path_factory: pytest.TempPathFactory, batches: list[list[Row]]
) -> None:
    paths, chunks = write(
        tmp_path_factory.mktemp("r"), batches, SegmentSettings(chunk_size=2048, large_payload=64)
    )
    (path,) = paths
    with SegmentReader(path, 0) as reader:
        summary = reader.summary()
        assert summary.recording["key"] == 7
        assert summary.end == {"status": "complete"}
        assert [p.offset for p in summary.chunks] == [c.offset for c in chunks]
        for place, chunk in zip(summary.chunks, chunks, strict=True):
            read = reader.read_chunk(place)
            assert (read.length, read.trailer) == (chunk.length, chunk.trailer)
            assert read.seq.tolist() == chunk.seq.tolist()
            assert read.batch.channel.tolist() == chunk.batch.channel.tolist()
            assert read.batch.offset.tolist() == chunk.batch.offset.tolist()
            assert [bytes(read.batch.payload(i)) for i in range(len(read.batch))] == [
                bytes(chunk.batch.payload(i)) for i in range(len(chunk.batch))
            ]
    seqs = sorted(s for c in chunks for s in c.seq.tolist())
    assert seqs == list(range(sum(map(len, batches))))


def many(count: int, channel: int = 0, size: int = 100, step: int = 10**7) -> list[Row]:
    return [(channel, bytes([i % 251]) * size, i * step, i * step, i) for i in range(count)]


def test_large_payloads_do_not_share_chunks(tmp_path: Path) -> None:
    rows = [row for pair in zip(many(200), many(200, 1, 5000), strict=True) for row in pair]
    _, chunks = write(tmp_path, [rows])
    for chunk in chunks:
        assert len(set(chunk.batch.channel.tolist())) == 1
        if int(chunk.batch.length[0]) == 5000:
            span = int(chunk.batch.log_time.max() - chunk.batch.log_time.min())
            assert span < SegmentSettings().chunk_span_ns


@pytest.mark.parametrize("at_once", [1, 7, 100])
def test_a_chunk_that_holds_little_spans_more(tmp_path: Path, at_once: int) -> None:
    setup = SegmentSettings()
    loads = {
        "sparse": (2000, 8, 8),
        "usual": (20_000, 16, 4),
        "rare": (5000, 1, 1),
        "few": (40_000, 4, 4),
        "fewer": (160_000, 4, 2),
        "large": (320_000, 4, 1),
    }
    for place, (size, hz, want) in loads.items():
        step = 10**9 // hz
        rows = many(100, size=size, step=step)
        batches = [rows[at : at + at_once] for at in range(0, len(rows), at_once)]
        _, chunks = write(tmp_path / place, batches)
        counts = [len(chunk.batch) for chunk in chunks]
        assert sum(counts) == 100
        for chunk in chunks:
            span = int(chunk.batch.log_time.max() - chunk.batch.log_time.min())
            assert span < 4 * setup.chunk_span_ns
            before = len(chunk.batch) - 1  # messages, when the last one was laid down
            little = setup.span_size * (8 if before < 4 else 1)
            assert span < setup.chunk_span_ns or before * (size + 31) < little
        assert set(counts[:-1]) == {want}, place


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.5, 0.8, 0.95, 0.999, 1.0])
def test_a_cut_segment_is_recovered(tmp_path: Path, keep: float) -> None:
    setup = SegmentSettings(chunk_size=4096)
    (path,), chunks = write(tmp_path / "a", [many(500)], setup)
    data = path.read_bytes()
    last = chunks[-1].offset + chunks[-1].length + chunks[-1].trailer
    cut = int(last * keep)
    opened = tmp_path / "000000.mcap.open"
    opened.write_bytes(data[:cut])
    whole = [c for c in chunks if c.offset + c.length <= cut]
    recovered = recover_segment(opened)
    assert not opened.exists()
    if recovered.path is None:
        assert not whole
        return
    with SegmentReader(recovered.path, 0) as reader:
        summary = reader.summary()
        seqs = [s for p in summary.chunks for s in reader.read_chunk(p).seq.tolist()]
    assert seqs == [s for c in whole for s in c.seq.tolist()]
    assert recovered.messages == len(seqs)
    official = make_reader(io.BytesIO(recovered.path.read_bytes()), validate_crcs=True)
    assert len(list(official.iter_messages())) == len(seqs)


def test_every_cut_of_a_small_segment_recovers(tmp_path: Path) -> None:
    (path,), chunks = write(tmp_path / "a", [many(30)], SegmentSettings(chunk_size=1024))
    data = path.read_bytes()
    end = chunks[-1].offset + chunks[-1].length + chunks[-1].trailer
    for cut in range(0, end, 7):
        opened = tmp_path / "000000.mcap.open"
        opened.write_bytes(data[:cut])
        recovered = recover_segment(opened)
        whole = sum(len(c.batch) for c in chunks if c.offset + c.length <= cut)
        assert recovered.messages == whole, cut
        (tmp_path / "000000.mcap").unlink(missing_ok=True)


@pytest.mark.parametrize("missing", [0, 1, 8, 37, 60, 200])
def test_a_segment_cut_in_its_summary_is_what_it_was(tmp_path: Path, missing: int) -> None:
    """Killed while it was sealed: all is there, and what follows the data is made anew."""
    (path,), _ = write(tmp_path / "a", [many(30)], SegmentSettings(chunk_size=1024))
    whole = path.read_bytes()
    opened = tmp_path / "000000.mcap.open"
    opened.write_bytes(whole[: len(whole) - missing])
    recovered = recover_segment(opened)
    assert recovered.path is not None
    assert recovered.path.read_bytes() == whole
    with SegmentReader(recovered.path, 0) as reader:
        assert reader.summary().end == {"status": "complete"}
    with SegmentCheck(recovered.path) as check:
        assert list(check.between_chunks()) == []


def test_a_flipped_bit_is_found_and_named(tmp_path: Path) -> None:
    (path,), chunks = write(tmp_path, [many(500)], SegmentSettings(chunk_size=4096))
    data = bytearray(path.read_bytes())
    data[chunks[2].offset + chunks[2].length - 5] ^= 0x10
    path.write_bytes(data)
    with SegmentReader(path, 0) as reader:
        places = reader.summary().chunks
        reader.read_chunk(places[1])
        with pytest.raises(SegmentError, match=f"byte {chunks[2].offset} of .*damaged"):
            reader.read_chunk(places[2])


def test_a_full_disk_is_said_to_be_full() -> None:
    from hybridlog_storage.durability import explain, write_all

    with Path("/dev/full").open("wb", buffering=0) as file, pytest.raises(OSError) as caught:
        write_all(file.fileno(), [b"x"])
    assert explain(caught.value, Path("f"), "writing").exit_code == 7


def test_zero_messages_make_a_valid_segment(tmp_path: Path) -> None:
    (path,), _ = write(tmp_path, [])
    assert (
        list(make_reader(io.BytesIO(path.read_bytes()), validate_crcs=True).iter_messages()) == []
    )
    shutil.rmtree(tmp_path)


def test_what_lies_in_the_place_of_a_segment(tmp_path: Path) -> None:
    for number, make in enumerate((os.mkfifo, os.mkdir)):
        path = tmp_path / f"{number:06d}.mcap"
        make(path)
        with pytest.raises(SegmentError, match="no ordinary file"):
            SegmentReader(path, number)


def test_large_content_that_is_not_compressed_starts_at_a_block(tmp_path: Path) -> None:
    batches = [[(1, os.urandom(300_000), 10 * n, 10 * n, n)] for n in range(5)]
    (path,), chunks = write(tmp_path, batches, SegmentSettings(chunk_size=1 << 19))
    data = path.read_bytes()
    found = [
        (message.data, message.log_time)
        for _, _, message in make_reader(io.BytesIO(data), validate_crcs=True).iter_messages()
    ]
    assert found == [(payload, time) for rows in batches for _, payload, time, _, _ in rows]
    heads = [chunk.length - chunk.compressed_size for chunk in chunks]
    places = [chunk.offset + head for chunk, head in zip(chunks, heads, strict=True)]
    if AppendFile.create(tmp_path / "probe").direct:
        assert [place % BLOCK for place in places] == [0] * 5
    with SegmentCheck(path) as check:
        assert list(check.between_chunks()) == []
    paddings = [
        found.start()
        for found in re.finditer(b"\x91", data)
        if found.start() + 9 + int.from_bytes(data[found.start() + 1 :][:8], "little")
        in {chunk.offset for chunk in chunks}
    ]
    for at in paddings:
        for place in (at, at + 1, at + 9, at + 20):
            damaged = bytearray(data)
            damaged[place] ^= 4
            path.write_bytes(damaged)
            with SegmentCheck(path) as check:
                assert list(check.between_chunks()), place


def test_a_segment_that_was_left_open_is_recovered_with_its_padding(tmp_path: Path) -> None:
    batches = [[(1, os.urandom(300_000), 10 * n, 10 * n, n)] for n in range(4)]
    (path,), chunks = write(tmp_path, batches, SegmentSettings(chunk_size=1 << 19))
    opened = path.with_name(path.name + ".open")
    whole = path.read_bytes()
    last = chunks[-1]
    path.unlink()
    # Killed while the last chunk was being written, in its padding, or in its middle.
    for cut in (last.offset - 5, last.offset + 2, last.offset + last.length // 2):
        opened.write_bytes(whole[:cut])
        recovered = recover_segment(opened)
        assert recovered.path is not None
        with recovered.path.open("rb") as file:
            found = [message.data for _, _, message in make_reader(file).iter_messages()]
        assert found == [rows[0][1] for rows in batches[:-1]]
        with SegmentCheck(recovered.path) as check:
            assert list(check.between_chunks()) == []
        recovered.path.unlink()


def test_a_crash_between_a_schema_and_its_channel(tmp_path: Path) -> None:
    (path,), chunks = write(tmp_path, [many(50)], SegmentSettings(chunk_size=1 << 20))
    whole = path.read_bytes()
    schema = whole.index(SCHEMA.data)  # its definition is the end of its record
    path.unlink()
    opened = path.with_name(path.name + ".open")
    opened.write_bytes(whole[: schema + len(SCHEMA.data)])
    recovered = recover_segment(opened)
    assert chunks
    if recovered.path is not None:
        with SegmentCheck(recovered.path) as check:
            assert list(check.between_chunks()) == []


@pytest.mark.parametrize("span", [0, -1, 1 << 62])
def test_a_chunk_lasts_longer_than_no_time(span: int) -> None:
    with pytest.raises(UsageError, match="a chunk must last"):
        SegmentSettings(chunk_span_ns=span)
