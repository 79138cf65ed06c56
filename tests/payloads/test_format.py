"""Compacted recordings by the second reader, which is written from the specification."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.errors import HybridlogError
from tests.format_reader import FormatReader, Recording
from tests.payloads.logs import BASE, CLOUD, COUNT, SETTINGS, XYZ, cloud, robot, write_log


@pytest.fixture(scope="module")
def compacted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store whose scans and clouds are only columns; of one cloud the padding is not zero."""
    path = tmp_path_factory.mktemp("format")
    data = bytes(range(1, 61))
    said = [*robot(), ("/cloud", CLOUD, BASE + COUNT * 10**9, cloud(XYZ, 20, data))]
    log = write_log(path / "log.mcap", said)
    with hl.open(path / "store", create=True) as store:
        store.record(log, name="log", settings=SETTINGS)
        store.compact(drop_mcap=True)
        store.mark("log", "+1s", "a segment after the end")
    shutil.rmtree(path / "store" / "mongod", ignore_errors=True)
    return path / "store"


@pytest.fixture
def copy(compacted: Path, tmp_path: Path) -> Path:
    hidden = shutil.ignore_patterns("catalog*", "tables*")
    shutil.copytree(compacted, tmp_path / "store", ignore=hidden)
    return tmp_path / "store"


def both(store: Path) -> tuple[Recording, RecordingEntry, list[Any]]:
    """The recording as the second reader tells it, its entry, and its messages that are there."""
    recording = FormatReader(store).recording("log")
    with hl.open(store) as opened:
        (entry,) = opened.recordings()
        found = [
            (m.seq, m.topic, m.log_time_ns, m.publish_time_ns, m.sequence, m.raw)
            for m in opened.topic(*({"/number", "/image"} if recording.damage else {"**"}))
        ]
    return recording, entry, sorted(found)


def told(recording: Recording, topics: set[str] | None = None) -> list[Any]:
    return sorted(
        (m.seq, m.topic, m.log_time, m.publish_time, m.sequence, m.payload)
        for _, m in recording.messages()
        if topics is None or m.topic in topics
    )


def test_moved_chunks_are_read_from_columns(copy: Path) -> None:
    recording, entry, messages = both(copy)
    moved = [s.is_moved(n) for s in recording.segments.values() for n in range(len(s.chunks))]
    assert any(moved)
    assert not all(moved)
    assert not recording.damage
    assert told(recording) == messages
    assert (recording.status, recording.losses) == (entry.status, []) == ("complete", [])


def test_segments_name_their_columns(copy: Path) -> None:
    """Without a journal nothing is lost."""
    (copy / "recordings/log/journal").unlink()
    recording, entry, messages = both(copy)
    assert told(recording) == messages
    assert len(messages) > 3 * COUNT
    assert entry.status == "unproven"


def test_missing_columns_are_in_the_ledger(copy: Path) -> None:
    (file,) = (copy / "recordings/log/payloads/topic=scan").iterdir()
    file.unlink()
    recording, entry, messages = both(copy)
    assert told(recording, {"/number", "/image"}) == messages
    assert (recording.status, entry.status) == ("damaged", "damaged")
    (row,) = recording.losses
    (ours,) = entry.end["losses"]
    assert row.items() <= ours.items()
    assert (row["topic"], row["count"]) == ("/scan", COUNT)


def test_no_wrong_byte_of_columns_is_read(copy: Path) -> None:
    (file,) = (copy / "recordings/log/payloads/topic=scan").iterdir()
    whole = file.read_bytes()
    for place in range(100, len(whole) - 1, len(whole) // 3):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert FormatReader(copy).recording("log").damage
        with hl.open(copy) as store, pytest.raises(HybridlogError):
            list(store.topic("scan"))
