"""What a recording's files say of it, held against its manifest: without any server."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.entries import (
    ended,
    lost_in_crash,
    made_again,
    put_entry,
    read_summary,
    see,
    unlisted,
    with_segments,
)
from hybridlog.maintenance.opening import StoreFiles
from hybridlog.maintenance.report import RepairReport
from hybridlog.snapshot import Snapshot
from hybridlog_storage.catalog import WHOLE, Catalog, RecordingEntry
from hybridlog_storage.cells import Cells
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import Listing, StoreDirectory
from hybridlog_storage.errors import ManifestError, SegmentError
from hybridlog_storage.manifest import File, Loss, Manifest, Note, Part, Source, new_id, with_rows
from hybridlog_storage.manifest import replace as changed
from hybridlog_storage.manifests import MANIFEST_OLD
from hybridlog_storage.messages import Batch, Channel, Schema
from hybridlog_storage.segments.segment_file import Sealed
from hybridlog_storage.segments.segment_format import losses_record
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings
from tests import places
from tests.damage import flip

TEXT = Schema("std_msgs/String", "ros1msg", b"string data\n")
TOPICS = [Channel(topic, "ros1", TEXT) for topic in ("/a", "/b", "/c")]
SECOND = 10**9
PER_SEGMENT = 20
LOSS = Loss("queue", "/a", 3, 5, 6)


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
        self.id = new_id(name)
        files.make_folders(directory.recording(self.id))
        self.path = directory.recording(self.id)
        self.said = {
            "id": self.id,
            "name": name,
            "tags": {"place": "lab"},
            "source": {"path": "/x", "kind": "test", "bytes": 5, "profile": ""},
            "created": 77,
        }
        source = Source(path="/x", kind="test", bytes=5)
        tags = {"place": "lab"}
        places.write_in(self.path, Manifest(self.id, name, 77, source=source, tags=tags))
        self.has_ended = False
        writer = RecordingWriter(
            self.path,
            self.said,
            SegmentSettings(chunk_size=1 << 10, sync="never", segment_size=1),
            on_sealing=self._announce,
        )
        for number in range(segments):
            if number == segments - 1:  # what says how it ended lies in the same segment
                writer.settings = replace(writer.settings, segment_size=1 << 30)
            writer.append(batch(range(PER_SEGMENT * number, PER_SEGMENT * (number + 1))), TOPICS)
            writer.flush()
            if number == 1:
                writer.add_extra(losses_record([LOSS]))
        self.has_ended = True
        writer.close()
        self.segments = [path for _, path in places.segments(directory.path, self.id)]
        assert len(self.segments) == segments

    def _announce(self, group: Any) -> None:
        self.change(with_segments(*group))
        if self.has_ended:
            self.change(ended("complete"))

    def change(self, how: Callable[[Manifest], Manifest]) -> None:
        places.change_in(self.path, how)

    def set(self, **values: Any) -> None:
        self.change(lambda now: changed(now, **values))

    def drop(self, number: int) -> None:
        """Let the manifest know nothing of a segment."""
        self.change(
            lambda now: changed(now, files=tuple(f for f in now.files if f.number != number))
        )

    def manifest(self) -> Manifest:
        found = places.read_in(self.path)
        assert found is not None
        return found

    def listing(self) -> Listing:
        return self.directory.listing(self.id)

    def adopt(self) -> None:
        """List what the manifest lacks."""
        self.change(unlisted(self.directory, self.id, self.listing(), self.manifest()))

    def make_again(self) -> None:
        """Make the lost manifest again."""
        has_old = (self.path / MANIFEST_OLD).exists()
        old = places.old_in(self.path) if has_old else None
        places.write_in(self.path, made_again(self.directory, self.id, self.listing(), old))

    def entry(self, *suspects: int) -> RecordingEntry:
        """By the manifest; of some segments, the summaries are read."""
        return see(self.directory, self.id, {(number, WHOLE): "" for number in suspects}).entry

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Let it be recorded."""
        with self.directory.writing(self.id, records=True):
            yield


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
    for row in entry.losses:
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
    rows = [row for row in entry.losses if row["cause"] == "segment"]
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


