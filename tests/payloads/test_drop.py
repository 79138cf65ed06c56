"""`compact --drop-mcap`: payloads leave the segments, and nothing is lost."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import hybridlog as hl
from hybridlog.columns.payload_files import RecordingPayloads, open_segment
from hybridlog.entries import take_inventory
from hybridlog.maintenance import thinning
from hybridlog_storage import journal
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.errors import HybridlogError, SegmentError
from hybridlog_storage.segments.segment_format import moved_record
from hybridlog_storage.segments.segment_reader import SegmentReader
from tests.calls import Calls
from tests.copies import bring
from tests.indexed import documents_of
from tests.payloads.logs import (
    BASE,
    COUNT,
    SETTINGS,
    STEP,
    messages,
    recording_of,
    robot,
    write_log,
)

IMAGES = COUNT // 10
NOWHERE = "mongodb://127.0.0.1:9/x?serverSelectionTimeoutMS=50&connectTimeoutMS=50"


@pytest.fixture(scope="module")
def thin(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A store whose scans and clouds are in columns alone."""
    path = tmp_path_factory.mktemp("thin") / "store"
    shutil.copytree(plain, path)
    with hl.open(path) as store:
        found = store.compact(drop_mcap=True)
        assert [(one.topic, one.messages, one.dropped, one.both) for one in found] == [
            ("/cloud", COUNT, COUNT, 0),
            ("/scan", COUNT, COUNT, 0),
        ]
        yield store


def copy_of(store: hl.Store, path: Path) -> None:
    """The files of a store, without its index."""
    ignored = shutil.ignore_patterns("mongod*")
    shutil.copytree(store.directory.path, path / "store", ignore=ignored)


def answers(store: hl.Store) -> list[Any]:
    scans = store.topic("/scan")
    middle = BASE + COUNT // 2 * STEP
    return [
        messages(store),
        scans.where("ranges.max < 2.9").count(),
        scans.where("ranges < 1.001").count(),
        [m.raw for m in scans.where("header.stamp > 50")],
        scans.between(BASE, middle).count(),
        store.topic("/cloud").at(middle).raw,
        scans.clock("header").count(),
    ]


def test_no_answer_changes(plain: Path, thin: hl.Store) -> None:
    with hl.open(plain) as store:
        assert answers(store) == answers(thin)
        before, after = store.recordings()[0], thin.recordings()[0]
        assert (before.status, before.digests, before.spans) == (
            after.status, after.digests, after.spans,
        )  # fmt: skip
        chunks = [_chunk_bytes(recording_of(one.directory.path)) for one in (store, thin)]
        assert chunks[0] > 10 * chunks[1]


def _chunk_bytes(recording: Path) -> int:
    found = 0
    for path in recording.glob("*.mcap"):
        with SegmentReader(path, int(path.stem)) as reader:
            found += int(reader.table().chunks["length"].sum())
    return found


def test_every_byte_is_verified(thin: hl.Store) -> None:
    found = thin.verify()
    assert found.findings == []
    assert found.messages == 3 * COUNT + IMAGES


@pytest.mark.exhaustive
def test_index_and_tables_are_made_again_from_columns(plain: Path, copy: Path) -> None:
    with hl.open(copy) as store:
        store.compact(drop_mcap=True)
        shutil.rmtree(copy / "tables")
        store.index.rebuild()
        assert store.verify().findings == []
        documents = [d["ranges"]["max"] for d in documents_of(store, "/scan")]
        with hl.open(plain) as other:
            assert documents == [m.fields["ranges"]["max"] for m in other.topic("/scan")]
            assert answers(store) == answers(other)


def test_other_readers_find_what_is_left(thin: hl.Store) -> None:
    found: Counter[str] = Counter()
    stated: Counter[str] = Counter()
    for path in sorted(recording_of(thin.directory.path).glob("*.mcap")):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            for channel, count in summary.statistics.channel_message_counts.items():
                stated[summary.channels[channel].topic] += count
            assert summary.statistics.chunk_count == len(summary.chunk_indexes)
            for _, channel, _ in reader.iter_messages():
                found[channel.topic] += 1
    assert found == stated == {"/number": COUNT, "/image": IMAGES}


def test_a_store_that_was_open_before_goes_on(plain: Path, copy: Path) -> None:
    with hl.open(copy) as reading, hl.open(copy) as writing:
        first = reading.topic("/scan").at(BASE).raw
        recording = reading.recordings()[0]
        channels = [c.id for c in recording.channels]
        places = reading.session.chunks(recording, channels, None, "log")
        writing.compact(drop_mcap=True)
        assert reading.topic("/scan").at(BASE).raw == first
        with hl.open(plain) as other:
            assert messages(reading) == messages(other)
        for chunk in places:
            path = recording_of(copy) / f"{chunk.segment:06d}.mcap"
            with open_segment(path, chunk.segment) as reader:
                count = len(reader.read_chunk(chunk.place).batch)
                assert len(reader.read_arrivals(chunk.place, count)) == count
                assert sum(map(len, reader.read_times(chunk.place).values())) == count


