"""`repair` applies the cures that lose nothing, and says what only a copy can restore."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage import journal
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.cli.within import answer
from tests.test_identity import COUNT, make_log, payload

NOWHERE = "mongodb://127.0.0.1:9/x?serverSelectionTimeoutMS=50&connectTimeoutMS=50"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of several segments."""
    base = tmp_path_factory.mktemp("repair")
    settings = SegmentSettings(chunk_size=1024, segment_size=3000, compression="none")
    with hl.open(base / "store", create=True) as store:
        store.record(make_log(base / "one.mcap", 100), name="one", settings=settings)
        store.record(make_log(base / "two.mcap", 500), name="two", settings=settings)
    return base / "store"


@pytest.fixture
def store(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared, tmp_path / "store", ignore=lambda *_: ["mongod"])
    return tmp_path / "store"


def look(store: Path) -> tuple[str, int, int]:
    """Status, messages and lost messages of the first recording; what is read is right."""
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        entry = opened.entry("one")
        got = [bytes(m.raw) for m in opened.topic("/n").in_recording("one")]
        assert set(got) <= {payload(n) for n in range(100, 100 + COUNT)}
        assert len(got) == entry.messages
        lost = sum(row["count"] for row in entry.end.get("losses", ()))
        return entry.status, entry.messages, lost


def repair(store: Path) -> dict[tuple[str, str], bool]:
    """What `repair` says, by recording and place: whether it is cured."""
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        done = {(one.recording, one.place): one.is_cured for one in opened.verify(repair=True)}
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        # What was cured is cured, and what was not is said again.
        again = opened.verify(repair=True)
        assert {(one.recording, one.place) for one in again} == {
            k for k, v in done.items() if not v
        }
    return done


def file(store: Path, number: int) -> Path:
    return store / "recordings" / "one" / f"{number:06d}.mcap"


def test_a_store_that_is_whole(store: Path) -> None:
    before = {p: p.read_bytes() for p in (store / "recordings").rglob("*") if p.is_file()}
    assert repair(store) == {}
    assert {p: p.read_bytes() for p in (store / "recordings").rglob("*") if p.is_file()} == before
    assert look(store) == ("complete", COUNT, 0)


def exchange(store: Path) -> None:
    file(store, 0).rename(file(store, 99))
    file(store, 2).rename(file(store, 0))
    file(store, 99).rename(file(store, 2))


def turn_around(store: Path) -> None:
    file(store, 1).rename(file(store, 99))
    file(store, 2).rename(file(store, 1))
    file(store, 3).rename(file(store, 2))
    file(store, 99).rename(file(store, 3))


def flip_the_summary(store: Path) -> None:
    data = bytearray(file(store, 1).read_bytes())
    data[-60] ^= 4
    file(store, 1).write_bytes(data)


def cut_the_summary(store: Path) -> None:
    data = file(store, 1).read_bytes()
    file(store, 1).write_bytes(data[:-50])


@pytest.mark.parametrize("fault", [exchange, turn_around, flip_the_summary, cut_the_summary])
def test_what_can_be_proven_is_put_right(store: Path, fault: Callable[[Path], None]) -> None:
    names = sorted(p.name for p in (store / "recordings" / "one").iterdir())
    whole = {n: file(store, n).read_bytes() for n in range(4)}
    fault(store)
    status, messages, lost = look(store)
    assert (status, messages + lost) == ("damaged", COUNT)
    assert lost
    done = repair(store)
    assert done
    assert all(done.values())
    assert {n: file(store, n).read_bytes() for n in range(4)} == whole
    assert sorted(p.name for p in (store / "recordings" / "one").iterdir()) == names
    assert look(store) == ("complete", COUNT, 0)


def test_a_damaged_summary_names_its_cure(store: Path) -> None:
    flip_the_summary(store)
    said = answer("verify", "--mongo", "none", store=store, code=None).out
    assert "A repair makes the summary again" in said
    assert "`mcap recover`; run `hybridlog verify --repair`" in said


def test_a_segment_whose_messages_are_damaged_stays_as_it_is(store: Path) -> None:
    data = bytearray(file(store, 1).read_bytes())
    data[400] ^= 4
    data[-60] ^= 4
    file(store, 1).write_bytes(data)
    assert repair(store) == {("one", "000001.mcap"): False}
    assert file(store, 1).read_bytes() == data
    assert not list(file(store, 1).parent.glob(".*"))
    status, messages, lost = look(store)
    assert (status, messages + lost) == ("damaged", COUNT)


def test_damage_that_only_a_copy_mends_is_said(store: Path) -> None:
    data = bytearray(file(store, 1).read_bytes())
    data[1400] ^= 4
    file(store, 1).write_bytes(data)
    ((where, is_cured),) = repair(store).items()
    assert where[0] == "one"
    assert where[1].startswith("000001.mcap byte ")
    assert not is_cured
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        (finding,) = opened.verify().findings
        assert (finding.recording, finding.place) == where
        assert finding.cure == "restore the file from a copy"


def test_a_missing_segment_is_said_again_and_again(store: Path) -> None:
    file(store, 2).unlink()
    for _ in range(2):
        assert repair(store) == {("one", "segment 2"): False}
        status, messages, lost = look(store)
        assert (status, messages + lost) == ("damaged", COUNT)
        assert lost


