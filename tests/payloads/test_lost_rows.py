"""A file of rows of a log that is gone is lost: every door says the same, until it is back."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.maintenance import keep
from hybridlog.maintenance.copying import CopyOptions
from hybridlog.maintenance.verify import RESTORE
from hybridlog_storage.errors import IncompleteError, StoreError
from hybridlog_storage.manifest import File, Manifest
from tests import places
from tests.cli.within import answer
from tests.copies import bring
from tests.damage import flip
from tests.payloads.logs import COUNT, recording_of
from tests.payloads.test_expiry import TOPICS, answers, expire, row_files

FIELDS = {"/scan": "angle_min", "/cloud": "width"}


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


LOSSES: dict[str, Callable[[Path], None]] = {"missing": Path.unlink, "has another size": cut}
FLIPS = {"page": 900, "footer": -300}


@pytest.fixture
def gone(copy: Path) -> Path:
    """A store with a log that is gone and had two larger topics."""
    expire(copy, [0])
    return copy


def topic_of(rows: File, manifest: Manifest) -> str:
    return manifest.channels[next(iter(rows.parts))].topic


def rows_of(store: Path, which: int) -> tuple[File, str]:
    """A file of rows of the first log that is gone, and its topic."""
    manifest = places.manifest(store, "log")
    file = manifest.rows[1][which]
    return file, topic_of(file, manifest)


def doors(store: hl.Store, topic: str) -> dict[str, Callable[[], Any]]:
    """Ways to ask how many messages a topic has."""
    query, field, table = store.topic(topic), FIELDS[topic], topic[1:]
    (entry,) = store.recordings()
    return {
        "count": query.count,
        "messages": lambda: sum(1 for message in query if message.fields),
        "table": lambda: query.fields(field).to_arrow().num_rows,
        "predicate": lambda: query.where(f"{field} <= 1e9").count(),
        "between": lambda: query.between("-100s", "end").count(),
        "sql": lambda: store.sql(f"select count(*) from {table}").rows()[0][0],
        "sql fields": lambda: store.sql(f"select count({field}) from {table}").rows()[0][0],
        "sql topics": lambda: store.sql(
            f"select messages from topics where topic = '{topic}'"
        ).rows()[0][0],
        "info": lambda: entry.messages_by_topic()[topic],
    }


@pytest.mark.parametrize("has", ["nothing", "index"])
@pytest.mark.parametrize("fault", LOSSES)
def test_a_log_that_has_lost_a_file_is_lost_in_every_door(
    gone: Path, fault: str, has: str, mongo: str
) -> None:
    right = answers(gone)
    if has == "index":
        with hl.open(gone, mongo=mongo) as store:
            store.index.rebuild()
    else:
        mongo = "none"
    manifest = places.manifest(gone, "log")
    lost = {topic_of(row, manifest): row for row in manifest.rows[1]}
    file, _ = rows_of(gone, 1)
    path = recording_of(gone) / file.name
    whole = path.read_bytes()
    LOSSES[fault](path)
    if has == "nothing":
        shutil.rmtree(gone / "tables")
    with hl.open(gone, mongo=mongo) as store:
        (entry,) = store.recordings()
        assert entry.status == "damaged"
        said = [
            (loss["file"], loss["topic"], loss["count"], loss["from"], loss["to"])
            for loss in entry.losses
        ]
        parts = {topic: next(iter(row.parts.values())) for topic, row in lost.items()}
        assert sorted(said) == sorted(
            (lost[topic].name, topic, part.messages, part.first, part.last)
            for topic, part in parts.items()
        )
        for topic, part in parts.items():
            found = {name: ask() for name, ask in doors(store, topic).items()}
            assert found == dict.fromkeys(found, COUNT - part.messages)
            missing = store.topic(topic).completeness()
            assert (missing.messages, missing.is_exact) == (part.messages, True)
            with pytest.raises(IncompleteError, match=f"{part.messages} messages are lost"):
                missing.check()
        for other in {*TOPICS} - {*lost}:
            assert len([*store.topic(other)]) == right[f"{other} count"]
        checked = store.verify()
        assert checked.messages == entry.messages
        (finding,) = checked.findings
        assert (finding.place, finding.cure) == (file.name, RESTORE)
        assert store.verify(repair=True).findings == [finding]
        told = answer("info", "log", "--losses", "--mongo", "none", store=gone)
        assert file.name in str(told)
        path.write_bytes(whole)
        for topic in lost:
            found = {n: ask() for n, ask in doors(store, topic).items() if n != "info"}
            assert found == dict.fromkeys(found, COUNT)
    assert answers(gone) == right


@pytest.mark.parametrize("at", FLIPS.values(), ids=FLIPS)
def test_a_flipped_byte_is_an_error_where_it_is_read(gone: Path, at: int) -> None:
    file, topic = rows_of(gone, 1)
    flip(recording_of(gone) / file.name, at)
    shutil.rmtree(gone / "tables")
    with hl.open(gone, mongo="none") as store:
        asked = doors(store, topic)
        for name in ("count", "between", "sql topics", "info"):  # by the chunk table
            assert asked.pop(name)() == COUNT
        for ask in asked.values():
            with pytest.raises(StoreError, match=rf"{file.name} is damaged.*[Rr]estore"):
                ask()
        for other in {*TOPICS} - {topic}:
            assert [*store.topic(other)]
        (finding,) = store.verify().findings
        assert (finding.place, finding.cure) == (file.name, RESTORE)


@pytest.mark.parametrize("fault", [cut, lambda path: flip(path, 900)])
def test_a_copy_with_the_file_brings_it_back(
    gone: Path, tmp_path: Path, fault: Callable[[Path], None]
) -> None:
    right = answers(gone)
    with hl.open(tmp_path / "lab", create=True, mongo="none") as lab:
        bring(lab, gone)
    for path in row_files(gone):
        fault(path)
    with hl.open(tmp_path / "lab", mongo="none") as lab:
        assert lab.copy(gone, None, CopyOptions(check=True)).copied == ["log"]
    assert answers(gone) == right
    with hl.open(gone, mongo="none") as store:
        assert store.verify().findings == []


@pytest.mark.parametrize("fault", [cut, lambda path: flip(path, 900)])
def test_rows_that_are_lost_before_their_log_goes_are_made_again(
    copy: Path, fault: Callable[[Path], None]
) -> None:
    right = answers(copy)
    with hl.open(copy, mongo="none") as store:
        (entry,) = store.recordings()
        with store.directory.writing(entry.id, entry.name):
            keep.make_rows(store.directory, entry.id)
    file, _ = rows_of(copy, 1)
    fault(recording_of(copy) / file.name)
    logs = {path: path.read_bytes() for path in recording_of(copy).glob("*.mcap")}
    expire(copy, [0, 1])
    assert answers(copy) == right
    left = next(path for path in logs if not path.exists())
    with hl.open(copy, mongo="none") as store:
        checked = store.verify()
        assert checked.findings == []
        stored = sum(path.stat().st_size for path in recording_of(copy).iterdir())
        assert 0.9 * stored < checked.bytes_read < 1.1 * stored
        left.write_bytes(logs[left])
        (finding,) = store.verify().findings
        assert (finding.place, finding.problem) == (left.name, "the manifest does not list it")
        mended = store.verify(repair=True)
        assert not left.exists()
        assert mended.findings == []