def test_chunks_with_other_messages_stay(tmp_path: Path) -> None:
    small = [(t, k, time, p) for t, k, time, p in robot(60) if t != "/cloud"]
    for place, (topic, kind, time, payload) in enumerate(small):
        if topic == "/scan":  # so short that it shares chunks with the numbers
            small[place] = topic, kind, time, payload[:0] + _short_scan()
    log = write_log(tmp_path / "log.mcap", small)
    with hl.open(tmp_path / "store", create=True) as store:
        store.record(log, name="log", settings=SETTINGS)
        before = messages(store)
        (found,) = store.compact(topics=["scan"], drop_mcap=True)
        assert (found.messages, found.dropped, found.both) == (60, 0, 60)
        assert messages(store) == before
        assert not list(recording_of(tmp_path / "store").glob("*.thinned"))


def _short_scan() -> bytes:
    from tests.payloads.logs import scan

    return scan([1.0] * 20)


def test_a_topic_can_follow_later(plain: Path, copy: Path) -> None:
    with hl.open(copy) as store:
        (scans,) = store.compact(topics=["scan"], drop_mcap=True)
        assert scans.dropped == COUNT
        first = store.sizes().total.segment_bytes
        (clouds,) = store.compact(topics=["cloud"], drop_mcap=True)
        assert clouds.dropped == COUNT
        assert store.sizes().total.segment_bytes < first
        assert store.compact(drop_mcap=True) == []
        store.mark("log", BASE + STEP, "here")
        assert store.verify().findings == []
        with hl.open(plain) as other:
            topics = other.topics()
            assert [m.raw for m in store.query(topics)] == [m.raw for m in other.query(topics)]


def test_only_chunks_of_the_named_topics_are_taken_out(copy: Path) -> None:
    with hl.open(copy) as store:
        store.compact()
        (scans,) = store.compact(topics=["scan"], drop_mcap=True)
        assert (scans.topic, scans.dropped, scans.both) == ("/scan", COUNT, 0)
        found = {one.topic: (one.dropped, one.both) for one in store.compact(drop_mcap=True)}
        assert found == {"/cloud": (COUNT, 0)}


@pytest.mark.exhaustive
def test_what_else_is_in_a_segment_stays(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", robot(40))
    with path.open("rb") as file, (tmp_path / "more.mcap").open("wb") as more:
        writer = Writer(more)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            time = message.log_time
            writer.add_message(channels[channel.id], time, message.data, time)
        writer.add_attachment(BASE, BASE, "map.pgm", "image/pgm", b"P5" * 5000)
        writer.add_metadata("robot", {"wheels": "4"})
        writer.finish()
    with hl.open(tmp_path / "store", create=True) as store:
        store.record(tmp_path / "more.mcap", name="log", settings=SETTINGS)
        store.compact(drop_mcap=True)
        assert store.verify().findings == []
        kept = []
        for segment in sorted(recording_of(tmp_path / "store").glob("*.mcap")):
            with segment.open("rb") as file:
                reader = make_reader(file)
                kept += [(a.name, a.data) for a in reader.iter_attachments()]
                kept += [m.metadata for m in reader.iter_metadata() if m.name == "robot"]
        assert kept == [("map.pgm", b"P5" * 5000), {"wheels": "4"}]


@pytest.mark.exhaustive
def test_columns_follow_a_recording(thin: hl.Store, tmp_path: Path) -> None:
    with hl.open(tmp_path / "other", create=True) as store:
        bring(store, thin.directory.path)
        assert messages(store) == messages(thin)
        assert store.verify().findings == []


def test_a_lost_journal_is_made_again(thin: hl.Store, tmp_path: Path) -> None:
    copy_of(thin, tmp_path)
    (recording_of(tmp_path / "store") / journal.JOURNAL).unlink()
    with hl.open(tmp_path / "store") as store:
        assert messages(store) == messages(thin)
        entry, before = store.recordings()[0], thin.recordings()[0]
        assert entry.status == "unproven"
        assert (entry.digests, entry.payloads) == (before.digests, before.payloads)
        (finding,) = store.verify().findings
        assert "was rebuilt" in finding.problem


@pytest.mark.exhaustive
@pytest.mark.parametrize("which", [b'"files"', b'"segments"'])
def test_a_damaged_line_of_the_journal_loses_nothing(
    thin: hl.Store, tmp_path: Path, which: bytes
) -> None:
    copy_of(thin, tmp_path)
    path = recording_of(tmp_path / "store") / journal.JOURNAL
    lines = path.read_bytes().splitlines(keepends=True)
    lines = [
        b"x" + line[1:] if b'"compacted"' in line and which in line else line for line in lines
    ]
    path.write_bytes(b"".join(lines))
    with hl.open(tmp_path / "store") as store:
        store.verify(repair=True)
        assert store.recordings()[0].status == "unproven"
        assert messages(store) == messages(thin)


def test_a_lost_file_of_columns_is_a_loss(thin: hl.Store, tmp_path: Path) -> None:
    copy_of(thin, tmp_path)
    (path,) = recording_of(tmp_path / "store").glob("payloads/topic=scan/*")
    path.unlink()
    with hl.open(tmp_path / "store") as store:
        entry = store.recordings()[0]
        assert entry.status == "damaged"
        (loss,) = entry.end["losses"]
        assert (loss["topic"], loss["count"], loss["cause"]) == ("/scan", COUNT, "segment")
        assert (loss["from"], loss["to"]) == (BASE, BASE + (COUNT - 1) * STEP)
        assert store.topic("/cloud").count() == COUNT
        assert len(list(store.topic("/cloud"))) == COUNT
        with pytest.raises(HybridlogError, match="is missing"):
            list(store.topic("/scan"))
        assert any("is missing" in finding.problem for finding in store.verify().findings)


@pytest.mark.exhaustive
def test_a_flipped_bit_of_columns_is_found(thin: hl.Store, tmp_path: Path) -> None:
    copy_of(thin, tmp_path)
    (path,) = recording_of(tmp_path / "store").glob("payloads/topic=cloud/*")
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2] ^= 4
    path.write_bytes(whole)
    with hl.open(tmp_path / "store") as store:
        with pytest.raises(HybridlogError, match="checksum"):
            list(store.topic("/cloud"))
        assert len(list(store.topic("/scan"))) == COUNT
        assert store.verify().findings


