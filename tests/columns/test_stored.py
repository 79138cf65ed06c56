"""Columns beside the segments: made with the recording, right or not there at all."""

from __future__ import annotations

import errno
import os
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hybridlog as hl
import hybridlog.store
from hybridlog.columns import gatherer as gathering
from hybridlog.columns.gatherer import FieldGatherer
from hybridlog.columns.stored import NAME, FieldColumns
from hybridlog.schema.column import Strings
from hybridlog_storage import column_file
from hybridlog_storage.database import Database
from hybridlog_storage.errors import DatabaseError, TimeError
from hybridlog_storage.index_state import IndexState
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segment_writer import SegmentSettings
from tests.columns.test_kept import BASE, DEFINITION, SECOND, message, usual, write_log
from tests.data import DATA, needs_data

CHANNEL = Channel("/state", "ros1", Schema("test/State", "ros1msg", DEFINITION))
OTHER = Channel("/other", "ros1", Schema("std_msgs/Int32", "ros1msg", b"int32 data"))

SMALL_CHUNKS = SegmentSettings(chunk_size=1024)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True, require_database=True) as opened:
        yield opened


@pytest.fixture
def recorded(store: hl.Store, tmp_path: Path) -> hl.Store:
    """A recording of sixty messages of two topics, in many chunks."""
    rows = [
        (BASE + n % 7 * SECOND, "/other" if n % 5 == 0 else "/state", message(usual(i8=n % 3)))
        for n in range(60)
    ]
    write_log(tmp_path / "log.mcap", rows)
    store.record(tmp_path / "log.mcap", name="log", settings=SMALL_CHUNKS)
    return store


def file_of(store: hl.Store, recording: str = "log") -> Path:
    return store.directory.recording(store.entry(recording).label) / NAME


def value_of(document: dict[str, Any], path: str) -> Any:
    found: Any = document
    for name in path.split("."):
        found = found[name]
    return found


def alike(one: Any, other: Any) -> bool:
    both_nan = one != one and other != other
    return both_nan or one == other


def compare_with_documents(store: hl.Store) -> int:
    """Every column of every recording with what MongoDB has; returns how many there are."""
    compared = 0
    for entry in store.recordings():
        columns = store.columns(entry.id)
        if columns is None:
            continue
        for topic in {c.topic for c in entry.channels}:
            types = store.kept.types(entry, topic)
            if not types or not columns.has(entry, topic, types):
                continue
            found = columns.read(topic, types, ordered=True)
            documents = list(store.query([topic], [entry.id]).documents())
            assert found.log_time.tolist() == [d["_meta"]["t"] for d in documents]
            assert found.seq.tolist() == [d["_meta"]["seq"] for d in documents]
            for path, column in found.fields.items():
                want = [value_of(d, path) for d in documents]
                have = texts(column) if isinstance(column, Strings) else column.values.tolist()
                assert all(map(alike, have, want)), (topic, path)
                assert len(have) == len(want)
                compared += 1
    return compared


def texts(column: Strings) -> list[str]:
    cells = zip(column.offset[:-1].tolist(), column.offset[1:].tolist(), strict=True)
    return [column.data[a:b].tobytes().decode() for a, b in cells]


REAL = ["auv_ros2.mcap", "robot_localization_test3.bag", "tilt_laser.bag"]


@needs_data
@pytest.mark.parametrize("name", REAL)
def test_columns_of_real_logs_are_what_the_index_has(store: hl.Store, name: str) -> None:
    (log,) = DATA.glob(f"**/{name}")
    store.record(log, name="log")
    assert compare_with_documents(store) > 5


@pytest.mark.parametrize(
    ("arena", "enough", "rows"),
    [(2 << 20, 1 << 20, 1 << 18), (500, 400, 1 << 18), (500, 250, 3), (1, 1, 1)],
)
def test_columns_are_what_the_index_has(
    store: hl.Store,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arena: int,
    enough: int,
    rows: int,
) -> None:
    monkeypatch.setattr(gathering, "_ARENA", arena)
    monkeypatch.setattr(gathering, "_ENOUGH", enough)
    monkeypatch.setattr(gathering, "_ROWS", rows)
    said = [
        (BASE + n * 7 % 11, "/other" if n % 4 == 0 else "/state", message(usual(i64=n)))
        for n in range(40)
    ]
    write_log(tmp_path / "log.mcap", said)
    store.record(tmp_path / "log.mcap", name="log", settings=SMALL_CHUNKS)
    assert compare_with_documents(store) == 2 * 10