def test_a_segment_of_another_recording_is_not_believed(store: Path) -> None:
    shutil.copy(store / "recordings" / "two" / "000001.mcap", file(store, 1))
    assert repair(store) == {("one", "000001.mcap"): False}
    status, messages, lost = look(store)
    assert (status, messages + lost) == ("damaged", COUNT)


def test_a_duplicate_is_told_and_the_original_answers(store: Path) -> None:
    shutil.copy(file(store, 1), file(store, 77))
    assert look(store) == ("complete", COUNT, 0)
    assert repair(store) == {("one", "000077.mcap"): False}
    assert look(store) == ("complete", COUNT, 0)


def test_a_journal_with_a_damaged_line_is_written_again(store: Path) -> None:
    path = store / "recordings" / "one" / "journal"
    data = bytearray(path.read_bytes())
    second = data.index(b"\n") + 30
    data[second] ^= 1
    path.write_bytes(data)
    assert look(store) == ("unproven", COUNT, 0)
    assert repair(store) == {("one", "journal"): True}
    assert look(store) == ("unproven", COUNT, 0)  # nobody can prove what the line said
    assert path.with_name("journal.old").read_bytes() == data
    state = journal.read(path.parent)
    assert state is not None
    assert not state.damaged
    # What is lost from now on is seen.
    file(store, 3).unlink()
    status, messages, lost = look(store)
    assert (status, messages + lost) == ("damaged", COUNT)


def test_a_line_that_was_cut_short_is_cut_off(store: Path) -> None:
    path = store / "recordings" / "one" / "journal"
    data = path.read_bytes()
    path.write_bytes(data + b"12345678 {half of a li")
    assert look(store) == ("complete", COUNT, 0)
    repair(store)
    assert path.read_bytes() == data


def test_segments_that_the_journal_does_not_list(store: Path) -> None:
    """The journal is an older one, from a backup."""
    path = store / "recordings" / "one" / "journal"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(line for line in lines if b'"segment":3' not in line))
    assert look(store) == ("unproven", COUNT, 0)
    assert repair(store) == {("one", "000003.mcap"): True}
    assert look(store) == ("unproven", COUNT, 0)
    file(store, 3).unlink()
    status, messages, lost = look(store)
    assert (status, messages + lost) == ("damaged", COUNT)


def test_a_journal_that_is_gone_is_written_again_unasked(store: Path) -> None:
    path = store / "recordings" / "one" / "journal"
    path.unlink()
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        assert opened.repairs.journals == ["one"]
        (finding,) = opened.verify().findings
        assert (finding.recording, finding.place) == ("one", "journal")
    assert path.exists()
    assert look(store) == ("unproven", COUNT, 0)
    file(store, 0).unlink()
    status, messages, lost = look(store)
    assert (status, messages + lost) == ("damaged", COUNT)


@pytest.mark.mongo("embedded")
def test_a_segment_that_was_restored_is_answered_from_again(store: Path) -> None:
    whole = file(store, 1).read_bytes()
    data = bytearray(whole)
    data[600] ^= 4
    file(store, 1).write_bytes(data)
    with hl.open(store) as opened:
        opened.index.rebuild()
        entry = opened.entry("one")
        lost = sum(row["count"] for row in entry.end["losses"])
        assert (entry.status, lost > 0) == ("damaged", True)
        with pytest.raises(SegmentError, match=r"byte \d+ of .*000001\.mcap is damaged"):
            opened.topic("/n").where("n >= 0").count()
        assert opened.topic("/n").in_recording("two").where("n >= 0").count() == COUNT
        assert not [one for one in opened.verify(repair=True) if one.place == "index"]
        file(store, 1).write_bytes(whole)
        assert [one.is_cured for one in opened.verify(repair=True) if one.place == "index"] == [
            True
        ]
        assert opened.entry("one").status == "complete"
        assert opened.topic("/n").where("n >= 0").count() == 2 * COUNT
        assert not opened.verify().findings


def test_a_recording_without_its_end_gets_one(store: Path) -> None:
    """The crash came between two segments."""
    path = store / "recordings" / "one" / "journal"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(line for line in lines if b'"ended"' not in line))
    status, messages, lost = look(store)
    assert (messages, lost) == (COUNT, 0)
    state = journal.read(path.parent)
    assert state is not None
    assert state.end is not None  # the last segment says it
    assert status == state.end["status"] == "complete"


def test_a_mark_beside_a_lost_segment_takes_nothing_of_it(store: Path) -> None:
    """The segment comes back from a copy: its number and its arrival numbers are still its own."""
    last = max((store / "recordings" / "one").glob("*.mcap"))
    whole = last.read_bytes()
    last.unlink()
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        opened.mark("one", "+1s", "slip")
    assert not last.exists()
    last.write_bytes(whole)
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        entry = opened.entry("one")
        assert (entry.status, entry.messages, len(entry.marks)) == ("complete", COUNT + 1, 1)
        seqs = [m.seq for m in opened.all_topics().in_recording("one")]
        assert len(set(seqs)) == len(seqs) == COUNT + 1
