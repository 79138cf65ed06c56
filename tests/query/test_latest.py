"""The message at a time, against a loop; what looking around in a log, and counting, reads."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.query.query import at_time
from hybridlog.record.recorder import RecordOptions
from hybridlog_storage.errors import SegmentError, TopicError
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.query.conftest import PADDING
from tests.query.test_intervals import BASE, SECOND, Model, recorded, several

rows = st.lists(
    st.tuples(
        st.integers(0, 200), st.sampled_from(["/state", "/state", "/other"]), st.integers(0, 3)
    ),
    min_size=1,
    max_size=60,
)


def looked_for(
    model: Model, keys: dict[str, str], topics: set[str], now: int, states: set[int]
) -> tuple[str, object] | None:
    """Recording and number of the current message: by time, recording, then arrival."""
    found = [
        (m.time, keys[name], name, place, m.value["n"])
        for name, log in model.logs.items()
        for place, m in enumerate(log)
        if m.topic in topics and m.time <= now and m.value["s"] in states
    ]
    return (max(found)[2], max(found)[4]) if found else None


@several
@given(
    logs=st.fixed_dictionaries({"a": rows, "b": rows}),
    moments=st.lists(st.integers(-2, 210), min_size=1, max_size=8),
)
def test_the_message_at_a_time_is_what_a_loop_finds(
    store: hl.Store,
    logs: dict[str, list[tuple[int, str, int]]],
    moments: list[int],
) -> None:
    model = recorded(
        store,
        {
            name: [
                (t, topic, {"s": s, "n": n, "name": PADDING}) for n, (t, topic, s) in enumerate(log)
            ]
            for name, log in logs.items()
        },
    )
    keys = {entry.id: entry.key for entry in store.recordings()}
    for topics in ({"/state"}, {"/other"}, {"/state", "/other"}):
        if not topics <= set(store.topics()):
            continue
        query = store.topic(*topics)
        for states, asked in ((range(4), query), ((0, 2), query.where("s == 0 or s == 2"))):
            for moment in moments:
                now = BASE + moment * SECOND + 1
                want = looked_for(model, keys, topics, now, {*states})
                if want is None:
                    with pytest.raises(TopicError, match="at or before"):
                        asked.at(f"{now}ns")
                    continue
                (same,) = at_time(asked, f"{now}ns")
                for found in (asked.at(f"{now}ns"), same):
                    assert (found.recording, found.fields["n"]) == want


def test_a_chunk_is_read_once_for_who_looks_around_in_it(many: hl.Store) -> None:
    query = many.topic("/state")
    read = []
    for moment in range(200):
        assert query.at(f"+{moment}s").fields["n"] == moment
        assert query.counters.messages == 1
        assert query.counters.documents_read == 0
        read.append((query.counters.chunks_read, query.counters.bytes_read > 0))
    assert set(read) == {(0, False), (1, True)}
    assert sum(count for count, _ in read) == many.recordings()[0].chunks


def test_a_count_by_time_reads_indexes_at_its_ends_only(many: hl.Store) -> None:
    query = many.topic("/state").between("+5s", "+165s")
    assert query.count() == 160
    assert query.counters.documents_read == query.counters.chunks_read == 0
    assert 0 < query.counters.bytes_read < 1000


@pytest.mark.parametrize("damage", ["chunk", "time", "place", "length", "opcode", "arrivals"])
def test_a_damaged_message_index_is_not_believed(many: hl.Store, damage: str) -> None:
    """Whether or not what it says could be: its chunk is damaged with it, and that is said."""
    path = places.segment(many.directory.path, "a")
    whole = path.read_bytes()
    (entry,) = many.recordings()
    chunk = many.session.chunks(entry, [entry.channels[0].id])[0]
    index = chunk.place.offset + chunk.place.length
    second = 9 + 6 + 16  # entry: record head, channel, length, the first one
    at = {
        "chunk": -1,
        "opcode": 0,
        "length": 2,
        "time": second,
        "place": second + 8,
        "arrivals": chunk.place.trailer - 1,
    }[damage]
    damaged = bytearray(whole)
    damaged[index + at] ^= 1
    path.write_bytes(damaged)
    try:
        with hl.open(many.directory.path) as alone:
            query = alone.topic("/state").between("+5s", "+165s")
            said = pytest.raises(SegmentError, match=f"{chunk.place.offset} of .*{path.name}")
            if damage in {"arrivals", "chunk"}:
                assert query.count() == 160  # the index has a checksum of its own
            else:
                with said:
                    query.count()
            for ask in (lambda: list(query), lambda: alone.topic("/state").at("+3s")):
                with said:
                    ask()
            assert alone.topic("/state").at("end").fields["n"] == 199
            # Within one range the chunk is not looked at.
            assert alone.topic("/state").between("+20s", "+165s").count() == 145
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_who_changes_a_message_does_not_change_what_is_kept(
    tmp_path: Path, compression: str
) -> None:
    from benchmarks.simulator.write import write_bag

    write_bag(tmp_path / "robot.bag", duration_s=1.0)
    settings = SegmentSettings(compression=compression)  # type: ignore[arg-type]
    with hl.open(tmp_path / "store", create=True) as opened:
        opened.record(tmp_path / "robot.bag", RecordOptions(settings=settings))
        scan = opened.topic("/base/scan").at("end")
        before = scan.raw
        with pytest.raises(TypeError, match="read-only"):
            scan.payload[0] = 1
        with pytest.raises(ValueError, match="read-only"):
            scan.decode().ranges[0] = 1.0
        assert opened.topic("/base/scan").at("end").raw == before