def test_the_first_question_is_answered_from_the_file(recorded: hl.Store) -> None:
    query = recorded.topic("/state").where("i8 == 1")
    assert query.count() == 16
    assert query.counters.bytes_read > 0
    assert query.counters.documents_read == query.counters.chunks_read == 0
    assert recorded.kept._kept


def live(store: hl.Store, count: int = 50, **options: Any) -> str:
    with store.start("live", **options) as recording:
        for n in range(count):
            recording.write(CHANNEL, message(usual(i64=n)), log_time=BASE + n)
            recording.write(OTHER, n.to_bytes(4, "little"), log_time=BASE + n)
    return recording.id


def test_a_live_recording_has_columns(store: hl.Store) -> None:
    live(store, flush_interval_s=0.01)
    assert compare_with_documents(store) == 11


def test_while_a_recording_goes_on_there_are_none(store: hl.Store) -> None:
    with store.start("live") as recording:
        recording.write(CHANNEL, message(usual()))
        assert store.columns(recording.id) is None
        assert not (store.directory.recording(recording.label) / NAME).exists()
    assert store.columns(recording.id) is not None


def test_a_recording_that_is_taken_back_leaves_nothing(store: hl.Store) -> None:
    recording = store.start("live")
    recording.write(CHANNEL, message(usual()))
    recording.abort()
    assert not list((store.directory.path / "recordings").iterdir())


def test_reindex_makes_them_again(recorded: hl.Store) -> None:
    before = file_of(recorded).read_bytes()
    file_of(recorded).unlink()
    recorded.refresh()
    assert recorded.topic("/state").where("i8 == 1").count() == 16
    recorded.reindex()
    assert file_of(recorded).read_bytes() == before
    assert compare_with_documents(recorded) == 20


def test_what_a_crash_has_left_gets_all_its_columns(recorded: hl.Store) -> None:
    database = recorded.database_for("This")
    path = recorded.directory.path
    before = file_of(recorded).read_bytes()
    # As if the recorder had been killed: some chunks are indexed, and the end is missing.
    (entry,) = recorded.recordings()
    chunks = recorded.catalog.chunks(entry)
    half = chunks[1::2]
    assert half
    state = IndexState(database)
    state.put(entry, "open", turn=1)
    state.put_chunks(chunks[::2])
    for topic in ("state", "other"):
        database.delete(topic, {"_meta.ref.chunk": {"$in": [chunk.number for chunk in half]}})
    file_of(recorded).rename(path / f"recordings/log/{NAME}.part")
    recorded.close()
    with hl.open(path, require_database=True) as again:
        assert again.repairs.indexed == {"log": len(half)}
        assert again.verify().findings == []
        assert file_of(again).read_bytes() == before
        assert compare_with_documents(again) == 20
    assert not list(path.glob("**/*.part"))


@pytest.mark.parametrize("part", ["block", "page", "directory"])
def test_damage_is_found_told_and_mended(recorded: hl.Store, part: str) -> None:
    file = file_of(recorded)
    content = bytearray(file.read_bytes())
    page = content.index(b'{"columns"')
    content[{"block": 20, "page": page + 4, "directory": len(content) - 30}[part]] ^= 1
    file.write_bytes(content)
    recorded.refresh()
    assert [recorded.topic("/state").where("i8 == 1").count() for _ in range(3)] == [16] * 3
    assert recorded.topic("/state").fields("i8").to_pandas()["i8"].sum() == 48
    (finding,) = recorded.verify().findings
    assert finding.place == "columns"
    assert str(file) in finding.problem
    assert "hybridlog reindex" in finding.problem
    recorded.reindex()
    assert not recorded.verify().findings