def test_while_it_is_written_it_is_open(made: Made) -> None:
    # Whoever holds one that has ended does something else with it.
    with made.recorded():
        assert made.entry().status == "complete"
        made.segments[3].rename(made.path / "000003.mcap.open")
        entry = made.entry()
    # One that is listed and has its old name is about to get the new one: it is not lost.
    assert (entry.status, entry.segments, lost(entry)) == ("open", 3, Counter())
    assert made.entry().status == "unfinished"


def test_the_end_of_a_recording_is_in_its_manifest(made: Made) -> None:
    row = Loss("source damaged", reason="x", file="a.bag", offset=5, length=7)
    known = made.manifest()
    again = ended("damaged", [row])(changed(known, status="open"))
    assert (again.status, again.losses[-1].file, again.losses[-1].reason) == (
        "damaged",
        "a.bag",
        "x",
    )
    assert len(again.losses) == len(known.losses) + 1
    made.set(status="open")
    assert made.entry().status == "recovered"  # it was cut short, even if all files are there
    opened(made.directory)
    assert made.manifest().status == "recovered"


# Segments that are not what they should be.


def _link(made: Made, number: int) -> None:
    aside = made.segments[number].rename(made.directory.path / "elsewhere")
    made.segments[number].symlink_to(aside)


HARMS: dict[str, Callable[[Made, int], object]] = {
    "missing": lambda made, number: made.segments[number].unlink(),
    "another": lambda made, number: shutil.copy(made.segments[2], made.segments[number]),
    "empty": lambda made, number: os.truncate(made.segments[number], 0),
    "grown": lambda made, number: os.truncate(
        made.segments[number], made.segments[number].stat().st_size + 1
    ),
    "link": _link,
}


@pytest.mark.parametrize("number", [0, 1, 3])
@pytest.mark.parametrize("harm", HARMS)
def test_a_file_that_is_not_the_one_listed(made: Made, harm: str, number: int) -> None:
    HARMS[harm](made, number)
    if harm != "another":
        check(made.entry(), number)
    check(made.entry(0, 1, 2, 3), number)


def test_one_that_lies_there_twice_under_a_number_of_its_own(made: Made) -> None:
    shutil.copy(made.segments[1], made.path / "000007.mcap")
    # Nothing is counted twice, and nothing is lost.
    check(made.entry())
    made.adopt()
    assert made.manifest().logs.keys() == {0, 1, 2, 3}


# Manifests that are not what they should be.


def test_what_is_missing_stays_lost_when_the_manifest_is_made_again(made: Made) -> None:
    made.set(notes=(Note(5, "x"),))
    made.segments[2].unlink()
    places.manifest_of(made.path).unlink()
    made.make_again()
    assert (made.entry().status, lost(made.entry())) == ("damaged", by_topic(2))


def test_the_old_manifest_may_lack_the_last_segment_and_the_end(made: Made) -> None:
    whole = made.manifest()
    places.write_in(made.path, changed(whole, status="open", files=whole.files[:3]))
    places.manifest_of(made.path).rename(made.path / MANIFEST_OLD)
    made.make_again()
    assert made.manifest().logs.keys() == {0, 1, 2, 3}
    assert kept(made.entry()) == by_topic(0, 1, 2, 3)


def test_without_a_manifest_most_segments_say_what_recording_it_is(
    made: Made, directory: StoreDirectory
) -> None:
    other = Made(directory, "other")
    shutil.copy(other.segments[0], made.segments[0])
    places.manifest_of(made.path).unlink()
    (made.path / MANIFEST_OLD).unlink()
    made.make_again()
    entry = made.entry()
    assert (entry.id, entry.status) == (made.id, "unproven")
    assert kept(entry) == by_topic(1, 2, 3)


def test_a_segment_that_the_manifest_does_not_list(made: Made) -> None:
    made.drop(1)
    # It answers, and is listed by the next one that may write.
    check(made.entry())
    made.adopt()
    assert made.manifest().logs.keys() == {0, 1, 2, 3}
    check(made.entry())


