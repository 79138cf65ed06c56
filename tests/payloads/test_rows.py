"""A log and its rows: what a reader gives of both is the same, but for the payloads."""

from __future__ import annotations

import shutil
import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.columns.rows import RowsFile, reduced
from hybridlog.entries import put_entry
from hybridlog.maintenance.keep import expire, write_rows
from hybridlog.schema.codecs import codec_for
from hybridlog.shared import RecordingRows
from hybridlog_storage import manifest as truth
from hybridlog_storage.errors import PayloadError, SegmentError, StoreError
from hybridlog_storage.manifest import File
from hybridlog_storage.messages import EXPIRED_IDS, REDUCED, Channel, Schema, left_channel
from hybridlog_storage.segments.segment_reader import GoneLog, SegmentReader, open_log
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.indexed import index_fields
from tests.limits import limits

POINT = Schema("a/Point", "ros1msg", b"int64 n\nuint8[] data\n")
CHANNELS = [
    Channel("/point", "ros1", POINT),
    Channel("/point", "json", None),
    Channel("/said", "json", None, has_publish_time=False),
    Channel("/raw", "odd", None, is_indexed=False),
]
PAYLOADS = st.one_of(
    st.binary(max_size=40),
    st.integers(0, 99).map(lambda n: b'{"n": %d}' % n),
    st.binary(max_size=30).map(lambda data: bytes(8) + len(data).to_bytes(4, "little") + data),
)
TIMES = st.integers(0, 1 << 62)
MESSAGES = st.lists(st.tuples(st.integers(0, 3), PAYLOADS, TIMES, TIMES), min_size=1, max_size=60)


def log_of(store: Path, messages: list[tuple[int, bytes, int, int]]) -> tuple[Path, list[File]]:
    """The folder and the logs with messages of a new recording of these messages."""
    small = SegmentSettings(chunk_size=1024)
    with hl.open(store, create=True, mongo="none") as opened:
        with opened.start("log", settings=small) as recording:
            for channel, payload, log_time, publish_time in messages:
                own = CHANNELS[channel]
                publish = publish_time if own.has_publish_time else None
                recording.write(own, payload, log_time=log_time, publish_time=publish)
        logs = places.manifest(store, "log").logs.values()
    return places.folder(store, "log"), [log for log in logs if log.parts]


@given(messages=MESSAGES, kind=st.sampled_from(["expired", "elsewhere"]), rows=st.integers(2, 50))
@settings(max_examples=10)
def test_a_log_and_its_rows_say_the_same(
    messages: list[tuple[int, bytes, int, int]], kind: str, rows: int
) -> None:
    """Also where a chunk is in several row groups."""
    with tempfile.TemporaryDirectory() as place, limits(row_group_rows=rows):
        folder, logs = log_of(Path(place) / "store", messages)
        for log in logs:
            line = truth.replace(log, gone=kind)
            made = write_rows(folder, line, folder)
            assert sum(p.messages for one in made for p in one.parts.values()) == sum(
                part.messages for part in log.parts.values()
            )
            compare(folder, line, made, added=EXPIRED_IDS * (1 if kind == "expired" else 2))


def list_rows(folder: Path, line: File, made: Sequence[File]) -> None:
    """List files of rows in a manifest, and what becomes of their log."""
    manifest = places.manifest(folder.parent.parent, "log")
    places.write_in(folder, truth.with_rows(manifest, line, made))


def compare(folder: Path, line: File, made: tuple[File, ...], added: int) -> None:
    list_rows(folder, line, made)
    left = RecordingRows(folder).left
    with (
        SegmentReader(folder / line.name, line.number) as log,
        open_log(folder / made[0].name, line.number, left) as gone,
    ):
        here, there = log.summary(), gone.summary()
        assert isinstance(gone, GoneLog)
        assert gone.log == line
        assert (gone.size, gone.digest()) == (log.size, log.digest())
        for name in ("recording", "losses", "attachments", "records", "size"):
            assert getattr(there, name) == getattr(here, name)
        assert there.table.counts() == {
            n + added: count for n, count in here.table.counts().items()
        }
        assert {*there.channels} == {*here.channels} | there.table.counts().keys()
        assert np.array_equal(there.table.chunks, here.table.chunks)
        assert np.array_equal(there.table.as_stored().parts, here.table.parts)
        for was, now in zip(here.chunks, there.chunks, strict=True):
            assert replace(now, channels=was.channels) == was
            assert now.channels == tuple(number + added for number in was.channels)
            whole, left = log.read_chunk(was), gone.read_chunk(now)
            for name in ("log_time", "publish_time", "sequence"):
                assert np.array_equal(getattr(left.batch, name), getattr(whole.batch, name))
            assert np.array_equal(left.batch.channel, whole.batch.channel + added)
            assert all(map(np.array_equal, left.batch.places, whole.batch.places))
            assert np.array_equal(left.seq, whole.seq)
            times = {number + added: own for number, own in log.read_times(was).items()}
            found = gone.read_times(now)
            assert found.keys() == times.keys()
            assert all(np.array_equal(found[number], times[number]) for number in times)
            # Who has asked before it went reads what is left, too.
            assert np.array_equal(gone.read_chunk(was).seq, whole.seq)
            with pytest.raises(SegmentError, match="is gone"):
                gone.read(was.offset, was.length)


