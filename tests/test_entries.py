"""What a recording's files say of it, held against its journal: without any server."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.entries import (
    Inventory,
    describe_now,
    journal_from_segments,
    new_id,
    read_summary,
    recording_metadata,
    sealed_event,
    sealed_line,
    take_inventory,
    text,
)
from hybridlog.maintenance.opening import StoreFiles
from hybridlog.maintenance.report import RepairReport
from hybridlog_storage import journal
from hybridlog_storage.catalog import CATALOG, Catalog, RecordingEntry
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.errors import CatalogError, SegmentError, StoreError
from hybridlog_storage.journal import JOURNAL, Journal
from hybridlog_storage.messages import Batch, Channel, Schema
from hybridlog_storage.segments.segment_format import END_METADATA, LOSSES_METADATA, json_metadata
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings
from tests.limits import Limit

TEXT = Schema("std_msgs/String", "ros1msg", b"string data\n")
TOPICS = [Channel(topic, "ros1", TEXT) for topic in ("/a", "/b", "/c")]
SECOND = 10**9
PER_SEGMENT = 20
LOSS = {
    "cause": "queue", "count": 3, "file": "", "from": 5, "length": None, "offset": None,
    "reason": "", "to": 6, "topic": "/a",
}  # fmt: skip


def payload(number: int) -> bytes:
    return (4).to_bytes(4, "little") + b"%04d" % number


def batch(numbers: range) -> Batch:
    data = b"".join(map(payload, numbers))
    count = len(numbers)
    times = np.array(numbers, np.int64) * SECOND
    return Batch(
        data,
        np.arange(count) * 8,
        np.full(count, 8),
        np.array([n % 3 for n in numbers], np.int32),
        times,
        times,
        np.array(numbers, np.uint32),
    )


class Made:
    """A recording of four segments, of 20 messages each, on three topics."""

    def __init__(self, directory: StoreDirectory, name: str = "run", segments: int = 4) -> None:
        self.directory = directory
        self.label = directory.new_recording(name)
        self.path = directory.recording(self.label)
        self.id = new_id()
        self.said = {
            "id": self.id,
            "name": name,
            "tags": {"place": "lab"},
            "source": {"path": "/x", "kind": "test", "bytes": 5},
            "created": 77,
        }
        self.journal = Journal(self.path, sync=False)
        self.journal.append(
            journal.event(
                journal.BEGUN, store=directory.settings.store_id, origin={"host": "h"}, **self.said
            )
        )
        self.end: dict[str, Any] | None = None
        writer = RecordingWriter(
            self.path,
            self.said,
            lambda *_: None,
            SegmentSettings(chunk_size=1 << 10, sync="never", segment_size=1),
            on_sealing=self._announce,
        )
        for number in range(segments):
            if number == segments - 1:  # what says how it ended lies in the same segment
                writer.settings = replace(writer.settings, segment_size=1 << 30)
            writer.append(batch(range(PER_SEGMENT * number, PER_SEGMENT * (number + 1))), TOPICS)
            writer.flush()
            if number == 1:
                writer.add_extra(json_metadata(LOSSES_METADATA, {"rows": [LOSS]}))
        self.end = {"status": "complete", "losses": []}
        writer.close(json_metadata(END_METADATA, self.end))
        self.segments = [path for _, path in directory.segments(self.label)]
        assert len(self.segments) == segments

    def _announce(self, sealed: Any) -> None:
        lines = [sealed_event(sealed)]
        if self.end is not None:
            lines.append(journal.event(journal.ENDED, end=self.end))
        self.journal.append(*lines)

    def inventory(self) -> Inventory:
        return take_inventory(self.directory, self.label)

    def entry(self, *, is_open: bool = False) -> RecordingEntry:
        with closing(Catalog(Path("/nowhere"), "x", in_memory=True)) as catalog:
            return describe_now(self.directory, catalog, self.label, is_open=is_open).entry

    def lines(self) -> list[bytes]:
        return (self.path / JOURNAL).read_bytes().splitlines(keepends=True)

    def keep_lines(self, keep: Callable[[Mapping[str, Any]], bool]) -> None:
        kept = [line for line in self.lines() if keep(json.loads(line[9:]))]
        (self.path / JOURNAL).write_bytes(b"".join(kept))


@pytest.fixture
def directory(tmp_path: Path) -> StoreDirectory:
    return StoreDirectory.create(tmp_path / "store")


@pytest.fixture
def made(directory: StoreDirectory) -> Made:
    return Made(directory)


def by_topic(*segments: int) -> Counter[str]:
    """Messages of some segments."""
    return Counter(
        TOPICS[n % 3].topic
        for segment in segments
        for n in range(PER_SEGMENT * segment, PER_SEGMENT * (segment + 1))
    )


def lost(entry: RecordingEntry) -> Counter[str]:
    """Messages that the ledger says were in segments, by topic."""
    found: Counter[str] = Counter()
    for row in entry.end.get("losses", ()):
        if row["cause"] == "segment":
            found[row["topic"]] += row["count"]
    return found


def kept(entry: RecordingEntry) -> Counter[str]:
    return Counter({c.topic: c.stats.messages for c in entry.channels if c.stats.messages})


def check(entry: RecordingEntry, *missing: int) -> None:
    """That the entry says just what is there, and what is not."""
    there = [n for n in range(4) if n not in missing]
    assert kept(entry) == by_topic(*there)
    assert lost(entry) == by_topic(*missing)
    assert entry.status == ("damaged" if missing else "complete")
    assert entry.segments == len(there)
    assert [number for number, _, _ in entry.spans] == there
    assert entry.digests.keys() == set(map(str, there))
    rows = [row for row in entry.end["losses"] if row["cause"] == "segment"]
    for row in rows:
        number = int(row["file"].removesuffix(".mcap"))
        assert number in missing
        own = [
            n for n in range(PER_SEGMENT * number, PER_SEGMENT * (number + 1))
            if TOPICS[n % 3].topic == row["topic"]
        ]  # fmt: skip
        assert (row["from"], row["to"], row["count"]) == (
            own[0] * SECOND, own[-1] * SECOND, len(own),
        )  # fmt: skip


# What is whole.


def test_a_whole_recording(made: Made) -> None:
    inventory = made.inventory()
    assert (inventory.id, inventory.misfits, inventory.lost) == (made.id, [], [])
    assert inventory.is_proven
    assert inventory.end == {"status": "complete", "losses": []}
    entry = made.entry()
    check(entry)
    # What is noted within a segment is in the ledger.
    assert entry.end["losses"] == [LOSS]
    assert entry.stored_bytes == sum(path.stat().st_size for path in made.segments)
    assert entry.span == (0, 79 * SECOND)
    assert [(c.topic, c.stats.payload_bytes) for c in entry.channels] == [
        (topic, 8 * count) for topic, count in sorted(by_topic(0, 1, 2, 3).items())
    ]
    assert (entry.id, entry.label, entry.name) == (made.id, made.label, "run")
    assert (entry.tags, entry.created, entry.key) == ({"place": "lab"}, 77, made.id[:16])
    assert recording_metadata(entry) == made.said
    assert entry.chunks == sum(
        len(read_summary(path, number).table.chunks) for number, path in enumerate(made.segments)
    )


def test_what_was_written_about_it_counts(made: Made) -> None:
    made.journal.append(
        journal.event(journal.RENAMED, name="other"),
        journal.event(journal.TAGGED, key="who", value="me"),
        journal.event(journal.UNTAGGED, key="place"),
        journal.event(journal.NOTED, text="x"),
    )
    entry = made.entry()
    assert (entry.name, entry.tags, entry.label) == ("other", {"who": "me"}, made.label)
    assert [note["text"] for note in entry.notes] == ["x"]
    check(entry)


def test_while_it_is_written_it_is_open(made: Made) -> None:
    # Whoever holds one that has ended does something else with it.
    assert made.entry(is_open=True).status == "complete"
    made.segments[3].rename(made.path / "000003.mcap.open")
    entry = made.entry(is_open=True)
    # One that is listed and has its old name is about to get the new one: it is not lost.
    assert (entry.status, entry.segments, lost(entry)) == ("open", 3, Counter())
    assert made.entry().status == "unfinished"


def test_one_that_a_crash_ended(made: Made) -> None:
    made.keep_lines(lambda line: line["event"] != journal.ENDED)
    made.segments[3].unlink()
    made.keep_lines(lambda line: line.get("segment") != 3)
    entry = made.entry()
    assert entry.status == "recovered"
    assert made.entry(is_open=True).status == "open"
    assert kept(entry) == by_topic(0, 1, 2)
    assert lost(entry) == Counter()


@pytest.mark.parametrize("status", ["complete", "recovered", "damaged"])
def test_how_it_ended_says_the_journal_or_else_the_last_segment(made: Made, status: str) -> None:
    made.keep_lines(lambda line: line["event"] != journal.ENDED)
    assert made.entry().status == "complete"
    made.journal.append(journal.event(journal.ENDED, end={"status": status}))
    assert made.entry().status == status


# Segments that are not what they should be.


@pytest.mark.parametrize("number", range(4))
def test_a_missing_segment(made: Made, number: int) -> None:
    made.segments[number].unlink()
    inventory = made.inventory()
    assert not inventory.is_proven
    assert [(m.segment, m.file, m.belongs) for m in inventory.misfits] == [(number, "", None)]
    assert "missing" in inventory.misfits[0].reason
    check(made.entry(), number)


@pytest.mark.parametrize(("one", "other"), [(0, 1), (0, 3), (2, 3)])
def test_two_that_were_exchanged(made: Made, one: int, other: int) -> None:
    first, second = made.segments[one], made.segments[other]
    first.rename(made.path / "x")
    second.rename(first)
    (made.path / "x").rename(second)
    inventory = made.inventory()
    assert [(m.segment, m.belongs) for m in inventory.misfits] == [(one, other), (other, one)]
    assert all("of this recording" in m.reason for m in inventory.misfits)
    check(made.entry(), one, other)


@pytest.mark.parametrize(("copied", "over"), [(0, 1), (0, 3), (3, 0), (1, 2)])
def test_one_that_lies_there_twice(made: Made, copied: int, over: int) -> None:
    shutil.copy(made.segments[copied], made.segments[over])
    inventory = made.inventory()
    assert [(m.segment, m.belongs) for m in inventory.misfits] == [(over, copied)]
    check(made.entry(), over)


def test_one_that_lies_there_twice_under_a_number_of_its_own(made: Made) -> None:
    shutil.copy(made.segments[1], made.path / "000007.mcap")
    (misfit,) = made.inventory().misfits
    assert (misfit.segment, misfit.file, misfit.belongs) == (7, "000007.mcap", 1)
    assert not misfit.is_unlisted
    # Nothing is counted twice, and nothing is lost.
    check(made.entry())


@pytest.mark.parametrize("number", [0, 2, 3])
def test_one_of_another_recording(made: Made, directory: StoreDirectory, number: int) -> None:
    other = Made(directory, "other")
    shutil.copy(other.segments[number], made.segments[number])
    (misfit,) = made.inventory().misfits
    assert other.id in misfit.reason
    assert (misfit.segment, misfit.belongs) == (number, None)
    check(made.entry(), number)


def test_one_of_another_recording_under_a_number_of_its_own(
    made: Made, directory: StoreDirectory
) -> None:
    other = Made(directory, "other", segments=5)
    shutil.copy(other.segments[4], made.path / "000004.mcap")
    (misfit,) = made.inventory().misfits
    assert (misfit.segment, misfit.is_unlisted) == (4, False)
    check(made.entry())


@pytest.mark.parametrize("number", [0, 3])
def test_an_older_one(made: Made, tmp_path: Path, number: int) -> None:
    """Whole, of this recording and of this number, and not what the journal lists."""
    old = tmp_path / "old"
    old.mkdir()
    writer = RecordingWriter(
        old, made.said, lambda *_: None, SegmentSettings(segment_size=1, sync="never")
    )
    for n in range(number + 1):
        writer.append(batch(range(PER_SEGMENT * n, PER_SEGMENT * n + 5)), TOPICS)
        writer.flush()
    writer.close()
    shutil.copy(old / f"{number:06d}.mcap", made.segments[number])
    (misfit,) = made.inventory().misfits
    assert misfit.segment == number
    assert "older" in misfit.reason
    check(made.entry(), number)


@pytest.mark.parametrize("number", [0, 2, 3])
@pytest.mark.parametrize("left", [0, 1, 100, -200, -1])
def test_a_cut_one(made: Made, number: int, left: int) -> None:
    size = made.segments[number].stat().st_size
    os.truncate(made.segments[number], left if left >= 0 else size + left)
    (misfit,) = made.inventory().misfits
    assert (misfit.segment, misfit.file) == (number, f"{number:06d}.mcap")
    check(made.entry(), number)


@pytest.mark.parametrize("number", [0, 3])
def test_one_that_grew(made: Made, number: int) -> None:
    with made.segments[number].open("ab") as file:
        file.write(b"\0")
    assert [m.segment for m in made.inventory().misfits] == [number]
    check(made.entry(), number)


@pytest.mark.parametrize("number", [0, 3])
def test_a_symlink_is_no_segment(made: Made, tmp_path: Path, number: int) -> None:
    made.segments[number].rename(tmp_path / "elsewhere")
    made.segments[number].symlink_to(tmp_path / "elsewhere")
    check(made.entry(), number)


def test_any_flipped_bit_of_a_summary_costs_that_segment(made: Made) -> None:
    """Or nothing at all: no other answer comes of it."""
    path = made.segments[3]
    whole = path.read_bytes()
    end = read_summary(path, 3).table.end
    for at in range(end, len(whole), 7):
        data = bytearray(whole)
        data[at] ^= 1 << at % 8
        path.write_bytes(data)
        check(made.entry(), 3)


# Journals that are not what they should be.


def test_a_lost_journal_is_told_even_after_it_was_written_again(made: Made) -> None:
    (made.path / JOURNAL).unlink()
    lines = journal_from_segments(made.inventory(), "5" * 32, "it was not there")
    made.journal.replace(lines)
    inventory = made.inventory()
    assert inventory.state is not None
    assert inventory.state.sealed.keys() == {0, 1, 2, 3}
    assert (inventory.misfits, inventory.lost, inventory.is_proven) == ([], [], False)
    assert made.entry().status == "unproven"
    # From here on it is watched over again.
    made.segments[3].unlink()
    entry = made.entry()
    assert entry.status == "damaged"
    assert lost(entry) == by_topic(3)


def test_without_a_journal_most_segments_say_what_recording_it_is(
    made: Made, directory: StoreDirectory
) -> None:
    other = Made(directory, "other")
    shutil.copy(other.segments[0], made.segments[0])
    (made.path / JOURNAL).unlink()
    entry = made.entry()
    assert entry.id == made.id
    assert entry.status == "unproven"
    assert kept(entry) == by_topic(1, 2, 3)


@pytest.mark.parametrize("number", range(6))
def test_a_damaged_line(made: Made, number: int) -> None:
    """Whichever it is: no answer is another, and it is told."""
    before = made.entry()
    lines = made.lines()
    assert len(lines) == 6
    data = bytearray(lines[number])
    data[20] ^= 1
    (made.path / JOURNAL).write_bytes(
        b"".join([*lines[:number], bytes(data), *lines[number + 1 :]])
    )
    inventory = made.inventory()
    assert inventory.state is not None
    assert inventory.state.damaged == [number + 1]
    assert (inventory.id, inventory.is_proven) == (made.id, False)
    assert made.entry() == replace(before, status="unproven")
    # What the other lines list is watched over all the same.
    for segment in range(4):
        if number != segment + 1:
            aside = made.segments[segment].rename(made.path / "aside")
            entry = made.entry()
            assert entry.status == "damaged"
            assert lost(entry) == by_topic(segment)
            aside.rename(made.segments[segment])


def test_a_journal_that_is_written_again_keeps_what_can_be_read(made: Made) -> None:
    made.journal.append(
        journal.event(journal.RENAMED, name="other"),
        journal.event(journal.TAGGED, key="who", value="me"),
        journal.event(journal.NOTED, text="x") | {"at": 5},
    )
    made.segments[2].unlink()
    before = made.entry()
    lines = made.lines()
    # The lines of a segment that is there, and of how it ended.
    (made.path / JOURNAL).write_bytes(
        b"".join([*lines[:1], b"damaged\n", *lines[2:5], b"x\n", *lines[6:]])
    )
    again = journal_from_segments(made.inventory(), made.directory.settings.store_id, "damaged")
    made.journal.replace(again)
    state = made.inventory().state
    assert state is not None
    assert (state.damaged, state.rebuilt) == ([], "damaged")
    assert state.begun["origin"] == {"host": "h"}
    assert state.sealed.keys() == {0, 1, 2, 3}
    entry = made.entry()
    # What is missing does not come back because the journal was written again.
    assert entry == before
    assert entry.status == "damaged"
    assert lost(entry) == by_topic(2)


def test_a_segment_that_the_journal_does_not_list(made: Made) -> None:
    before = made.entry()
    made.keep_lines(lambda line: line.get("segment") != 1)
    inventory = made.inventory()
    (misfit,) = inventory.misfits
    assert (misfit.segment, misfit.is_unlisted, misfit.belongs) == (1, True, None)
    assert (inventory.lost, inventory.is_proven) == ([], False)
    # It answers, and nobody can say that there was not another one.
    assert made.entry() == replace(before, status="unproven")
    made.journal.append(sealed_line(inventory, 1))
    assert made.inventory().is_proven
    assert made.entry() == before


def test_what_a_crash_took_of_a_listed_segment(made: Made) -> None:
    """It was listed with all its messages, and came out of the crash with fewer."""
    before = made.inventory()
    assert before.state is not None
    listed = before.state.sealed[3]
    more = [
        {**c, "messages": c["messages"] + (10 if c["topic"] != "/c" else 0)}
        for c in listed.channels
    ]
    extra = {"id": 9, "topic": "/d", "messages": 2, "payload_bytes": 5, "first": 7, "last": 8}
    fuller = journal.event(
        journal.SEALED, segment=3, file=listed.file, bytes=9, digest="sha256:of more",
        channels=[*more, extra],
    )  # fmt: skip
    made.keep_lines(lambda line: line.get("segment") != 3)
    made.journal.append(fuller, sealed_line(before, 3))
    inventory = made.inventory()
    assert inventory.misfits == []
    entry = made.entry()
    assert entry.status == "damaged"
    assert kept(entry) == by_topic(0, 1, 2, 3)
    assert lost(entry) == Counter({"/a": 10, "/b": 10, "/d": 2})
    # Also when the journal is written again.
    made.journal.replace(journal_from_segments(inventory, "5" * 32, "x"))
    assert lost(made.entry()) == Counter({"/a": 10, "/b": 10, "/d": 2})


def test_a_lost_segment_of_which_nothing_is_known_is_a_row_all_the_same(made: Made) -> None:
    made.journal.append(
        journal.event(
            journal.SEALED, segment=4, file="000004.mcap", bytes=9, digest="sha256:x", channels=[]
        )
    )
    entry = made.entry()
    assert entry.status == "damaged"
    (row,) = [r for r in entry.end["losses"] if r["cause"] == "segment"]
    assert (row["file"], row["count"], row["topic"]) == ("000004.mcap", 0, None)


# Chunks that cannot be read.


def test_chunks_that_cannot_be_read_are_lost_by_topic(made: Made) -> None:
    summary = read_summary(made.segments[2], 2)
    chunk, bounds = summary.table.chunks[0], summary.table.part_bounds()
    parts = summary.table.parts[bounds[0] : bounds[1]]
    with closing(Catalog(Path("/nowhere"), "x", in_memory=True)) as catalog:
        catalog.put_damage(made.id, {(2, 0): "its checksum differs", (2, 99): "x", (9, 0): "y"})
        entry = describe_now(made.directory, catalog, made.label).entry
    assert entry.status == "damaged"
    rows = [row for row in entry.end["losses"] if row["cause"] == "segment"]
    assert {row["file"] for row in rows} == {"000002.mcap"}
    assert {row["reason"] for row in rows} == {"its checksum differs"}
    assert {(row["offset"], row["length"]) for row in rows} == {
        (int(chunk["offset"]), int(chunk["length"]))
    }
    assert lost(entry) == Counter(
        {summary.channels[int(p["channel"])].topic: int(p["messages"]) for p in parts}
    )


# What is no recording.


def test_nothing_says_what_recording_it_is(directory: StoreDirectory) -> None:
    label = directory.new_recording("x")
    (directory.recording(label) / "000000.mcap").write_bytes(b"nothing")
    with closing(Catalog(Path("/nowhere"), "x", in_memory=True)) as catalog:
        with pytest.raises(SegmentError, match="neither a journal nor a segment"):
            describe_now(directory, catalog, label)


def test_a_journal_that_cannot_be_read_is_told(made: Made, tmp_path: Path) -> None:
    (made.path / JOURNAL).rename(tmp_path / "elsewhere")
    (made.path / JOURNAL).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match=JOURNAL):
        made.inventory()


@pytest.mark.parametrize(
    "name",
    [
        "1.mcap",
        "0000001.mcap",
        "\u0660\u0660\u0660\u0660\u0660\u0661.mcap",
        "-00001.mcap",
        "x.mcap",
    ],
)
def test_names_that_are_no_segments_are_passed_over(made: Made, name: str) -> None:
    shutil.copy(made.segments[1], made.path / name)
    assert made.inventory().listing.others == (name,)
    check(made.entry())


def test_names_are_text(made: Made) -> None:
    assert text("ä") == "ä"
    assert text(os.fsdecode(b"a\xff")) == "a\\xff"
    ids = {new_id() for _ in range(100)}
    assert len(ids) == 100
    assert all(len(i) == 32 and set(i) <= set("0123456789abcdef") for i in ids)


# At the opening.


def opened(directory: StoreDirectory) -> tuple[list[RecordingEntry], RepairReport]:
    report = RepairReport()
    with closing(Catalog(directory.path, directory.settings.store_id)) as catalog:
        store = StoreFiles(directory, catalog, report)
        found = store.look_at_all(mends=True).summaries
        entries = [store.current_entry(summary)[0] for summary in found]
        return [entry for entry in entries if entry is not None], report


@pytest.mark.parametrize("number", range(4))
def test_a_segment_that_goes_is_told_at_the_next_opening(made: Made, number: int) -> None:
    """Though the catalog knew better."""
    (entry,), _ = opened(made.directory)
    check(entry)
    aside = made.segments[number].rename(made.directory.path / "aside")
    for _ in range(2):
        (entry,), report = opened(made.directory)
        check(entry, number)
        assert not report.unreadable
    aside.rename(made.segments[number])
    (entry,), _ = opened(made.directory)
    check(entry)


def test_two_that_are_exchanged_behind_the_catalog(made: Made) -> None:
    opened(made.directory)
    first, second = made.segments[0], made.segments[3]
    assert first.stat().st_size != 0
    first.rename(made.path / "x")
    second.rename(first)
    (made.path / "x").rename(second)
    (entry,), _ = opened(made.directory)
    check(entry, 0, 3)


def test_a_byte_that_changes_behind_the_catalog(made: Made) -> None:
    """Of the same size, and with the time of the file put back."""
    opened(made.directory)
    path = made.segments[3]
    about = path.stat()
    data = bytearray(path.read_bytes())
    data[-40] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))
    (entry,), _ = opened(made.directory)
    check(entry, 3)


def test_a_lost_journal_is_written_again_at_the_opening(made: Made) -> None:
    opened(made.directory)
    (made.path / JOURNAL).unlink()
    (entry,), report = opened(made.directory)
    assert report.journals == [made.label]
    assert (entry.status, kept(entry)) == ("unproven", by_topic(0, 1, 2, 3))
    state = journal.read(made.path)
    assert state is not None
    assert (state.id, state.rebuilt) == (made.id, "it was not there")
    (again,), report = opened(made.directory)
    assert (again, report.journals) == (entry, [])


@pytest.mark.parametrize("kind", ["summary", "entry", "topics", "schema"])
@pytest.mark.parametrize("harm", ["DELETE FROM cells", "UPDATE cells SET body = body || 'x'"])
def test_an_answer_needs_nothing_that_the_catalog_has_lost(
    made: Made, kind: str, harm: str
) -> None:
    """What it has lost is made again, and no server is asked."""
    wanted = [payload(n) for n in range(80)]
    with hl.open(made.directory.path) as store:
        assert [m.raw for m in store.all_topics()] == wanted
    with closing(sqlite3.connect(made.directory.path / CATALOG)) as changed, changed:
        assert changed.execute(f"{harm} WHERE kind = ?", (kind,)).rowcount
    with hl.open(made.directory.path) as store:
        assert [m.raw for m in store.all_topics()] == wanted
        assert [m.decode().data for m in store.topic("/b")] == [f"{n:04d}" for n in range(1, 80, 3)]
        (entry,) = store.recordings()
        check(entry)
        assert store.shared.index.connected is None


def test_chunks_of_another_segment_are_refused(made: Made) -> None:
    """They are read from the footer, which has to be the one that the entry says."""
    with closing(Catalog(made.directory.path, "x", in_memory=True)) as empty:
        entry = made.entry()
        assert len(empty.table(entry, 0).chunks)
        changed = replace(entry, digests={**entry.digests, "0": entry.digests["1"]})
        with pytest.raises(CatalogError, match="has changed"):
            empty.table(changed, 0)
        with pytest.raises(CatalogError, match="cannot be opened"):
            empty.table(entry, 99)


def test_the_catalog_may_go_while_the_store_is_open(made: Made) -> None:
    path = made.directory.path / CATALOG
    wanted = [payload(n) for n in range(80)]
    with hl.open(made.directory.path) as store, hl.open(made.directory.path) as other:
        for content in (None, b"", b"nothing" * 1000):
            path.unlink()
            if content is not None:
                path.write_bytes(content)
            for opened_store in (store, other):
                opened_store.refresh()
                check(*opened_store.recordings())
                assert [m.raw for m in opened_store.all_topics()] == wanted
        assert store.shared.index.connected is None


def test_another_process_may_keep_the_catalog_locked(made: Made, limit: Limit) -> None:
    limit(catalog_busy_s=0.05)
    wanted = [payload(n) for n in range(80)]
    with hl.open(made.directory.path) as store:
        check(*store.recordings())
        with closing(sqlite3.connect(made.directory.path / CATALOG)) as held:
            held.execute("BEGIN EXCLUSIVE")
            for opened_store in (store, hl.open(made.directory.path)):
                with opened_store:
                    check(*opened_store.recordings())
                    assert [m.raw for m in opened_store.all_topics()] == wanted
                    opened_store.edit(opened_store.recordings()[0].label, tag={"seen": "yes"})
    with hl.open(made.directory.path) as store:
        assert [entry.tags["seen"] for entry in store.recordings()] == ["yes"]
