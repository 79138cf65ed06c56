"""Copies of a recording that goes on, dead recorders, and other processes that change it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.records import Metadata

import hybridlog as hl
from hybridlog.attachments import extras_of
from hybridlog.maintenance.keep import expire
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.segments.segment_format import Attachment, FilePart
from tests import places
from tests.cli.running import complete
from tests.cli.within import answer
from tests.imports import ROOT
from tests.indexed import documents_of, misindexed
from tests.running.methods import LABEL, METHODS, rows, same, sent
from tests.running.running import NO_MONGODB, Running, begun
from tests.running.sequence import SAID, START, Known, messages
from tests.running.stores import copy_of
from tests.scale.cost import cost_of
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")

ABOUT_LOSSES = {"completeness", "remarks"}
"""What a crash has cost is lost, too."""


@pytest.fixture(scope="module", params=["one", "many"])
def running(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Running]:
    with begun(tmp_path_factory.mktemp("running") / "store", request.param, 130) as found:
        yield found


def check(store: hl.Store, known: Known) -> None:
    for name, rule in METHODS.items():
        if name not in ABOUT_LOSSES:
            found, wanted = rule.ask(store), rule.right(known)
            assert same(found, wanted), (name, found, wanted)


NEED_PAYLOADS = {
    "batches",
    "count",  # by elements of a long array
    "latched",
    "to_arrow",  # with such an array
    "to_numpy",
    "where",  # by elements of one
}
"""Methods that cannot answer of expired messages, at least one of the questions."""


def check_expired(store: hl.Store, known: Known) -> None:
    """All answers are as if nothing had expired."""
    for name, rule in METHODS.items():
        if name not in {*ABOUT_LOSSES, *NEED_PAYLOADS, "channels"}:
            found, wanted = rule.ask(store), rule.right(known)
            assert same(found, wanted), (name, found, wanted)
    gone = sum(message.is_reduced for message in store.topic("arm"))
    for query, told in (
        (store.topic("arm"), "no long arrays: their payloads were deleted to make room; "),
        (store.topic("arm").where("ranges[3:7].min >= 4"), "could not be tested: their"),
    ):
        query.to_arrow()
        assert any(told in one for one in query.completeness().sentences) == bool(gone)
    query = store.topic("arm").fields("n", "ranges.max")
    assert query.to_arrow().column("ranges.max").null_count == 0
    assert not [one for one in query.completeness().sentences if "deleted" in one]


def test_all_payloads_of_a_copy_have_expired(running: Running, tmp_path: Path) -> None:
    known = running.flushed()
    copied = copy_of(running, tmp_path / "copy")
    with hl.open(copied, mongo=NO_MONGODB) as store:
        store.shared.recover()
        entry = store.entry(LABEL)
        with store.directory.writing(entry.id):
            expire(store.directory, entry.id, [*map(int, entry.digests)])
        store.refresh()
        check_expired(store, known)
    shutil.rmtree(copied / "tables", ignore_errors=True)
    with hl.open(copied, mongo=NO_MONGODB) as store:
        check_expired(store, known)
        assert store.entry(LABEL).messages == len(known.of())
    done = answer("export", tmp_path / "out", "-F", "csv", "-t", "arm", store=copied)
    assert "no long arrays: their payloads were deleted to make room; these are null" in done.err


def test_payloads_expire_while_it_is_recorded(tmp_path: Path) -> None:
    with begun(tmp_path / "store", "many", 130) as running:
        known = running.flushed()
        entry = running.before.entry(LABEL)
        sealed = sorted(map(int, entry.digests))
        expire(running.store.directory, entry.id, sealed[:1])
        check_expired(running.before, known)
        expire(running.store.directory, entry.id, sealed[:3])
        running.write(30)
        known = running.flushed()
        check_expired(running.before, known)
        expire(running.store.directory, entry.id, sealed)
        known = running.flushed()
        check_expired(running.before, known)
    with hl.open(tmp_path / "store") as store:
        assert store.entry(LABEL).status == "complete"
        check_expired(store, known)
        assert store.verify().findings == []
        assert misindexed(store) == {}


@pytest.mark.parametrize("kind", [pytest.param("one", marks=pytest.mark.exhaustive), "many"])
def test_a_killed_recorder(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "store"
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.running.recorder", str(path), kind],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    everything = messages(0, 10_000, 0)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        with hl.open(path, mongo=NO_MONGODB) as before:
            wait_for(lambda: before.entry(LABEL).messages >= 300)
            least = before.entry(LABEL).messages_by_topic()
            process.send_signal(signal.SIGKILL)
            process.wait()
            with monkeypatch.context() as patch:
                patch.setattr(StoreDirectory, "is_writable", False)
                with hl.open(path, mongo=NO_MONGODB) as opened:
                    store = opened.snapshot()
                    entry = store.entry(LABEL)
                    assert entry.status == "unfinished"
                    counts = dict(entry.messages_by_topic())
                    assert all(counts[topic] >= count for topic, count in least.items())
                    check(store, Known(everything, counts))
                    found = store.topic("arm").completeness()
                    assert (found.has_losses, found.is_exact) == (True, False)
                    assert list(places.folder(path, LABEL).glob("*.open"))
            with hl.open(path, mongo=NO_MONGODB) as store:
                entry = store.edit(LABEL, note="found")
                assert entry.status == "recovered"
                assert dict(entry.messages_by_topic()) == counts
                check(store, Known(everything, counts))
            before.refresh()
            check(before, Known(everything, counts))
    finally:
        process.kill()
        process.communicate()


def test_documents_are_a_beginning(running: Running) -> None:
    """MongoDB has what is indexed, which may be less than what is flushed."""
    known = running.flushed()
    with hl.open(running.path) as store:
        found = [one["n"] for one in documents_of(store, "/said")]
    wanted = [m.fields["n"] for m in known.of("/said") if m.fields is not None]
    assert found == wanted


def test_extras_and_what_is_shown(tmp_path: Path) -> None:
    """Attachments and metadata of a log that is being recorded; completion."""
    with begun(tmp_path / "store", "one", 130, "none") as found:
        record = tmp_path / "calibration.yaml"
        record.write_bytes(b"fx: 500")
        with record.open("rb") as file:
            part = FilePart(lambda at, size: os.pread(file.fileno(), size, at), 0, 7)
            writer = found.recording.capture.writer
            writer.add_extra(Attachment(START, START, record.name, "text/yaml", part))
            writer.add_extra(Metadata(name="robot", metadata={"name": "seven"}))
            wait_for(lambda: found.before.metadata(LABEL))
        for store in (found.store, found.before):
            wait_for(lambda store=store: store.metadata(LABEL))
            (attachment,) = store.attachments(LABEL)
            assert (attachment.name, b"".join(attachment.pieces())) == (record.name, b"fx: 500")
            assert [one.values for one in store.metadata(LABEL)] == [{"name": "seven"}]
            query = store.topic("arm")
            extras = extras_of(query.source.now(), query.question)
            assert (len(extras.attachments), len(extras.metadata)) == (1, 1)
        done = answer("info", LABEL, "--attachments", "--json", store=found.path)
        assert [one["name"] for one in done.json] == [record.name]
        image = next(iter(found.before.topic("cam")))
        assert image is not None
        assert "/cam" in image._repr_html_()
        assert LABEL in found.before.recordings()._repr_html_()
        assert complete(f"fetch --store {found.path} -t /sa") == ["/said"]
        assert complete(f"info --store {found.path} l") == [LABEL]


@pytest.fixture
def ended(tmp_path: Path) -> Iterator[tuple[hl.Store, Known]]:
    """A handle that has asked about a recording, and which has been closed since."""
    with begun(tmp_path / "store", "many", 130, "none") as found:
        with hl.open(found.path, mongo=NO_MONGODB) as store:
            known = found.flushed()
            assert rows(store.topic("arm")) == sent(known.of("/arm"))
            found.recording.close()
            yield store, known


def test_sealed_between_a_look_and_reading(tmp_path: Path) -> None:
    with begun(tmp_path / "store", "many", 130, "none") as found:
        known = found.flushed()
        with hl.open(found.path, mongo=NO_MONGODB) as store:
            then = store.snapshot()
            assert then.entry(LABEL).flushed
            found.write(60)
            found.recording.close()
            check(then, known)
            assert len([*then.all_topics()]) == len(known.sent)
            assert len([*store.all_topics()]) == len(found.sent)


def test_renamed_meanwhile(ended: tuple[hl.Store, Known]) -> None:
    store, known = ended
    steps = iter(store.all_topics())
    first = next(steps)
    with hl.open(store.directory.path, mongo=NO_MONGODB) as other:
        other.edit(LABEL, name="other")
    assert rows([first, *steps]) == sent(known.of())
    store.refresh()
    assert store.topic("arm").in_recording("other").count() == len(known.of("/arm"))
    assert [r.name for r in store.session.look().summaries] == ["other"]


def test_removed_meanwhile(ended: tuple[hl.Store, Known]) -> None:
    store, known = ended
    then = store.snapshot()
    assert then.topic("arm").count() == len(known.of("/arm"))
    with hl.open(store.directory.path, mongo=NO_MONGODB) as other:
        other.remove(LABEL)
    assert store.topics() == []
    assert store.session.look().summaries == []


def test_what_questions_read(tmp_path: Path) -> None:
    """Ended recordings are asked without the running one; that is read once."""
    path = tmp_path / "store"
    with hl.open(path, create=True, mongo="none") as store, store.start("ended") as recording:
        for one in messages(0, 50, 0):
            if one.topic == "/said":
                recording.write(SAID, one.raw, log_time=one.log_time)
    with begun(path, "one", 130, "none") as found, hl.open(path, mongo=NO_MONGODB) as store:
        about_ended = store.topic("said").in_recording("ended")
        assert about_ended.count() == 50
        cost = cost_of(store, lambda: (rows(about_ended), about_ended.where("n > 3").count()))
        assert not [name for name in cost.opened if name.endswith(".open")]
        with hl.open(path, mongo=NO_MONGODB) as other:
            cost = cost_of(other, lambda: other.query(["/said"], ["ended"]).count())
            assert not [name for name in cost.opened if name.endswith(".open")]
        running = store.query(["/said"], [LABEL])
        found.flushed()
        assert running.count() == found.step
        again = cost_of(store, running.count)
        assert not [name for name in again.opened if name.endswith(".open")]
        assert again.bytes_read <= 2 * 4096  # the room behind the last block
        grown = places.files(path, "*.open")[0].stat().st_size
        found.write(20)
        found.flushed()
        grown = places.files(path, "*.open")[0].stat().st_size - grown
        more = cost_of(store, running.count)
        assert running.count() == found.step
        assert more.bytes_read < grown + 3 * 4096