def test_a_segment_that_differs_is_not_used(copy: Path, calls: Calls) -> None:
    with hl.open(copy) as store:
        before = messages(store)
        calls.fail(thinning, "_prove", SegmentError("it differs"))
        with pytest.raises(SegmentError, match="differs"):
            store.compact(drop_mcap=True)
        assert not list(recording_of(copy).glob("*.thinned"))
        assert len(store.recordings()[0].payloads) == 2
        assert messages(store) == before
        assert store.verify().findings == []


def test_content_that_differs_is_not_used(
    copy: Path, monkeypatch: pytest.MonkeyPatch, calls: Calls
) -> None:
    """Neither when chunks are taken out, nor when one is read later."""

    def wrong(found: Any, self: RecordingPayloads, segment: int, chunk: int, _: int) -> Any:
        if any("topic=cloud" in r.listed.file for r in self.having(segment, chunk)):
            found[-1] ^= 1
        return found

    with hl.open(copy) as store:
        calls.change(RecordingPayloads, "content", wrong)
        clouds, scans = store.compact(drop_mcap=True)
        assert (clouds.dropped, clouds.both) == (0, COUNT)
        assert (scans.dropped, scans.both) == (COUNT, 0)
        monkeypatch.undo()
        assert store.verify().findings == []
        (clouds,) = store.compact(topics=["cloud"], drop_mcap=True)
        assert clouds.dropped == COUNT
        calls.change(RecordingPayloads, "content", wrong)
        with pytest.raises(SegmentError, match="do not come back"):
            store.topic("/cloud").at(BASE + STEP)


def test_the_proof_sees_every_difference(copy: Path) -> None:
    """A new segment that lacks or changes something is refused."""
    with hl.open(copy) as store:
        store.compact()
        for path in sorted(recording_of(copy).glob("*.mcap")):
            with open_segment(path, int(path.stem)) as reader:
                summary = reader.summary()
                of = {
                    c.number: {summary.channels[n].topic for n in c.channels}
                    for c in summary.chunks
                }
                scans = {number for number, topics in of.items() if topics == {"/scan"}}
                others = {number for number, topics in of.items() if "/number" in topics}
                if scans and others:
                    _try_proof(reader, summary, scans, others)
                    return
    raise AssertionError("no segment has both")


def _try_proof(reader: Any, summary: Any, scans: set[int], others: set[int]) -> None:
    target = reader.path.with_name(f"{reader.path.name}.thinned")
    contents = RecordingPayloads(target.parent)
    thinning.thin(reader, target, dict.fromkeys(scans, moved_record), {"digest": "x"})
    thinning._prove(target, reader, summary, scans, contents)
    with pytest.raises(SegmentError, match="not what it should be"):
        thinning._prove(target, reader, summary, scans | others, contents)
    whole = target.read_bytes()
    target.write_bytes(whole[:300] + bytes([whole[300] ^ 1]) + whole[301:])
    with pytest.raises(SegmentError):
        thinning._prove(target, reader, summary, scans, contents)
    target.unlink()
    moved = dict.fromkeys(others, moved_record)
    thinning.thin(reader, target, moved, {"digest": "x"})  # they are in no columns
    with pytest.raises(SegmentError):
        thinning._prove(target, reader, summary, others, contents)
    target.unlink()


