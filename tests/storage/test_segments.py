"""Segments: what is written is what any MCAP reader reads, and what a crash leaves is kept."""

from __future__ import annotations

import io
import os
import random
import struct
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blake3 import blake3
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Metadata
from mcap.stream_reader import StreamReader

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk.append_file import BLOCK
from hybridlog_storage.errors import DiskFullError, SegmentError, StoreError, UsageError
from hybridlog_storage.manifest import Loss, replace
from hybridlog_storage.messages import Batch, Channel, LooseBatch, Schema
from hybridlog_storage.segments.chunk import StoredChunk
from hybridlog_storage.segments.chunk_table import ChunkPlace
from hybridlog_storage.segments.segment_file import Sealed, SegmentFile
from hybridlog_storage.segments.segment_format import (
    RECORDING_METADATA,
    Attachment,
    FilePart,
    losses_record,
)
from hybridlog_storage.segments.segment_reader import SegmentReader, SegmentSummary
from hybridlog_storage.segments.segment_writer import AT_WORK, RecordingWriter, SegmentSettings
from hybridlog_storage.segments.walk import Recovered, damage_of, recover_segment
from tests.calls import Calls
from tests.limits import Limit
from tests.some import each
from tests.storage.noting import NotingWriter
from tests.storage.steps import Steps, through

RECORDING = {
    "id": "20261128-run-0123456789abcdef",
    "name": "r",
    "tags": {"a": "b"},
    "source": {},
    "created": 1,
}
LOSS = Loss("queue", "/small", 3, 5, 6)
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


def done() -> None:
    """Nobody waits for what is written."""


def recorder(
    directory: Path,
    chunks: list[StoredChunk] | None = None,
    setup: SegmentSettings | None = None,
    **options: Any,
) -> RecordingWriter:
    """A writer that puts its chunks into a list, and all of them into first segments."""
    noted = [] if chunks is None else chunks
    options.setdefault("is_latched", lambda _: True)
    return NotingWriter(directory, RECORDING, noted, setup, **options)


def problems(path: Path, digest: str = "") -> list[tuple[int, str]]:
    return damage_of(path, digest)[0]


def summary_of(path: Path, number: int) -> SegmentSummary:
    with SegmentReader(path, number) as reader:
        return reader.summary()


def recovered_of(directory: Path, data: bytes | bytearray, **options: Any) -> Recovered:
    """What becomes of a segment that was left open with some bytes."""
    opened = directory / "000000.mcap.open"
    opened.write_bytes(data)
    return recover_segment(opened, **options)


def write(
    directory: Path, batches: Sequence[Sequence[Row]], setup: SegmentSettings | None = None
) -> tuple[list[Path], list[StoredChunk]]:
    directory.mkdir(exist_ok=True)
    chunks: list[StoredChunk] = []
    writer = recorder(directory, chunks, setup)
    for rows in batches:
        writer.append(batch_of(rows), CHANNELS)
    return writer.close(), chunks


def messages_in(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (channel.topic, m.sequence, m.data)
            for _, channel, m in make_reader(stream, validate_crcs=True).iter_messages()
        ]


