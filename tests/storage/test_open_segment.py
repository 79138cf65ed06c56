"""A segment that is being written, read again and again: what its summary will say of it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from mcap.records import Metadata
from msgspec.structs import asdict

from hybridlog_storage.mcap.mcap_content import RECORD_HEAD
from hybridlog_storage.segments import walk
from hybridlog_storage.segments.segment_format import Attachment, FilePart, losses_record
from hybridlog_storage.segments.segment_reader import SegmentReader, SegmentSummary
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings
from hybridlog_storage.segments.walk import Walk
from tests.storage.test_segments import CHANNELS, LOSS, RECORDING, Row, batch_of


class Written:
    """A segment with six chunks, and records of all kinds between them.

    Attributes:
        data: Its bytes.
        summary: Its summary.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        settings = SegmentSettings(chunk_size=1 << 20, compression="none", sync="never")
        writer = RecordingWriter(folder, RECORDING, settings, is_latched=lambda _: True)
        for chunk in range(6):
            rows: list[Row] = [
                (n % 2 + chunk // 4, b"%d" % n * (n % 7), 1000 * chunk + 90 - 10 * n, n, n)
                for n in range(9)
            ]
            writer.append(batch_of(rows), CHANNELS)
            writer.flush()
            if chunk == 1:
                writer.add_extra(Metadata(name="calibration", metadata={"a": "b"}))
                writer.add_extra(losses_record([LOSS]))
            if chunk == 2:
                content = FilePart(lambda at, size: (b"content" * 100)[at : at + size], 0, 700)
                writer.add_extra(Attachment(1, 2, "a.txt", "text/plain", content))
        (path,) = writer.close()
        self.data = path.read_bytes()
        with SegmentReader(path, 0) as reader:
            self.summary: SegmentSummary = reader.summary()
        assert len(self.summary.chunks) == 6


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    return Written(tmp_path_factory.mktemp("open") / "r")


def check(segment: Walk, summary: SegmentSummary) -> None:
    """Compare what was read with what the summary says."""
    table, attachments, metadata, _ = segment.flushed
    assert table.chunks.tolist() == summary.table.chunks.tolist()
    assert table.parts.tolist() == summary.table.parts.tolist()
    for found, wanted in ((attachments, summary.attachments), (metadata, summary.metadata)):
        assert [(one.offset, one.length, one.name) for one in found] == [
            (one.offset, one.length, one.name) for one in wanted
        ]
    assert segment.losses == list(summary.losses)
    assert {n: asdict(channel) for n, channel in segment.channels.items()} == {
        n: asdict(channel) for n, channel in summary.channels.items()
    }


@pytest.mark.parametrize("step", [61, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_a_part_of_a_write_is_no_damage(
    written: Written, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """A read beside a write sees zeros in place of the rest, wherever the write is by then."""
    path = tmp_path / "000000.mcap.open"
    waits: list[float] = []

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        path.write_bytes(written.data)

    monkeypatch.setattr(walk, "time", SimpleNamespace(sleep=sleep))
    for seen in range(8, len(written.data), step):
        path.write_bytes(written.data[:seen].ljust(len(written.data), b"\0"))
        segment = Walk.opened(tmp_path, 0)
        segment.follow()
        path.write_bytes(written.data)
        segment.follow()
        assert not segment.damaged, seen
        check(segment, written.summary)
    assert waits


def test_damage_behind_a_chunk_costs_no_other(
    written: Written, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(walk, "time", SimpleNamespace(sleep=lambda _: None))
    chunks = written.summary.table.chunks
    at, length, trailer, *_ = chunks[1].tolist()
    path = tmp_path / "000000.mcap.open"
    heads, end = [], at + length
    while end < at + length + trailer:
        heads.append(end)
        end += RECORD_HEAD.size + RECORD_HEAD.unpack_from(written.data, end)[1]
    for place in (head + n for head in heads for n in range(RECORD_HEAD.size)):
        for bit in (1 << n for n in range(8)):
            data = bytearray(written.data)
            data[place] ^= bit
            path.write_bytes(data)
            segment = Walk.opened(tmp_path, 0)
            segment.follow()
            found = {row[0] for row in segment.flushed.table.chunks.tolist()}
            lost = {row[0] for row in chunks.tolist()} - found
            assert lost <= {at}, (place, bit)
            assert segment.damaged or not lost
