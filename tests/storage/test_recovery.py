"""What a recovery says of itself, to the byte."""

from __future__ import annotations

from pathlib import Path

import pytest

from hybridlog_storage.segments.recovery import recover_segment
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.storage.test_segments import many, write


@pytest.mark.parametrize("torn", [0, 1, 9, 37])
def test_the_bytes_that_are_cut_are_told(tmp_path: Path, torn: int) -> None:
    (path,), chunks = write(tmp_path / "a", [many(30)], SegmentSettings(chunk_size=1024))
    opened = tmp_path / "000000.mcap.open"
    opened.write_bytes(path.read_bytes()[: chunks[-1].offset + torn])
    recovered = recover_segment(opened)
    assert recovered.cut_bytes == torn
    assert recovered.path is not None
    with SegmentReader(recovered.path, 0) as reader:
        assert reader.summary().end["cut_bytes"] == torn


def test_all_bytes_of_a_segment_without_a_whole_head_are_cut(tmp_path: Path) -> None:
    (path,), _ = write(tmp_path / "a", [many(3)])
    opened = tmp_path / "000000.mcap.open"
    opened.write_bytes(path.read_bytes()[:50])
    recovered = recover_segment(opened)
    assert (recovered.path, recovered.cut_bytes) == (None, 50)