def test_columns_of_other_messages_are_not_believed(recorded: hl.Store, tmp_path: Path) -> None:
    write_log(tmp_path / "more.mcap", [(BASE, "/state", message(usual(i8=1)))], "more")
    recorded.record(tmp_path / "more.mcap", name="more")
    shutil.copy(file_of(recorded, "more"), file_of(recorded))
    recorded.refresh()
    assert recorded.topic("/state").where("i8 == 1").count() == 17
    (finding,) = recorded.verify().findings
    assert "1 messages of /state, the segments 48" in finding.problem
    # Nor when there are as many.
    recorded.remove("more")
    (log,) = tmp_path.glob("log.mcap")
    recorded.record(log, name="more", again=True)
    shutil.copy(file_of(recorded, "more"), file_of(recorded))
    recorded.refresh()
    (finding,) = recorded.verify(["log"]).findings
    assert "of another recording" in finding.problem


@pytest.mark.parametrize("lie", ["ordered", "text", "times", "long"])
def test_a_file_that_lies_is_not_believed(store: hl.Store, tmp_path: Path, lie: str) -> None:
    said = [(BASE + 50 - n, "/state", message(usual(i8=n % 3))) for n in range(50)]
    write_log(tmp_path / "log.mcap", said)
    entry = store.record(tmp_path / "log.mcap", name="log").entry
    query = store.topic("/state").where("i8 == 1")
    late = query.between(BASE + 30, BASE + 40)
    named = store.topic("/state").where({"name": "a"})
    want = [query.count(), late.count(), named.count()]
    assert want == [17, 3, 50]
    columns: dict[str, Any] = {
        ":log_time": np.array([time for time, *_ in said]),
        ":seq": np.arange(50),
        "i8": np.array([n % 3 for n in range(50)], np.int8),
        "name": column_file.Text(np.full(50, ord("a"), np.uint8), np.arange(51)),
    }
    if lie == "text":
        columns["i8"] = columns["name"]
    elif lie == "times":
        columns[":log_time"] = columns[":log_time"].astype(np.float64)
    elif lie == "long":
        cells = np.full(50 << 16, ord("b"), np.uint8)
        columns["name"] = column_file.Text(cells, np.arange(51) << 16)
    writer = column_file.ColumnFileWriter(file_of(store))
    writer.append("/state", columns)
    writer.close({"/state": {"recording": entry.key, "ordered": lie in {"ordered", "times"}}})
    for turn in (query, late, named):
        store.refresh()
        assert [query.count(), late.count(), named.count()] == want
        turn.count()
    if lie in {"ordered", "times"}:
        (finding,) = store.verify().findings
        assert finding.place == "columns"


