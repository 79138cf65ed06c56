"""A catalog that somebody changed: nothing wrong is said, and nobody has to ask for the cure."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog_storage.catalog_parts import ENTRY, SUMMARY, PartContent
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mongo.mongod import EmbeddedMongod
from hybridlog_storage.segments.segment_writer import SegmentSettings
from hybridlog_storage.settings import read_settings
from tests.indexed import documents_of
from tests.storage.chunk_entries import chunk_entries
from tests.test_model import drafts_of, write_mcap

pytestmark = pytest.mark.mongo("embedded")

Row = dict[str, str]


def without(kind: str) -> Callable[[Row], None]:
    """Removes the texts of a kind."""

    def change(row: Row) -> None:
        for name in [name for name in row if name.startswith(kind)]:
            del row[name]

    return change


CHANGES: dict[str, Callable[[Row], None]] = {
    "files": lambda row: row.update({ENTRY: json.dumps(["x", json.loads(row[ENTRY])[1]])}),
    "entry": without(ENTRY),
    "summary": without(SUMMARY),
    "recording": dict.clear,
}
"""Changes of rows whose checksums are right; a question that needs them notices."""
Told = dict[str, Any]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two recordings with messages that cannot be read; one has a damaged chunk."""
    base = tmp_path_factory.mktemp("by-hand")
    path = base / "store"
    # Held throughout, so that not each opening has to start it.
    with hl.open(path, create=True) as opened, EmbeddedMongod(path / "mongod") as mongod:
        mongod.start()
        for seed in (5, 6):
            write_mcap(base / f"log{seed}.mcap", drafts_of(seed, 80))
            opened.record(base / f"log{seed}.mcap", settings=SegmentSettings(chunk_size=2048))
        entry = opened.entry("log6")
        chunk = chunk_entries(opened.catalog, entry)[2]
        segment = opened.directory.recording("log6") / "000000.mcap"
        content = bytearray(segment.read_bytes())
        content[chunk.offset + chunk.length - 1] ^= 1
        segment.write_bytes(content)
        opened.index.rebuild()
        opened.close()
        yield path


@pytest.fixture(scope="module")
def want(store: Path) -> Told:
    told = tell(store)
    statuses = {entry["label"]: entry["status"] for entry in told["entries"]}
    assert statuses == {"log5": "complete", "log6": "damaged"}
    assert told["damaged"] > 0
    for entry in told["entries"]:
        for name in ("unreadable", "stamped"):
            assert sum(channel["stats"][name] for channel in entry["channels"])
    assert {recording for recording, _ in found(store)} == {"log6"}
    return told


def tell(store: Path) -> Told:
    """What a store says, asked in different ways."""
    with hl.open(store, require_database=True) as opened:
        topics = opened.topics()
        whole = opened.query(topics, ["log5"])
        told: Told = {
            "entries": [entry.to_document() for entry in opened.recordings()],
            "messages": [(m.topic, m.seq, m.log_time_ns, m.raw) for m in whole],
            "decoded": [m.fields for m in opened.query(["/a__b"], ["log5"])],
            "count": {t: opened.query([t]).count() for t in topics},
            "where": {t: opened.query([t]).where("number >= 0").count() for t in topics},
            "stamps": sorted(
                d["header"]["stamp"] for d in documents_of(opened, "/twin") if "header" in d
            ),
            "damaged": 0,
        }
        try:
            list(opened.query(topics, ["log6"]))
        except SegmentError:
            told["damaged"] = 1
        return told


def found(store: Path) -> list[tuple[str, str]]:
    """What `verify` finds: label and place."""
    with hl.open(store, require_database=True) as opened:
        findings = opened.verify().findings
    return sorted((f.recording, f.place) for f in findings)


@pytest.fixture
def kept(store: Path, want: Told) -> Iterator[Path]:
    """The only part of the catalog, which is as before afterwards."""
    (part,) = (store / "catalog").glob("part-*")
    before = part.read_bytes()
    yield part
    shutil.rmtree(part.parent)
    part.parent.mkdir()
    part.write_bytes(before)


@pytest.mark.parametrize("name", CHANGES)
def test_a_row_that_was_changed_is_made_again(
    store: Path, kept: Path, want: Told, name: str
) -> None:
    findings = found(store)
    store_id = read_settings(store).store_id
    content = PartContent.from_bytes(store_id, kept.read_bytes())
    for row in content.rows.values():
        CHANGES[name](row)
    kept.write_bytes(content.to_bytes(store_id))
    # What only decoding tells is found out at the next opening after it was missed.
    assert tell(store) == want
    assert tell(store) == want
    assert found(store) == findings


def test_a_line_that_was_lost_is_made_again(store: Path, kept: Path, want: Told) -> None:
    findings = found(store)
    content = kept.read_bytes()
    lines = content.splitlines(keepends=True)
    assert len(lines) > 5
    for number in range(len(lines)):
        begin = sum(map(len, lines[:number]))
        middle = begin + len(lines[number]) // 2
        without = content[:begin] + content[begin + len(lines[number]) :]
        altered = content[:middle] + b"x" + content[middle + 1 :]
        kept.write_bytes(altered if number % 2 else without)
        assert tell(store) == want, number
        if found(store) != findings:
            # No question has needed it; who reads everything is told, and of the cure.
            with hl.open(store) as opened:
                assert [f.place for f in opened.verify().findings if f.place == "catalog"]
                opened.verify(repair=True)
            assert found(store) == findings, number


@pytest.mark.parametrize("how", ["gone", "empty", "cut", "other file", "directory's journal"])
def test_a_file_that_is_no_catalog_is_made_again(
    store: Path, kept: Path, want: Told, how: str
) -> None:
    findings = found(store)
    if how == "gone":
        kept.unlink()
    elif how == "directory's journal":
        shutil.copy(store / "recordings" / "log5" / "journal", kept)
    else:
        content = kept.read_bytes()
        kept.write_bytes({"empty": b"", "cut": content[: len(content) // 2]}.get(how, b"x" * 9999))
    assert tell(store) == want
    assert found(store) == findings