@settings(max_examples=10)
@given(
    st.sampled_from([1 << 20, 2 << 20, 8 << 20]),
    st.lists(
        st.tuples(
            st.lists(
                st.sampled_from([0, 10, 30_000, 1_000_000, 3_000_000]),
                max_size=9,
            ),
            st.sampled_from(["a batch", "loose"]),
        ),
        max_size=5,
    ),
)
def test_chunks_are_as_large_as_their_bound_however_messages_come(
    tmp_path_factory: pytest.TempPathFactory, bound: int, steps: list[tuple[list[int], str]]
) -> None:
    """No chunk of several messages exceeds it; nothing is lost or out of order."""
    chunks: list[StoredChunk] = []
    writer = recorder(
        tmp_path_factory.mktemp("segments"),
        chunks,
        SegmentSettings(chunk_size=bound, compression="none"),
        on_written=done,
    )
    payloads: list[bytes] = []
    for sizes, way in steps:
        first = len(payloads)
        payloads += [bytes([first + n + 1]) * size for n, size in enumerate(sizes)]
        rows = [(0, payloads[n], n, n, n) for n in range(first, len(payloads))]
        if way == "a batch":
            writer.append(batch_of(rows), CHANNELS)
        elif rows:
            writer.append(loose(rows), CHANNELS)
    (path,) = writer.close()
    assert messages_in(path) == [
        (CHANNELS[0].topic, n, payload) for n, payload in enumerate(payloads)
    ]
    for number, chunk in enumerate(chunks):
        size = len(chunk.batch.buffer)
        assert size <= bound or len(chunk.batch) == 1
        # It was closed because the next message would not have found room.
        if number + 1 < len(chunks) and size < bound:
            assert size + 31 + len(payloads[int(chunks[number + 1].seq[0])]) > bound


def test_a_segment_has_no_more_chunks_than_a_summary_should(tmp_path: Path, limit: Limit) -> None:
    """However well they shrink."""
    (tmp_path / "parts").mkdir()
    limit(segment_chunks=10)
    writer = recorder(tmp_path, setup=SegmentSettings(chunk_size=2000))
    payloads = [bytes([n]) * 1500 for n in range(200)]
    for n, payload in enumerate(payloads):
        writer.append(batch_of([(0, payload, n, n, n)]), CHANNELS)
    paths = writer.close()
    assert [data for path in paths for _, _, data in messages_in(path)] == payloads
    chunks = [len(summary_of(path, number).chunks) for number, path in enumerate(paths)]
    assert sum(chunks) == 200
    assert all(10 <= count < 10 + AT_WORK for count in chunks[:-1])
    # Nor more channels of chunks, however many topics share one.
    limit(segment_parts=20)
    topics = [Channel(f"/{n}", "json", None) for n in range(10)]
    writer = recorder(tmp_path / "parts")
    for n in range(6):
        writer.append(batch_of([(channel, b"x", n, n, n) for channel in range(10)]), topics)
        writer.flush()
    parts = [len(summary_of(path, n).table.parts) for n, path in enumerate(writer.close())]
    assert parts == [20, 20, 20, 0]


def test_no_chunk_follows_one_that_failed(tmp_path: Path, calls: Calls) -> None:
    failing = threading.Event()

    def full(*_: object) -> None:
        failing.wait()
        raise DiskFullError("There is no room.")

    calls(SegmentFile, "append_chunk", full)
    writer = recorder(tmp_path, setup=SegmentSettings(chunk_size=100_000), on_written=done)
    for _ in range(50):
        writer.append(loose([(0, bytes(100_000), 0, 0, 0)]), CHANNELS)
    failing.set()
    with pytest.raises(DiskFullError) as caught:
        writer.flush()
    # It is told of once, not once a chunk that waited, and again to who goes on.
    assert len(caught.traceback) < 20
    with pytest.raises(DiskFullError):
        writer.append(loose([(0, bytes(100_000), 0, 0, 0)]), CHANNELS)
    writer.abort()
    assert writer.written.total() == 0


def many(count: int, channel: int = 0, size: int = 100, step: int = 10**7) -> list[Row]:
    return [(channel, bytes([i % 251]) * size, i * step, i * step, i) for i in range(count)]


def test_a_chunk_that_holds_little_spans_more(tmp_path: Path) -> None:
    setup = SegmentSettings()
    loads = {
        "sparse": (3000, 4, 256),
        "usual": (20_000, 16, 53),
        "rare": (5000, 1, 64),
        "large": (600_000, 4, 2),
    }
    for place, (size, hz, want) in loads.items():
        step = 10**9 // hz
        total = 2 * want + 10
        rows = many(total, size=size, step=step)
        batches = [rows[at : at + 7] for at in range(0, len(rows), 7)]
        _, chunks = write(tmp_path / place, batches)
        counts = [len(chunk.batch) for chunk in chunks]
        assert sum(counts) == total
        for chunk in chunks:
            span = int(chunk.batch.log_time.max() - chunk.batch.log_time.min())
            assert span < 256 * setup.chunk_span_ns
            before = len(chunk.batch) - 1  # messages, when the last one was laid down
            assert span < setup.chunk_span_ns or before * (size + 31) < setup.span_size
        assert set(counts[:-1]) == {want}, place


