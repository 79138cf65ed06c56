"""Counts by time alone: what chunks are known to hold, and their indexes."""

from __future__ import annotations

from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.errors import SegmentError
from tests import places
from tests.query.conftest import AWAY

pytestmark = pytest.mark.mongo


def segment_of(store: hl.Store) -> Path:
    return places.segment(store.directory.path, "a")


def test_a_count_by_time_reads_indexes_at_its_ends_only(many: hl.Store) -> None:
    query = many.topic("/state").between("+5s", "+165s")
    assert query.count() == 160
    assert query.counters.documents_read == query.counters.chunks_read == 0
    assert 0 < query.counters.bytes_read < 1000


@pytest.mark.parametrize("damage", ["time", "place", "length", "opcode", "arrivals"])
def test_a_damaged_message_index_is_not_believed(many: hl.Store, damage: str) -> None:
    """Whether or not what it says could be: its chunk is damaged with it, and that is said."""
    path = segment_of(many)
    whole = path.read_bytes()
    chunk = many.session.chunks(
        many.recordings()[0], [many.recordings()[0].channels[0].id], None, "log"
    )[0]
    index = chunk.place.offset + chunk.place.length
    entry = 9 + 6 + 16  # the second one: record head, channel, length, the first one
    at = {
        "opcode": 0,
        "length": 2,
        "time": entry,
        "place": entry + 8,
        "arrivals": chunk.place.trailer - 1,
    }[damage]
    damaged = bytearray(whole)
    damaged[index + at] ^= 1
    path.write_bytes(damaged)
    try:
        with hl.open(many.directory.path, mongo=AWAY) as alone:
            query = alone.topic("/state").between("+5s", "+165s")
            said = pytest.raises(SegmentError, match=f"{chunk.place.offset} of .*{path.name}")
            if damage == "arrivals":
                assert query.count() == 160  # messages have a checksum of their own
            else:
                with said:
                    query.count()
            with said:
                list(query)
            # Within one range the chunk is not looked at.
            assert alone.topic("/state").between("+20s", "+165s").count() == 145
    finally:
        path.write_bytes(whole)