def test_an_interruption_is_undone_or_finished(thin: hl.Store, plain: Path, tmp_path: Path) -> None:
    """A whole segment is put back, as if its exchange had been interrupted."""
    copy_of(thin, tmp_path)
    recording = recording_of(tmp_path / "store")
    name = "000001.mcap"
    whole = (recording_of(plain) / name).read_bytes()
    small = (recording / name).read_bytes()
    text = (recording / journal.JOURNAL).read_bytes()
    assert len(small) < len(whole)
    lines = text.splitlines(keepends=True)
    unannounced = [n for n in lines if b'"segments":[{"segment":1,' not in n]
    assert len(unannounced) == len(lines) - 1
    for said, expected in ((lines, small), (unannounced, whole)):
        (recording / name).write_bytes(whole)
        (recording / f"{name}.thinned").write_bytes(small)
        (recording / journal.JOURNAL).write_bytes(b"".join(said))
        with hl.open(tmp_path / "store") as store:
            assert messages(store) == messages(thin)
            assert store.recordings()[0].status == "complete"
        assert (recording / name).read_bytes() == expected
        assert not (recording / f"{name}.thinned").exists()
    # An announced one that a crash has cut is not taken.
    (recording / journal.JOURNAL).write_bytes(text)
    (recording / f"{name}.thinned").write_bytes(small[:-10])
    with hl.open(tmp_path / "store") as store:
        assert messages(store) == messages(thin)
    assert (recording / name).read_bytes() == whole


@pytest.fixture(scope="module")
def edited(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A store whose journal ends with many steps: a segment without chunks twice over."""
    path = tmp_path_factory.mktemp("edited") / "store"
    shutil.copytree(plain, path)
    with hl.open(path) as store:
        store.compact(topics=["scan"], drop_mcap=True)
        store.compact(topics=["cloud"])
        store.compact(drop_mcap=True)
        store.edit("log", tag={"place": "lab"})
        store.mark("log", BASE + STEP, "here")
        yield store


@pytest.mark.parametrize(
    "lost",
    [1, 4, 7, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in range(2, 30) if n % 3 != 1)],
)
def test_a_journal_that_lacks_its_last_lines_loses_no_message(
    edited: hl.Store, tmp_path: Path, lost: int
) -> None:
    copy_of(edited, tmp_path)
    path = recording_of(tmp_path / "store") / journal.JOURNAL
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[: max(len(lines) - lost, 1)]))
    with hl.open(tmp_path / "store", mongo=NOWHERE) as store:
        assert store.recordings()[0].status == "unproven"
        assert messages(store) == messages(edited)
        assert store.recordings()[0].digests == edited.recordings()[0].digests
        assert all(one.is_cured for one in store.verify(repair=True))
    with hl.open(tmp_path / "store", mongo=NOWHERE) as store:
        assert messages(store) == messages(edited)
        assert [one.place for one in store.verify().findings] == ["journal"]
        state = journal.read(path.parent)
        assert state is not None
        assert set(state.payloads) == {one["file"] for one in edited.recordings()[0].payloads}


@pytest.mark.parametrize("lost", [b'"compacted"', b'"segments":[{', b'"files":[{'])
def test_an_older_journal_in_a_store_that_cannot_be_written(
    thin: hl.Store, tmp_path: Path, lost: bytes
) -> None:
    copy_of(thin, tmp_path)
    path = recording_of(tmp_path / "store") / journal.JOURNAL
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(line for line in lines if lost not in line))
    directory = StoreDirectory(tmp_path / "store")
    inventory = take_inventory(directory, "log")
    assert not inventory.lost
    assert not inventory.is_proven
    assert inventory.stored.keys() == inventory.summaries.keys()
    assert set(inventory.payloads) == {one["file"] for one in thin.recordings()[0].payloads}


def test_exchanged_segments_that_the_journal_lists_as_whole_ones(
    thin: hl.Store, tmp_path: Path
) -> None:
    copy_of(thin, tmp_path)
    recording = recording_of(tmp_path / "store")
    lines = (recording / journal.JOURNAL).read_bytes().splitlines(keepends=True)
    whole = b"".join(line for line in lines if b'"compacted"' not in line)
    (recording / journal.JOURNAL).write_bytes(whole)
    one, other = recording / "000000.mcap", recording / "000001.mcap"
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    with hl.open(tmp_path / "store", mongo=NOWHERE) as store:
        store.verify(repair=True)
        assert other.read_bytes() != content == one.read_bytes()
        assert messages(store) == messages(thin)
