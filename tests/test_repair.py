"""`repair` applies the cures that lose nothing, and says what only a copy can restore."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.maintenance.verify import RESTORE
from hybridlog_storage.errors import SegmentError, TopicError
from hybridlog_storage.manifest import replace
from hybridlog_storage.manifests import MANIFEST_OLD
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.within import answer
from tests.damage import flip
from tests.running.running import NO_MONGODB as NOWHERE
from tests.running.test_faults import record_starts
from tests.some import in_turn
from tests.test_identity import COUNT, make_log, payload


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
        got = [bytes(m.raw) for m in opened.topic("/n").in_recording("one")]
        entry = opened.entry("one")  # what cannot be read is known by now
        assert set(got) <= {payload(n) for n in range(100, 100 + COUNT)}
        assert len(got) == entry.messages
        lost = sum(row["count"] for row in entry.losses)
        return entry.status, entry.messages, lost


def repair(store: Path) -> tuple[set[tuple[str, str]], set[tuple[str, str]]]:
    """What `repair` has mended, and what it has left, by recording and place."""
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        done = opened.verify(repair=True)
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        # What was mended is whole, and what was not is said again.
        again = opened.verify(repair=True)
        assert (again.repaired, again.findings) == ([], done.findings)
    mended = {(one.recording, one.place) for one in done.repaired}
    return mended, {(one.recording, one.place) for one in done.findings}


def file(store: Path, number: int) -> Path:
    return places.segment(store, "one", number)


def test_a_store_that_is_whole(store: Path) -> None:
    before = {p: p.read_bytes() for p in places.root(store).rglob("*") if p.is_file()}
    assert repair(store) == (set(), set())
    assert {p: p.read_bytes() for p in places.root(store).rglob("*") if p.is_file()} == before
    assert look(store) == ("complete", COUNT, 0)


def flip_the_summary(store: Path) -> None:
    flip(file(store, 1), -60)


def cut_the_summary(store: Path) -> None:
    data = file(store, 1).read_bytes()
    file(store, 1).write_bytes(data[:-50])


@pytest.mark.parametrize("fault", [flip_the_summary, cut_the_summary])
def test_what_can_be_proven_is_put_right(store: Path, fault: Callable[[Path], None]) -> None:
    names = sorted(p.name for p in places.folder(store, "one").iterdir())
    whole = {n: file(store, n).read_bytes() for n in range(4)}
    fault(store)
    status, messages, lost = look(store)
    assert (status, messages + lost) == ("damaged", COUNT)
    assert lost
    mended, left = repair(store)
    assert mended
    assert not left
    assert {n: file(store, n).read_bytes() for n in range(4)} == whole
    assert sorted(p.name for p in places.folder(store, "one").iterdir()) == names
    assert look(store) == ("complete", COUNT, 0)


def test_a_damaged_summary_names_its_cure(store: Path) -> None:
    flip_the_summary(store)
    said = answer("verify", "--mongo", "none", store=store, code=None).out
    assert "A repair makes the summary again" in said
    assert "`mcap recover`; run `hybridlog verify --repair`" in said
    assert said.count("no readable summary") == said.count("run `hybridlog verify") == 1


@pytest.mark.parametrize("harmed", [(1400,), (400, -60)])
def test_a_segment_whose_messages_are_damaged_stays_as_it_is(
    store: Path, harmed: tuple[int, ...]
) -> None:
    """Only a copy mends it, whether its summary is whole or not."""
    flip(file(store, 1), *harmed, bits=4)
    data = file(store, 1).read_bytes()
    mended, left = repair(store)
    assert not mended
    assert {(one, place.partition(" ")[0]) for one, place in left} == {("one", "000001.mcap")}
    assert file(store, 1).read_bytes() == data
    assert not list(file(store, 1).parent.glob(".*"))
    if -60 in harmed:
        status, messages, lost = look(store)
        assert (status, messages + lost) == ("damaged", COUNT)
        return
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        (finding,) = opened.verify().findings
        assert {(finding.recording, finding.place)} == left
        assert finding.cure == RESTORE


def test_what_a_kill_has_left_is_sealed_before_its_manifest_is_made(store: Path) -> None:
    folder = places.folder(store, "one")
    for segment in [*folder.glob("*.mcap")]:
        segment.rename(segment.with_name(f"{segment.name}.open"))
    places.manifest_of(folder).write_bytes(b"")
    (folder / MANIFEST_OLD).unlink()
    assert repair(store)[0] == {("one", "manifest")}
    assert look(store) == ("unproven", COUNT, 0)


@pytest.mark.mongo("embedded")
def test_without_a_repair_no_file_is_changed(store: Path) -> None:
    folder = places.folder(store, "one")
    last = sorted(folder.glob("*.mcap"))[-2:]
    opened_files = [path.rename(path.with_name(f"{path.name}.open")) for path in last]
    places.change_in(folder, lambda now: replace(now, status="open", files=now.files[:-2]))
    before = {p: p.read_bytes() for p in places.root(store).rglob("*") if p.is_file()}
    with hl.open(store) as opened:
        done = opened.verify()
    told = {one.place: (one.problem, one.cure) for one in done.findings}
    for path in opened_files:  # it has messages: nobody moves it away
        problem, cure = told[path.name]
        assert problem.startswith("a crash has left it open")
        assert "move" not in cure
    assert {p: p.read_bytes() for p in places.root(store).rglob("*") if p.is_file()} == before
    data = opened_files[0].read_bytes()
    _, chunk, *_ = (at for at in record_starts(data) if data[at] == 6)
    flip(opened_files[0], chunk + 300)
    with hl.open(store, mongo="none") as opened:
        with pytest.raises(SegmentError, match=r"is damaged.*`hybridlog verify --repair` seals"):
            _ = [one.raw for one in opened.topic("/n").in_recording("one")]


@pytest.mark.parametrize(
    ("harm", "has_old"), in_turn(["gone", "flipped", "cut", "empty"], [True, False])
)
def test_a_manifest_is_made_again_when_it_is_asked_for(
    store: Path, harm: str, has_old: bool
) -> None:
    folder = places.folder(store, "one")
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        opened.edit("one", tag={"place": "lab"})
        opened.edit("one", note="wind")
    places.spoil_manifest(folder, harm)
    if not has_old:
        (folder / MANIFEST_OLD).unlink()
    before = sorted(p.name for p in folder.iterdir())
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        (reason,) = opened.shared.repairs.unreadable.values()
        assert "`hybridlog verify --repair` makes it again" in reason
        assert [entry.name for entry in opened.recordings()] == ["two"]
        assert opened.topic("/n").count() == COUNT
        assert opened.topic("/n").completeness().has_losses
        assert not opened.topic("/n").in_recording("two").completeness().has_losses
        (finding,) = opened.verify().findings
        assert (finding.place, "hybridlog verify" in finding.problem) == ("manifest", False)
    assert sorted(p.name for p in folder.iterdir()) == before
    assert repair(store)[0] == {("one", "manifest")}
    assert look(store) == ("unproven", COUNT, 0)
    with closing(hl.open(store, mongo=NOWHERE)) as opened:
        assert opened.entry("one").tags == ({"place": "lab"} if has_old else {})
        (finding,) = opened.verify().findings
        assert (finding.recording, finding.place) == ("one", "manifest")
    # What is lost from now on is seen.
    file(store, 3).unlink()
    status, messages, lost = look(store)
    assert (status, messages + lost) == ("damaged", COUNT)


@pytest.mark.mongo("embedded")
def test_a_segment_that_was_restored_is_answered_from_again(store: Path) -> None:
    whole = file(store, 1).read_bytes()
    flip(file(store, 1), 600)
    with hl.open(store) as opened:
        opened.index.rebuild()
        entry = opened.entry("one")
        lost = sum(row["count"] for row in entry.losses)
        assert (entry.status, lost > 0) == ("damaged", True)
        with pytest.raises(SegmentError, match=r"byte \d+ of .*000001\.mcap is damaged"):
            opened.topic("/n").where("n >= 0").count()
        assert opened.topic("/n").in_recording("two").where("n >= 0").count() == COUNT
        assert "index" not in {one.place for one in opened.verify(repair=True).repaired}
        file(store, 1).write_bytes(whole)
        done = opened.verify(repair=True)
        assert ([one.place for one in done.repaired], done.findings) == (["index"], [])
        assert opened.entry("one").status == "complete"
        assert opened.topic("/n").where("n >= 0").count() == 2 * COUNT
        assert not opened.verify().findings


@pytest.mark.parametrize("chosen", ["its id", "*"])
def test_a_recording_that_cannot_be_read_is_chosen_by_its_id(store: Path, chosen: str) -> None:
    recording = places.id_of(store, "one")
    places.manifest_of(places.folder(store, "one")).unlink()
    words = ("-r", recording if chosen == "its id" else "*", "--mongo", "none")
    said = answer("verify", "--json", *words, store=store, code=None)
    assert "cannot be read" not in said.err
    found = said.json
    assert [recording, "manifest"] in [
        [one["recording"], one["place"]] for one in found["findings"]
    ]
    assert found["recordings"] == (1 if chosen == "its id" else 2)
    answer("verify", "--repair", *words, store=store, code=None)
    assert look(store) == ("unproven", COUNT, 0)


def test_a_store_whose_recordings_cannot_be_read_is_not_empty(store: Path) -> None:
    for name in ("one", "two"):
        places.manifest_of(places.folder(store, name)).unlink()
    said = answer("info", "--mongo", "none", store=store)
    assert "2 recordings cannot be read: `hybridlog verify` says why." in said.err
    assert "empty" not in said.out + said.err
    with (
        hl.open(store, mongo="none") as opened,
        pytest.raises(TopicError, match="2 recordings cannot be read"),
    ):
        opened.recordings("one").check()