def test_every_cut_of_a_small_segment_recovers(tmp_path: Path) -> None:
    (path,), chunks = write(tmp_path / "a", [many(30)], SegmentSettings(chunk_size=1024))
    data = path.read_bytes()
    end = chunks[-1].place.end
    for cut in range(0, end, 29):
        recovered = recovered_of(tmp_path, data[:cut])
        whole = [seq for c in chunks if c.place.end <= cut for seq in c.seq.tolist()]
        assert recovered.messages == len(whole), cut
        assert not (tmp_path / "000000.mcap.open").exists()
        if recovered.path is None:
            assert whole == []
            continue
        with SegmentReader(recovered.path, 0) as reader:
            places = reader.summary().chunks
            assert [seq for p in places for seq in reader.read_chunk(p).seq.tolist()] == whole
        official = make_reader(io.BytesIO(recovered.path.read_bytes()), validate_crcs=True)
        assert len(list(official.iter_messages())) == len(whole)
        recovered.path.unlink()


@pytest.mark.parametrize("span", [0, -1, 1 << 62])
def test_a_chunk_lasts_longer_than_no_time(span: int) -> None:
    with pytest.raises(UsageError, match="a chunk lasts longer than no time"):
        SegmentSettings(chunk_span_ns=span)


# What is on the disk, and when


