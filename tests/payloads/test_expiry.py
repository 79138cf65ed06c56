"""Payloads expire; fields, counts and times stay, in every state of a recording."""

from __future__ import annotations

import hashlib
import shutil
from collections import Counter
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.entries import put_entry
from hybridlog.maintenance import keep
from hybridlog_storage.errors import IncompleteError
from hybridlog_storage.manifest import replace, with_rows
from tests import places
from tests.cli.within import answer
from tests.format_reader import FormatReader
from tests.payloads.logs import COUNT, recording_of
from tests.power import dies

TOPICS = ["/cloud", "/image", "/number", "/scan"]


def expire(store: Path, groups: Collection[int]) -> Counter[str]:
    """Delete logs of the only recording of a store: those of its first or of its second group.

    Returns:
        Messages whose payloads went, by topic.
    """
    with hl.open(store) as opened:
        (entry,) = opened.recordings()
        manifest = opened.directory.manifests.read(entry.id)
        logs = manifest.logs.values()
        firsts = sorted({log.group for log in logs})
        numbers = [log.number for log in logs if firsts.index(log.group) in groups]
        with opened.directory.writing(entry.id, entry.name):
            keep.expire(opened.directory, entry.id, numbers)
            put_entry(opened.directory, opened.shared.catalog, entry.id)
    gone = Counter[str]()
    for log in logs:
        for number, part in log.parts.items() if log.is_here and log.number in numbers else ():
            gone[manifest.channels[number].topic] += part.messages
    return gone


def answers(path: Path) -> dict[str, Any]:
    """What must not change when payloads expire."""
    found: dict[str, Any] = {}
    with hl.open(path, mongo="none") as store:
        found["status"] = [(r.status, r.messages, r.span) for r in store.recordings()]
        for topic in TOPICS:
            query = store.topic(topic)
            found[f"{topic} count"] = query.count()
            found[f"{topic} between"] = query.between("+1s", "+3s").count()
            found[f"{topic} fields"] = [
                (m.log_time_ns, m.publish_time_ns, m.sequence, m.seq, m.fields) for m in query
            ]
        scans = store.topic("/scan")
        found["where"] = scans.where("ranges.min < 1.3").count()
        found["intervals"] = [*scans.where("ranges.max > 2.8").intervals()]
        found["table"] = scans.fields("angle_min", "header.stamp").to_arrow().to_pylist()
        text = "select t, seq, angle_min, ranges_summary.max from scan order by seq"
        found["sql"] = store.sql(text).rows()
        found["sql between"] = store.sql(text, between=("+1s", "+3s")).rows()
        assert len(found["sql between"]) == found["/scan between"]
    return found


def row_files(store: Path) -> list[Path]:
    return sorted(recording_of(store).glob("*.rows.parquet"))


def logs(store: Path) -> dict[str, bytes]:
    """The segments that are there, with their content."""
    return {path.name: path.read_bytes() for path in recording_of(store).glob("*.mcap")}


def test_what_an_expiry_left_is_removed_by_the_next_writer(copy: Path) -> None:
    whole, right = logs(copy), answers(copy)
    expire(copy, [0])
    left, rows = logs(copy), row_files(copy)
    segment = recording_of(copy) / "000001.mcap"
    loose = recording_of(copy) / "000003.rows.parquet"
    for beside, data in ((segment, whole["000001.mcap"]), (loose, b"half")):
        beside.write_bytes(data)
        with hl.open(copy, mongo="none", read_only=True) as store:
            assert store.topic("/cloud").count() == COUNT
            assert store.recordings()[0].status == "complete"
        assert beside.exists()
        assert answers(copy) == right
        with hl.open(copy, mongo="none") as store:
            store.shared.recover()
        assert (logs(copy), row_files(copy)) == (left, rows)
    # What the manifest lists in its place is gone: nothing else of it is removed.
    (recording_of(copy) / "000001.rows.parquet").unlink()
    segment.write_bytes(whole["000001.mcap"])
    with hl.open(copy, mongo="none") as store:
        assert store.recordings()[0].status == "damaged"
        found = {one.place: one.problem for one in store.verify().findings}
        assert found["000001.rows.parquet"] == "it is missing"
    assert segment.exists()


@pytest.mark.parametrize("old", ["without", "whole"])
def test_a_lost_manifest_is_made_again_of_what_has_expired(copy: Path, old: str) -> None:
    right = answers(copy)
    before = places.manifest_of(recording_of(copy)).read_bytes()
    expire(copy, [0, 1])
    listed = places.manifest(copy, "log")
    path = recording_of(copy) / "manifest.old"
    path.unlink()
    if old == "whole":
        path.write_bytes(before)
    places.manifest_of(path.parent).unlink()
    with hl.open(copy, mongo="none") as store:
        store.verify(repair=True)
        assert [one.place for one in store.verify().findings] == ["manifest"]
    assert answers(copy) | {"status": 0} == right | {"status": 0}
    made = places.manifest(copy, "log")
    assert made.status == "unproven"
    when = {one.name: one.written for one in listed.files}  # which no file of a log says
    found = [replace(one, written=when[one.name]) for one in made.files]
    assert sorted(found, key=str) == sorted(listed.files, key=str)