def test_a_damaged_file_of_rows_is_told(tmp_path: Path) -> None:
    folder, (log, *_) = log_of(tmp_path / "store", [(2, b'{"n": 1}', 1, 1)])
    line = truth.replace(log, gone="expired")
    (made,) = write_rows(folder, line, folder)
    list_rows(folder, line, [made])
    path = folder / made.name
    whole = path.read_bytes()
    for at in range(0, len(whole), 31):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(StoreError):
            check_all(folder, made)
    for size in range(0, len(whole), 500):
        path.write_bytes(whole[:size])
        with pytest.raises(StoreError):
            check_all(folder, made)


def check_all(folder: Path, made: File) -> None:
    with open_log(folder / made.name, made.number, RecordingRows(folder).left) as gone:
        for place in gone.summary().chunks:
            gone.read_chunk(place)
    RowsFile(folder, made).check()


def test_fields_of_json_are_left(tmp_path: Path) -> None:
    """A null is no field then, and numbers of a chunk are all floats if one is."""
    said = [
        b'{"n": 1, "e": {}, "s": "a", "deep": {"x": [1, 2], "e": [{}, {}]}}',
        b'{"n": 2, "e": {}, "s": "b", "deep": {"x": [], "e": []}, "more": [[1], [2, 3]]}',
        b'{"n": 3, "mixed": 1, "big": 123456789012345678901234567890}',
        b'{"n": 4, "mixed": "one", "t": true, "log_time": 7, "_id": 1}',
        b'{"n": 5, "long": %s}' % str([*range(40)]).encode(),
        b"[1, 2]",
        b"none",
    ]
    log_of(tmp_path / "store", [(2, one, at, at) for at, one in enumerate(said)])
    with hl.open(tmp_path / "store", mongo="none") as store:
        before = [message.fields for message in store.all_topics() if message.seq < 6]
        places_of = [(m.seq, m.log_time_ns) for m in store.all_topics()]
        (entry,) = store.recordings()
        with store.directory.writing(entry.id):
            expire(store.directory, entry.id, [*map(int, entry.digests)])
        store.refresh()
        left = [*store.all_topics()]
        assert {message.state.value for message in left} == {"expired"}
        assert [(m.seq, m.log_time_ns) for m in left] == places_of
        assert [message.fields for message in left if message.seq < 6] == before
        assert store.topic("said").where("n >= 3").count() == 3
        assert store.topic("said").where("deep.x[0] == 1").count() == 1
        with pytest.raises(PayloadError, match=r"deleted to make room.*65 bytes"):
            bytes(left[0].payload)


CUT = Schema(
    "a/Cut",
    "ros1msg",
    b"float32[] r\nuint64 u\na/In[] e\n" + b"=" * 80 + b"\nMSG: a/In\nuint8[] b\ntime t",
)


def test_what_pressure_cut_answers_as_what_expired(tmp_path: Path) -> None:
    """With tables, from chunks, and when the log has gone, too."""
    fields = struct.pack("<100fQI", *range(100), (1 << 64) - 1, 1) + bytes(4) + bytes(8)
    payload = struct.pack("<I", 100) + fields
    json_text = b'{"r": [%s], "s": [1.5], "d": {"n": 5}, "e": []}' % b", ".join([b"2"] * 50)
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        with store.start("log") as recording:
            for own, message in ((Channel("/cut", "ros1", CUT), payload), (CHANNELS[2], json_text)):
                codec, small = codec_for(own), left_channel(own, REDUCED)
                recording.write(small, reduced(codec, message), log_time=1)
                recording.write(small, reduced(codec, message[:-1]), log_time=2)
        before = answers_of(store)
        assert before["/cut"][0] == index_fields(codec_for(Channel("", "ros1", CUT)), payload)
        assert before["/said"][0] == index_fields(codec_for(CHANNELS[2]), json_text)
        shutil.rmtree(tmp_path / "store" / "tables")
        (entry,) = store.recordings()
    with hl.open(tmp_path / "store", mongo="none") as store:
        assert answers_of(store) == before
        with store.directory.writing(entry.id, entry.name):
            expire(store.directory, entry.id, [*store.directory.manifests.read(entry.id).logs])
            put_entry(store.directory, store.shared.catalog, entry.id)
    with hl.open(tmp_path / "store", mongo="none") as store:
        assert answers_of(store) == before
    assert before["sql"] == [(99.0, None, (1 << 64) - 1), (None, None, None)]
    assert before["/cut"][-1] == (1, 1)


def answers_of(store: hl.Store) -> dict[str, list[object]]:
    found: dict[str, list[object]] = {}
    for topic in ("/cut", "/said"):
        query = store.topic(topic).fields("r.max", "r", "e")
        rows = query.to_arrow().to_pylist()
        about = [(message.fields, message.state) for message in store.topic(topic)]
        for message in store.topic(topic):
            with pytest.raises(
                PayloadError, match=r"pressure.* \(\d+ bytes, SHA-256 [0-9a-f]{64}\)"
            ):
                message.raw  # noqa: B018
        found[topic] = [
            *(fields for fields, _ in about),
            rows,
            store.topic(topic).where("r.max > 2").count(),
        ]
        found[topic] += [(query.counters.lacking, query.counters.unreadable)]
    found["sql"] = store.sql("select r_summary.max, r, u from cut order by t").rows()
    return found