def test_a_recovered_segment_is_on_the_disk_before_it_gets_its_name(tmp_path: Path) -> None:
    whole, _ = sample(tmp_path / "a")
    for keep in (len(whole), len(whole) - 5, len(whole) // 2):
        opened = tmp_path / "000000.mcap.open"
        opened.write_bytes(whole[:keep])
        steps = Steps()
        log = steps.log
        with through(steps):
            recovered = recover_segment(
                opened, lambda sealed, _, log=log: log.append(("list", sealed.file.name))
            )
        assert recovered.path == tmp_path / "000000.mcap"
        assert steps.log[-4:] == [
            ("sync", "000000.mcap.open"),
            ("list", "000000.mcap"),
            ("rename", "000000.mcap"),
            ("sync", tmp_path.name),
        ]
        recovered.path.unlink()


def test_a_segment_whose_head_found_no_room_can_be_made_again(tmp_path: Path) -> None:
    steps = Steps(fail_from=0, only=frozenset({"write"}))
    with through(steps), pytest.raises(DiskFullError):
        SegmentFile.create(tmp_path, 0, RECORDING)
    assert not list(tmp_path.iterdir())
    segment = SegmentFile.create(tmp_path, 0, RECORDING)
    assert segment.prepare(sync=False).file.name == segment.publish().name == "000000.mcap"


# What proves a segment


def sample(directory: Path, **options: Any) -> tuple[bytes, list[StoredChunk]]:
    """A small segment with everything in it: two shared chunks, one of its own, extras."""
    directory.mkdir()
    chunks: list[StoredChunk] = []
    writer = recorder(directory, chunks, SegmentSettings(chunk_size=1024), **options)
    rows = [(2 * (n % 2), bytes([n]) * (20 + n), 50 * n % 400, 50 * n, n) for n in range(20)]
    writer.append(batch_of(rows[:12]), CHANNELS)
    content = FilePart(lambda at, size: b"attached"[at : at + size], 0, 8)
    writer.add_extra(Attachment(2, 1, "a.txt", "text/plain", content))
    writer.append(batch_of([(1, bytes(1500), 77, 78, 1)]), CHANNELS)
    writer.add_extra(Metadata("source", {"k": "v"}))
    writer.append(batch_of(rows[12:]), CHANNELS)
    writer.flush()
    writer.add_extra(losses_record([LOSS]))
    (path,) = writer.close()
    return path.read_bytes(), chunks


def answers(reader: SegmentReader, places: Sequence[ChunkPlace] | None = None) -> Iterator[object]:
    """All that a segment answers, or None where it says that it cannot."""
    try:
        found = reader.summary()
    except SegmentError:
        found = None
        yield None
    else:
        about = (found.recording, found.channels.keys(), found.table.counts(), found.losses)
        topics = [(c.topic, c.schema, dict(c.metadata)) for c in found.channels.values()]
        yield (about, topics, found.size, found.chunks)
    for place in places or (found.chunks if found else []):
        try:
            yield content_of(reader.read_chunk(place))
        except SegmentError:
            yield None
        try:
            yield {c: times.tolist() for c, times in reader.read_times(place).items()}
        except SegmentError:
            yield None


def content_of(chunk: StoredChunk) -> tuple[Any, ...]:
    batch = chunk.batch
    columns = (batch.channel, batch.log_time, batch.publish_time, batch.sequence, chunk.seq)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    payloads = [bytes(batch.payload(row)) for row in range(len(batch))]
    sizes = chunk.place.length, chunk.place.trailer
    return chunk.number, list(rows), payloads, sizes


@pytest.mark.parametrize(
    "turn", [0, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in range(1, 64))]
)
def test_no_flipped_bit_changes_an_answer_and_each_is_found(tmp_path: Path, turn: int) -> None:
    """In any byte of a segment: heads, lengths, metadata, indexes, summary, footer, magic."""
    whole, _ = sample(tmp_path / "a")
    path = tmp_path / "000000.mcap"
    path.write_bytes(whole)
    with SegmentReader(path, 0) as reader:
        summary = reader.summary()
        right = list(answers(reader, summary.chunks))
    assert None not in right
    assert len(right) == 1 + 2 * len(summary.chunks)
    for at in range(turn % 8, len(whole), 8):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << (at // 8 + turn // 8) % 8
        path.write_bytes(damaged)
        with SegmentReader(path, 0) as reader:
            found = list(answers(reader, summary.chunks))
        assert all(f in (None, r) for f, r in zip(found, right, strict=True)), at
        found_wrong = problems(path, blake3(whole).hexdigest())
        assert found_wrong, at
        if found[0] is None:
            assert "summary" in found_wrong[0][1] or "hybridlog." in found_wrong[0][1], at
        else:
            # It names what is lost, if anything is.
            ((start, text),) = found_wrong
            assert start <= at
            assert (start == 0) == ("digest" in text), at
            assert start or None not in found, at


def test_a_table_that_does_not_end_before_the_summary_is_refused(tmp_path: Path) -> None:
    chunks: list[StoredChunk] = []
    writer = recorder(tmp_path, chunks, SegmentSettings(chunk_size=1024))
    writer.append(batch_of(many(50)), CHANNELS)
    (path,) = writer.close()  # nothing follows the last chunk
    whole = path.read_bytes()
    start, offsets = struct.unpack_from("<QQ", whole, len(whole) - 28)
    gone = start - chunks[-1].place.offset
    tail = bytearray(whole[start:-8])
    struct.pack_into("<QQ", tail, len(tail) - 20, start - gone, offsets - gone)
    struct.pack_into("<I", tail, len(tail) - 4, crc32(tail[:-4]))
    path.write_bytes(whole[: start - gone] + tail + whole[-8:])
    with SegmentReader(path, 0) as reader, pytest.raises(SegmentError, match="another file"):
        reader.summary()


@pytest.mark.parametrize("version", [5, "x", 3])
def test_a_segment_of_another_format_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: object
) -> None:
    message = f"format {version}, and this hybridlog knows format 4"
    monkeypatch.setattr("hybridlog_storage.segments.segment_file.FORMAT_VERSION", version)
    (path,), _ = write(tmp_path / "a", [many(30)])
    with SegmentReader(path, 0) as reader, pytest.raises(SegmentError, match=message):
        reader.summary()
    whole = path.read_bytes()
    opened = tmp_path / "000000.mcap.open"
    opened.write_bytes(whole)
    with pytest.raises(SegmentError, match=message):
        recover_segment(opened)
    assert opened.read_bytes() == whole