@pytest.mark.parametrize("kind", ["log", "rows"])
def test_another_file_than_the_listed_one_is_found(copy: Path, kind: str) -> None:
    """Also if it has the size of the listed one, and all of its own checksums are right."""
    expire(copy, [0])
    listed = places.manifest(copy, "log")
    if kind == "log":
        one = replace(listed.logs[3], digest="0" * 64)
        changed, place = with_rows(listed, one, ()), "000003.mcap byte "
    else:
        first, *others = listed.rows[1]
        one = replace(first, digest="0" * 64)
        changed = with_rows(listed, listed.logs[1], [one, *others])
        place = one.name
    places.write_in(recording_of(copy), changed)
    with hl.open(copy, mongo="none") as store:
        assert store.recordings()[0].status == "complete"
        (found,) = store.verify().findings
        assert found.place.startswith(place)
        assert "the manifest lists" in found.problem
        assert store.verify(repair=True).findings == [found]


CHANGES = frozenset({"writev", "pwritev", "truncate", "sync", "rename", "unlink", "rmdir", "mkdir"})


@pytest.mark.parametrize(
    "stride", [25, pytest.param(1, marks=pytest.mark.exhaustive)], ids=["some", "all"]
)
def test_a_death_at_any_step_is_finished_or_undone(copy: Path, tmp_path: Path, stride: int) -> None:
    right = answers(copy)
    step, seen, lived = 0, set(), False
    while not lived:
        place = tmp_path / f"at {step}"
        shutil.copytree(copy, place)
        lived = not dies(step, partial(expire, place, [0, 1]), only=CHANGES)
        with hl.open(place, mongo="none") as store:
            store.shared.recover()  # finishes or undoes it
            assert not store.verify().findings
            listed = {file.name for file in places.manifest(place, "log").files if file.is_here}
            assert logs(place).keys() | {path.name for path in row_files(place)} == listed
            states = [message.state.value for message in store.all_topics()]
        assert answers(place) == right
        seen.add(states.count("expired"))
        expire(place, [0, 1])
        with hl.open(place, mongo="none") as store:
            assert {message.state.value for message in store.all_topics()} == {"expired"}
            assert store.verify().findings == []
        assert answers(place) == right
        shutil.rmtree(place)
        step += stride
    assert step > 40
    assert len(seen) > 3  # none, those of a log, of several, of all


def test_strict_answers_need_payloads(copy: Path) -> None:
    with hl.open(copy, mongo="none") as store:
        store.topic("/scan").completeness().check(payloads=True)
    done = expire(copy, [0])
    with hl.open(copy, mongo="none") as store:
        query = store.topic("/scan")
        assert query.completeness().reduced == done["/scan"]
        with pytest.raises(IncompleteError, match=f"{done['/scan']} messages"):
            query.completeness().check(payloads=True)
        query.completeness().check()
        asked = query.where("ranges[3] > 0")
        asked.count()
        with pytest.raises(IncompleteError, match=f"{done['/scan']} messages could not"):
            asked.completeness().check()
        query.between("-0.1s", "end").completeness().check(payloads=True)
    words = ("--count", "--strict", "--mongo", "none", "--where")
    answer("fetch", "-t", "/scan", *words, "ranges.min > 0", store=copy)
    answer("fetch", "-t", "/scan", *words, "ranges[3] > 0", store=copy, code=11)


def test_statistics_of_other_fields_stay(copy: Path) -> None:
    """An array that is gone takes nothing from the count of what is asked beside it."""
    fields = ("ranges", "angle_min", "ranges.min")

    def stats() -> tuple[list[Any], list[str]]:
        with hl.open(copy, mongo="none") as store:
            query = store.topic("/scan")
            return query.stats(*fields), [*query.completeness().sentences]

    before, _ = stats()
    gone = expire(copy, [0])["/scan"]
    found, remarks = stats()
    by_field = {one.field: one for one in found}
    assert [by_field[name] for name in fields[1:]] == [
        one for one in before if one.field in fields[1:]
    ]
    assert by_field["angle_min"].count == by_field["ranges.min"].count == COUNT
    with hl.open(copy, mongo="none") as store:
        left = [len(one.decode().ranges) for one in store.topic("/scan") if not one.is_reduced]
    assert len(left) == COUNT - gone
    ranges = by_field["ranges"]
    assert ranges.count + ranges.nan + ranges.infinite == sum(left)
    assert sum(f"{gone} messages have no long arrays" in one for one in remarks) == 1


def test_the_second_reader_tells_what_is_left(copy: Path) -> None:
    """By the specification: size, hash and fields of each expired message."""

    def told() -> list[Any]:
        recording = FormatReader(copy).recording("log")
        assert (recording.status, recording.damage, recording.losses) == ("complete", {}, [])
        return [message for _, message in recording.messages()]

    with hl.open(copy, mongo="none") as store:
        fields = {message.seq: message.fields for message in store.all_topics()}
    before = {message.seq: message for message in told()}
    expire(copy, [0])
    gone = 0
    for message in told():
        was = before.pop(message.seq)
        assert message[1:-1] == was[1:-1]
        if message.payload != was.payload:
            row: Any = message.payload
            of, digest = row["ref"], hashlib.sha256(was.payload).digest()
            assert (of["len"], of["sha256"]) == (len(was.payload), digest)
            assert not of["surplus"]
            for name, value in fields[message.seq].items():
                if isinstance(value, dict) and "n" in value:
                    assert row[name] is None
                    assert row[f"{name}_summary"] == value
                elif name not in {"header", "fields"}:
                    assert row[name] == value
            gone += 1
    assert not before
    assert gone == 167
