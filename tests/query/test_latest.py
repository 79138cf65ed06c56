"""The message at a time, against a loop, and what looking around in a log reads."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.query.query import Query, at_time
from hybridlog.record.recorder import RecordOptions
from hybridlog_storage.errors import SegmentError, TopicError
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.query.conftest import AWAY, PADDING
from tests.query.test_intervals import BASE, SECOND, Model, recorded, several

pytestmark = pytest.mark.mongo


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
    is_away=st.booleans(),
)
def test_the_message_at_a_time_is_what_a_loop_finds(
    store: hl.Store,
    logs: dict[str, list[tuple[int, str, int]]],
    moments: list[int],
    is_away: bool,
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
    with hl.open(store.directory.path, mongo=AWAY) if is_away else nullcontext(store) as asked:
        keys = {entry.id: entry.key for entry in asked.recordings()}
        for topics in ({"/state"}, {"/other"}, {"/state", "/other"}):
            if not topics <= set(asked.topics()):
                continue
            questions: dict[tuple[int, ...], Query] = {(0, 1, 2, 3): asked.topic(*topics)}
            if not is_away:
                questions[0, 2] = asked.topic(*topics).where("s == 0 or s == 2")
            for states, query in questions.items():
                for moment in moments:
                    now = BASE + moment * SECOND + 1
                    want = looked_for(model, keys, topics, now, set(states))
                    if want is None:
                        with pytest.raises(TopicError, match="at or before"):
                            query.at(f"{now}ns")
                        continue
                    found = query.at(f"{now}ns")
                    assert (found.recording, found.fields["n"]) == want
                    (same,) = at_time(query, f"{now}ns")
                    assert (same.recording, same.fields["n"]) == want


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


def test_a_damaged_chunk_is_named(many: hl.Store) -> None:
    entry = many.recordings()[0]
    path = places.segment(many.directory.path, entry.name)
    whole = path.read_bytes()
    last = many.session.chunks(entry, [entry.channels[0].id], None, "log")[-1]
    place = last.place.offset + last.place.length - 1
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    try:
        with pytest.raises(SegmentError, match=f"{last.place.offset} of .*{path.name}"):
            many.topic("/state").at("end")
        assert many.topic("/state").at("+3s").fields["n"] == 3
    finally:
        path.write_bytes(whole)
    assert many.topic("/state").at("end").fields["n"] == 199


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
