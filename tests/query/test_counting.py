"""Statistics of arrays that tables have in several forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog_storage.errors import WhereError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.query.test_intervals import BASE


@pytest.mark.mongo
def test_statistics_of_arrays_of_which_some_have_only_a_summary(tmp_path: Path) -> None:
    """Short arrays stand in the table with their elements, long ones with a summary."""
    channel = Channel("/a", "ros1", Schema("t/A", "ros1msg", b"float32[] r\n"))
    settings = SegmentSettings(segment_size=1 << 16, chunk_size=1 << 12)
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("x", settings=settings) as recording:
            for n in range(6000):
                size = 3 if n < 3000 else 40
                numbers = np.arange(n, n + size, dtype=np.float32).tobytes()
                recording.write(
                    channel, size.to_bytes(4, "little") + numbers, log_time=BASE + n * 10**6
                )
        table = store.session.table(store.recordings()[0], "/a")
        assert table is not None
        for file in table.files:
            kinds = [str(file.schema.field(name).type)[:4] for name in ("r", "r_summary")]
            assert kinds == ["list", "stru"]
        for where, count in {
            "r.min < 10": 10,
            "r.min >= 2990": 3010,
            "r.n == 3": 3000,
            "not r.max < 3100": 6000 - 3061,
            "r.mean == 11": 1,
        }.items():
            query = store.topic("/a").where(where)
            assert query.count() == count, where
            assert query.counters.chunks_read == 0
        changes = {"r.n": [3000], "r.min": [*range(1, 6000)]}
        for field, expected in changes.items():
            found = store.topic("/a").changes(field, pause=0)
            assert [(one.begin_ns - BASE) // 10**6 for one in found] == expected
        late = store.topic("/a").between(BASE + 3000 * 10**6, None).changes("r.n", pause=0)
        assert len(late) == 1  # compared with the message before the range


def test_elements_of_an_array_that_has_two_lengths(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        for size in (9, 3):
            kind = Schema("t/A", "ros1msg", f"float32[{size}] box\n".encode())
            with store.start(f"of {size}") as recording:
                recording.write(Channel("/a", "ros1", kind), np.ones(size, np.float32).tobytes())
        assert store.topic("/a").where("box[7] > 0").count() == 1
        with pytest.raises(WhereError, match="3 elements"):
            store.topic("/a").in_recording("of 3").where("box[7] > 0")