def test_a_chunk_that_is_indexed_twice_is_no_two_chunks(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = IndexState.put_chunks
    failures = iter([True])

    def sometimes(state: IndexState, entries: Any) -> None:
        if next(failures, False):
            raise DatabaseError("for a moment")
        put(state, entries)

    monkeypatch.setattr(IndexState, "put_chunks", sometimes)
    words = Channel("/words", "ros1", Schema("std_msgs/String", "ros1msg", b"string data"))
    with store.start("live", flush_interval_s=0.05) as recording:
        for word in (b"small", b"x" * 5000):
            for n in range(10):
                payload = len(word).to_bytes(4, "little") + word
                recording.write(words, payload, log_time=BASE + n)
            time.sleep(2.5)
    assert store.topic("/words").where('data == "small"').count() == 10
    columns = store.columns(recording.id)
    assert columns is not None
    assert compare_with_documents(store) == 0
    assert store.verify().findings == []


def test_a_link_in_the_place_of_the_file_leads_nowhere(recorded: hl.Store, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    file = file_of(recorded)
    file.with_name(f"{NAME}.part").symlink_to(victim)
    recorded.reindex()
    assert victim.read_text() == "mine"
    assert compare_with_documents(recorded) == 20
    assert not list(file.parent.glob("*.part"))


@pytest.mark.parametrize("kind", ["directory", "fifo", "empty", "loop"])
def test_other_things_in_the_place_of_the_file(
    recorded: hl.Store, caplog: pytest.LogCaptureFixture, kind: str
) -> None:
    file = file_of(recorded)
    file.unlink()
    if kind == "directory":
        file.mkdir()
    elif kind == "fifo":
        os.mkfifo(file)
    elif kind == "empty":
        file.touch()
    else:
        file.symlink_to(file)
    recorded.refresh()
    assert recorded.topic("/state").where("i8 == 1").count() == 16
    assert len(recorded.verify().findings) == 1
    recorded.reindex()
    assert recorded.topic("/state").where("i8 == 1").count() == 16
    # A directory may hold something of somebody's: that is said, and left alone.
    assert len(recorded.verify().findings) == (kind == "directory")
    assert ("no columns in" in caplog.text) == (kind == "directory")


def test_the_last_room_is_the_segments_alone(
    store: hl.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gathering, "_RESERVE", 1 << 62)
    write_log(tmp_path / "log.mcap", [(BASE, "/state", message(usual(i8=1)))])
    store.record(tmp_path / "log.mcap", name="log")
    assert not list(store.directory.path.glob(f"**/{NAME}*"))
    assert store.topic("/state").where("i8 == 1").count() == 1


@pytest.mark.parametrize("error", [MemoryError(), ValueError("odd"), OSError(errno.EIO, "no")])
@pytest.mark.parametrize("place", ["append", "close"])
def test_whatever_fails_the_recording_goes_on(
    store: hl.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, error: Exception
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(column_file.ColumnFileWriter, place, fail)
    write_log(tmp_path / "log.mcap", [(BASE, "/state", message(usual(i8=1)))])
    assert store.record(tmp_path / "log.mcap", name="log").entry.status == "complete"
    assert not list(store.directory.path.glob(f"**/{NAME}*"))


def test_columns_are_opened_while_all_is_forgotten(recorded: hl.Store) -> None:
    log = recorded.entry("log").id

    def ask() -> None:
        for _ in range(300):
            assert recorded.columns(log) is not None

    with ThreadPoolExecutor(2) as pool:
        asked = [pool.submit(ask) for _ in range(2)]
        while not all(one.done() for one in asked):
            recorded.refresh()
        for one in asked:
            one.result()


def test_files_of_many_recordings_are_not_all_kept_open(
    store: hl.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hybridlog.store, "_MOST_OPEN", 2)
    for n in range(5):
        write_log(tmp_path / f"{n}.mcap", [(BASE + n, "/state", message(usual(i8=n)))])
        store.record(tmp_path / f"{n}.mcap", name=f"log{n}")
    opened: list[int] = []
    read = FieldColumns.read

    def counted(columns: FieldColumns, *arguments: Any, **choices: Any) -> Any:
        files = (one for one in Path("/proc/self/fd").iterdir() if one.is_symlink())
        opened.append(sum(one.readlink().name == NAME for one in files))
        return read(columns, *arguments, **choices)

    monkeypatch.setattr(FieldColumns, "read", counted)
    for _ in range(5):  # the index is cheaper at first
        assert store.topic("/state").where("i8 > 1").count() == 3
    assert len(opened) == 5
    assert max(opened) <= 2


@pytest.mark.parametrize("pending", [1, 300])
def test_columns_laid_down_a_little_at_a_time(
    store: hl.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pending: int
) -> None:
    monkeypatch.setattr(gathering, "_ARENA", 500)
    monkeypatch.setattr(gathering, "_PENDING", pending)
    name = "long" * 700
    rows = [
        (BASE + n, "/state" if n % 7 else "/other", message(usual(i64=n, name=name[: n * 60])))
        for n in range(40)
    ]
    write_log(tmp_path / "log.mcap", rows)
    store.record(tmp_path / "log.mcap", name="log", settings=SMALL_CHUNKS)
    compare_with_documents(store)


@pytest.mark.parametrize("writes", [0, 1, 2])
def test_no_room_for_columns_is_no_loss(
    store: hl.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: int
) -> None:
    write = column_file.durability.write_all
    room = [writes]

    def scarce(fd: int, parts: Any) -> int:
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(fd, parts)

    class Scarce:
        write_all = staticmethod(scarce)

    monkeypatch.setattr(column_file, "durability", Scarce)
    write_log(tmp_path / "log.mcap", [(BASE, "/state", message(usual(i8=1)))])
    report = store.record(tmp_path / "log.mcap", name="log")
    assert room[0] < 0
    assert report.entry.status == "complete"
    assert store.columns(store.entry("log").id) is None
    assert not list(store.directory.path.glob(f"**/{NAME}*"))
    assert store.topic("/state").where("i8 == 1").count() == 1


def test_topics_that_do_not_fit_have_no_columns(store: hl.Store, tmp_path: Path) -> None:
    rows = [(BASE + n, "/state", message(usual())) for n in range(4)]
    rows += [(BASE + 9, "/other", message(usual())), (BASE + 10, "/other", b"torn")]
    write_log(tmp_path / "log.mcap", rows)
    store.record(tmp_path / "log.mcap", name="log")
    columns, (entry,) = FieldColumns(store.directory.recording("log")), store.recordings()
    assert columns.has(entry, "/state", {"i8": "int8", "name": "string", "at": "time"})
    assert not columns.has(entry, "/state", {"many": "float32"})
    assert not columns.has(entry, "/state", {"i8": "string"})
    assert not columns.has(entry, "/state", {"name": "int8"})
    assert not columns.has(entry, "/state", {"f32": "float64"})
    assert not columns.has(entry, "/other", {"i8": "int8"})


def test_a_topic_of_two_types_has_no_columns(store: hl.Store) -> None:
    with store.start("live") as recording:
        for n in range(3):
            recording.write(CHANNEL, message(usual()), log_time=BASE + n)
            recording.write(
                Channel("/state", "ros1", OTHER.schema), bytes(4), log_time=BASE + 10 + n
            )
            recording.write(OTHER, bytes(4), log_time=BASE + 20 + n)
    columns, (entry,) = FieldColumns(store.directory.recording(recording.label)), store.recordings()
    assert not columns.has(entry, "/state", {})
    assert columns.has(entry, "/other", {"data": "int32"})


def test_chunks_that_come_twice_make_no_columns(recorded: hl.Store, tmp_path: Path) -> None:
    entry = recorded.recordings()[0]
    place = tmp_path / "again"
    place.mkdir()
    gatherer = FieldGatherer(place)
    channels = {lane.channel_id: lane.channel for lane in recorded.session.channels(entry)}
    for chunk in recorded.catalog.chunks(entry):
        read = recorded.session.segment("log", chunk.segment).read_chunk(chunk.place)
        gatherer.add(read, channels)
        gatherer.add(read, channels)
    gatherer.close(entry)
    assert not list(place.iterdir())


@pytest.mark.parametrize(
    ("pending", "left"), [(1, 0), (6000, 0), (12_000, 6000), (16 << 20, 4 << 20)]
)
@pytest.mark.parametrize("seed", range(6))
def test_chunks_may_come_in_any_order(
    store: hl.Store,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    pending: int,
    left: int,
    seed: int,
) -> None:
    """Chunks that were let go come last; their rows have their place all the same."""
    name = live(store, 200, settings=SegmentSettings(chunk_size=1024, segment_size=8192))
    (entry,) = store.recordings()
    channels = {lane.channel_id: lane.channel for lane in store.session.channels(entry)}
    chunks = store.catalog.chunks(entry)
    assert len({chunk.segment for chunk in chunks}) > 2
    shuffled = chunks[seed // 2 :: 2] + chunks[: seed // 2] + chunks[seed // 2 + 1 :: 2]
    if seed % 2:
        np.random.default_rng(seed).shuffle(shuffled)
    assert shuffled != chunks
    assert len(shuffled) == len(chunks)
    monkeypatch.setattr(gathering, "_PENDING", pending)
    monkeypatch.setattr(gathering, "_LEFT", left)
    (tmp_path / "again").mkdir()
    gatherer = FieldGatherer(tmp_path / "again")
    told = set()
    for n, chunk in enumerate(shuffled):
        for later in shuffled[n + 1 :]:
            place = later.segment, later.offset
            if place < (chunk.segment, chunk.offset) and place not in told:
                gatherer.expect(*place)
                told.add(place)
        gatherer.add(store.session.segment(name, chunk.segment).read_chunk(chunk.place), channels)
    gatherer.close(entry)
    assert told
    found, file = FieldColumns(tmp_path / "again"), column_file.ColumnFile(file_of(store, name))
    if pending > 1 << 20:
        # When all had come, nothing was missing any more.
        for one in (found._file, file):
            assert sum(one._page(table).blocks for table in one.tables()) == 2 + 10 + 2 + 1
    for topic in ("/state", "/other"):
        assert found._file.notes(topic) == file.notes(topic)
        assert file.notes(topic)["ordered"] is True
        for column in file.types(topic):
            have, want = found._file.read(topic, column), file.read(topic, column)
            if isinstance(want, column_file.Text):
                assert isinstance(have, column_file.Text)
                assert [part.tolist() for part in have] == [part.tolist() for part in want]
            else:
                assert have.tolist() == want.tolist()
    found.check(entry)


IMAGE = Channel("/image", "ros1", Schema("test/Image", "ros1msg", b"uint32 width\nuint8[] data"))


def image(size: int) -> bytes:
    return (640).to_bytes(4, "little") + size.to_bytes(4, "little") + bytes(size)


def test_of_large_messages_there_is_their_order(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = [BASE + n for n in (0, 3, 1, 2, 4)]
    with store.start("live") as recording:
        for time in times:
            recording.write(IMAGE, image(2000), log_time=time)
    assert columns_in(file_of(store, recording.id)) == {"/image": [":log_time", ":seq"]}
    images = store.topic("/image")
    assert images.where("width == 640").count() == 5
    with monkeypatch.context() as patch:
        patch.setattr(Database, "count_each", None)  # nobody asks the index
        assert images.between(f"{BASE + 1}ns", f"{BASE + 4}ns").count() == 3
    file = store.columns(recording.id)
    assert file is not None
    assert file.read("/image", {}, ordered=True).log_time.tolist() == sorted(times)
    assert store.verify().findings == []


@settings(max_examples=15, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["/image", "/other"]), st.sampled_from([0, 900, 3000]), st.booleans()
        ),
        max_size=40,
    ),
    st.lists(st.tuples(st.integers(-1, 41), st.integers(0, 42)), min_size=1, max_size=5),
)
def test_messages_of_any_size_are_counted_in_ranges(
    tmp_path_factory: pytest.TempPathFactory,
    messages: list[tuple[str, int, bool]],
    ranges: list[tuple[int, int]],
) -> None:
    """Topics that are small in some chunks and large in others have columns of all or none."""
    own = {name: Channel(name, "ros1", IMAGE.schema) for name in ("/image", "/other")}
    where = tmp_path_factory.mktemp("sizes") / "store"
    with hl.open(where, create=True, require_database=True) as store:
        with store.start("live", settings=SegmentSettings(chunk_size=4096)) as recording:
            for n, (topic, size, swapped) in enumerate(messages):
                recording.write(own[topic], image(size), log_time=BASE + (n ^ swapped))
        assert store.verify().findings == []
        file = store.columns(recording.id)
        for topic in {topic for topic, *_ in messages}:
            times = [BASE + (n ^ s) for n, (t, _, s) in enumerate(messages) if t == topic]
            if file is not None and file.has(recording.close().entry, topic, {}):
                found = file.read(topic, {}, ordered=True).log_time.tolist()
                assert found == sorted(times)
            for begin, length in ranges:
                first, last = BASE + begin, BASE + begin + length
                with suppress(TimeError):
                    count = store.topic(topic).between(f"{first}ns", f"{last}ns").count()
                    assert count == sum(first <= time < last for time in times)


def columns_in(path: Path) -> dict[str, list[str]]:
    file = column_file.ColumnFile(path)
    return {table: sorted(file.types(table)) for table in file.tables()}