def test_what_a_crash_took_of_a_listed_segment(made: Made) -> None:
    """It was listed with all its messages, and came out of the crash with fewer."""
    there = made.manifest().logs[3]
    channels = {n: one for n, one in made.manifest().channels.items() if n in there.parts}
    sealed = Sealed(there, channels)
    topics = {n: channel.topic for n, channel in made.manifest().channels.items()}
    gone = Counter({"/a": 10, "/b": 10})
    parts = {
        n: changed_part(part, 10 if topics[n] != "/c" else 0) for n, part in there.parts.items()
    }
    other = changed(there, bytes=9, digest=f"{5:064x}", parts=parts)
    made.change(lambda now: with_rows(now, other, ()))
    losses = tuple(lost_in_crash(made.manifest(), sealed))
    made.change(lambda now: changed(with_segments(sealed)(now), losses=losses, status="damaged"))
    entry = made.entry()
    assert entry.status == "damaged"
    assert kept(entry) == by_topic(0, 1, 2, 3)
    assert lost(entry) == gone
    # Also when the manifest is made again.
    made.set(notes=(Note(5, "x"),))
    places.manifest_of(made.path).unlink()
    made.make_again()
    entry = made.entry()
    assert (entry.status, lost(entry)) == ("damaged", gone)


def changed_part(part: Part, more: int) -> Part:
    return Part(part.messages + more, part.bytes, part.first, part.last)


def test_a_lost_segment_of_which_nothing_is_known_is_a_row_all_the_same(made: Made) -> None:
    file = File(4, 4, "000004.mcap", "log", 9, f"{5:064x}", 5)
    made.change(lambda now: changed(now, files=(*now.files, file)))
    entry = made.entry()
    assert entry.status == "damaged"
    (row,) = [r for r in entry.losses if r["cause"] == "segment"]
    assert (row["file"], row["count"], row["topic"]) == ("000004.mcap", 0, None)


# Chunks that cannot be read.


def test_chunks_that_cannot_be_read_are_lost_by_topic(made: Made) -> None:
    summary = read_summary(made.segments[2], 2)
    chunk, bounds = summary.table.chunks[0], summary.table.part_bounds()
    parts = summary.table.parts[bounds[0] : bounds[1]]
    with closing(Catalog(Path("/nowhere"), Cells(None, "x"))) as catalog:
        catalog.put_damage(made.id, {(2, 0): "its checksum differs", (2, 99): "x", (9, 0): "y"})
        entry = put_entry(made.directory, catalog, made.id)
    assert entry.status == "damaged"
    rows = [row for row in entry.losses if row["cause"] == "segment"]
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
    files.make_folders(directory.recording("x"))
    places.segment(directory.path, "x").write_bytes(b"nothing")
    with pytest.raises(ManifestError, match="x has no manifest"):
        see(directory, "x", {})
    with pytest.raises(SegmentError, match="neither a manifest nor a segment"):
        made_again(directory, "x", directory.listing("x"), None)


# At the opening.


def opened(directory: StoreDirectory) -> tuple[list[RecordingEntry], RepairReport]:
    report = RepairReport()
    with closing(Catalog(directory.path, directory.cells)) as catalog:
        store, nothing = StoreFiles(directory, catalog, report), Snapshot((), {})
        found = store.look(nothing, directory.ids()).summaries
        if store.recover([one.id for one in found if one.status == "unfinished"]):
            found = store.look(nothing, directory.ids()).summaries
        seen = [store.see(summary.id) for summary in found]
        return [one.entry for one in seen if one is not None], report


def test_a_byte_that_changes_behind_the_catalog(made: Made) -> None:
    """Of the same size, and with the time of the file put back."""
    opened(made.directory)
    path = made.segments[3]
    about = path.stat()
    flip(path, -40)
    os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))
    with hl.open(made.directory.path, mongo="none") as store:
        assert [m.raw for m in store.all_topics()] == [payload(n) for n in range(60)]
    (entry,), _ = opened(made.directory)
    check(entry, 3)