# What a crash leaves


@pytest.mark.parametrize(
    ("missing", "zeros"),
    [(0, 0), (0, 1), (0, BLOCK - 1), (1, 0), (8, 0), (37, 0), (60, 0), (200, 0)],
)
def test_a_segment_with_all_its_data_is_what_it_was(
    tmp_path: Path, missing: int, zeros: int
) -> None:
    """Killed while it was sealed, or before its rename: what was told of it still holds."""
    told: list[Sealed] = []
    whole, _ = sample(tmp_path / "a", on_sealing=told.extend)
    opened = tmp_path / "000000.mcap.open"
    opened.write_bytes(whole[: len(whole) - missing] + bytes(zeros))
    recovered = recover_segment(opened, lambda sealed, _: told.append(sealed))
    assert recovered.path is not None
    assert recovered.path.read_bytes() == whole
    assert (recovered.messages, recovered.damage) == (21, [])
    first, again = (replace(sealed.file, written=0) for sealed in told)
    assert (first, told[0].channels) == (again, told[1].channels)
    assert problems(recovered.path) == []


def test_a_sealed_segment_is_not_replaced(tmp_path: Path) -> None:
    whole, _ = sample(tmp_path / "a")
    (tmp_path / "000000.mcap").write_bytes(b"sealed")
    opened = tmp_path / "000000.mcap.open"
    for content in (whole, whole[:-9]):
        opened.write_bytes(content)
        with pytest.raises(StoreError, match="Move one of them"):
            recover_segment(opened)
        assert opened.read_bytes() == content
    assert (tmp_path / "000000.mcap").read_bytes() == b"sealed"
    opened.unlink()
    segment = SegmentFile.create(tmp_path, 0, RECORDING)
    with pytest.raises(StoreError, match="Move one of them"):
        segment.prepare(sync=False)


@pytest.mark.parametrize("seed", [0, 1, *each(*range(2, 9))])
def test_damage_inside_an_open_segment_costs_no_other_chunk(tmp_path: Path, seed: int) -> None:
    """A few bytes anywhere: chunks that they do not touch are kept, and all is told."""
    rng = random.Random(seed)
    whole, chunks = sample(tmp_path / "a")
    first = chunks[0].place.offset
    for _ in range(60):
        length = rng.choice([1, 8, 200])
        at = rng.randrange(first, len(whole) - length)
        damaged = bytearray(whole)
        damaged[at : at + length] = rng.randbytes(length) if seed % 2 else bytes(length)
        if damaged == whole:
            continue
        recovered = recovered_of(tmp_path, damaged)
        assert recovered.path is not None
        with SegmentReader(recovered.path, 0) as reader:
            summary = reader.summary()
            found = [reader.read_chunk(place) for place in summary.chunks]
        kept = {chunk.place.offset: content_of(chunk)[1:] for chunk in found}
        want = {chunk.place.offset: content_of(chunk)[1:] for chunk in chunks}
        for chunk in chunks:
            end = chunk.place.end
            if whole[chunk.place.offset : end] == damaged[chunk.place.offset : end]:
                # Where it is lost all the same, what defines its channels is.
                lost = any("is lost" in text for text in recovered.damage)
                assert kept.get(chunk.place.offset) == want[chunk.place.offset] or lost
        assert all(content == want[offset] for offset, content in kept.items())
        if chunks[-1].place.offset in kept and len(kept) < len(chunks):
            assert recovered.damage
        assert problems(recovered.path) == []
        data = io.BytesIO(recovered.path.read_bytes())
        list(StreamReader(data, validate_crcs=True).records)
        recovered.path.unlink()


def test_a_segment_that_lost_its_metadata_is_not_thrown_away(tmp_path: Path) -> None:
    whole, chunks = sample(tmp_path / "a")
    at = whole.index(RECORDING_METADATA.encode()) - 4
    damaged = bytearray(whole[:-9])
    damaged[at] ^= 0x80  # the length of its name
    opened = tmp_path / "000000.mcap.open"
    opened.write_bytes(damaged)
    with pytest.raises(SegmentError, match="damaged"):
        recover_segment(opened)
    assert opened.read_bytes() == damaged
    recovered = recover_segment(opened, recording=RECORDING)
    assert recovered.messages == sum(len(chunk.batch) for chunk in chunks)
    assert recovered.path is not None
    summary = summary_of(recovered.path, 0)
    assert summary.recording["id"] == RECORDING["id"]
    assert summary.recording["segment"] == 0


@settings(max_examples=15)
@given(st.data())
def test_a_full_disk_costs_nothing_that_was_told_of(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """From any step on; the recorder gives up or dies, and the store is opened again."""
    directory = tmp_path_factory.mktemp("full")
    first = data.draw(st.integers(0, 40))
    gives_up, returns = data.draw(st.booleans()), data.draw(st.booleans())
    in_one = data.draw(st.booleans())
    chunks: list[StoredChunk] = []
    told: dict[str, Sealed] = {}
    system = Steps(fail_from=first, fail_until=first + 3 if returns else None)
    with through(system):
        writer = recorder(
            directory,
            chunks,
            SegmentSettings(
                chunk_size=1024,
                segment_size=8000,
                sync="chunk",
                large_payload=600,
                own_payload=50,
            ),
            is_latched=lambda channel: in_one or channel is CHANNELS[0],
            on_sealing=lambda group: told.update({one.file.name: one for one in group}),
        )
        try:
            for n in range(40):
                writer.append(batch_of([(n % 2, os.urandom(700), n, n, n)]), CHANNELS)
            writer.close()
        except (DiskFullError, StoreError):
            try:
                if gives_up:
                    writer.close_truncated([])
                else:
                    writer.abort()
            except (DiskFullError, StoreError):
                writer.abort()
    for opened in sorted(directory.glob("*.open")):
        recover_segment(opened, lambda sealed, _: told.update({sealed.file.name: sealed}))
    found = []
    for path in sorted(directory.iterdir()):
        number = int(path.name.removesuffix(".mcap"))
        assert problems(path, told[path.name].file.digest) == []
        with SegmentReader(path, number) as reader:
            summary = reader.summary()
            assert summary.size == told[path.name].file.bytes
            found += [reader.read_chunk(place) for place in summary.chunks]
        list(make_reader(io.BytesIO(path.read_bytes()), validate_crcs=True).iter_messages())
    have = {(c.segment, c.number): content_of(c) for c in found}
    assert all(have[c.segment, c.number] == content_of(c) for c in chunks)


def test_all_that_is_wrong_is_told_at_once(tmp_path: Path) -> None:
    whole, chunks = sample(tmp_path / "a")
    path = tmp_path / "000000.mcap"
    damaged = bytearray(whole)
    places = [12, chunks[0].place.offset + 60]
    for at in places:
        damaged[at] ^= 1
    path.write_bytes(damaged)
    read: list[int] = []
    found, has_summary = damage_of(path, progress=read.append)
    assert [at for at, _ in found] == [chunks[0].place.offset]
    assert found[0][1].startswith("chunk 0 is lost (messages: /large 1): ")
    assert read == sorted(read)
    assert has_summary
    # Without its summary, what has a checksum of its own is still looked at.
    damaged[-3] ^= 1
    damaged[chunks[0].place.offset + 30] ^= 1
    path.write_bytes(damaged)
    found, has_summary = damage_of(path)
    assert not has_summary
    assert chunks[0].place.offset in dict(found)
