"""Choosing recordings: against the same choice made one recording at a time."""

from __future__ import annotations

import json
import random
from collections.abc import Collection
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.maintenance.opening import StoreFiles
from hybridlog.snapshot import Snapshot, differing
from hybridlog_storage.catalog import RecordingSummary, TopicType, hash_of, topics_to_json
from hybridlog_storage.cells import CATALOG, Cells
from hybridlog_storage.errors import TopicError
from hybridlog_storage.manifest import replace
from hybridlog_storage.manifests import DiskManifests
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_reader import SegmentReader
from tests import places
from tests.calls import Calls
from tests.limits import Limit

TOPICS = [f"/{name}" for name in "abcd"]


def topics_of(text: str) -> tuple[TopicType, ...]:
    return tuple(TopicType(*values) for values in json.loads(text))


def summary(number: int, span: tuple[int, int] | None, topics: list[str], **other: Any) -> Any:
    kinds = topics_to_json(TopicType(topic, "json", "", "") for topic in topics)
    values: dict[str, Any] = {
        "id": f"20261128-run-{number:016x}",
        "name": f"r{number}",
        "tags": {},
        "source": {},
        "created": 0,
        "status": "complete",
        "span": span,
        "extent": (0, 0) if span is None else (span[0], span[1] + 1),
        "topics": hash_of(kinds),
        "topic_count": len(topics),
        "messages": 1,
        "stored_bytes": 1,
        "segments": 1,
        "has_losses": False,
        "has_lost_segments": False,
        "expired": 0,
        "notes": [],
        "not_copied": 0,
        "look": "",
        **other,
    }
    return RecordingSummary(**values), kinds


SPANS = st.none() | st.tuples(st.integers(0, 50), st.integers(0, 20)).map(
    lambda pair: (pair[0], pair[0] + pair[1])
)
MANY = st.lists(st.tuples(SPANS, st.lists(st.sampled_from(TOPICS), unique=True)), max_size=12)


@given(MANY, st.lists(st.sampled_from(TOPICS)))
def test_recordings_are_chosen_by_topic(
    found: list[tuple[tuple[int, int] | None, list[str]]], topics: list[str]
) -> None:
    made = [summary(number, span, held) for number, (span, held) in enumerate(found)]
    kinds = {one.topics: topics_of(text) for one, text in made}
    snapshot = Snapshot([one for one, _ in made], kinds)
    order = sorted(
        range(len(found)),
        key=lambda n: (found[n][0] is None, found[n][0] or (0, 0), f"r{n}"),
    )
    assert [one.name for one in snapshot.summaries] == [f"r{n}" for n in order]
    assert snapshot.topics == sorted({topic for _, held in found for topic in held})
    having = snapshot.having(topics)
    wanted = [n for n in order if set(found[n][1]) & set(topics)]
    assert [one.name for one in having] == [f"r{n}" for n in wanted]
    assert snapshot.having(topics, [one.id for one in having]) == having
    examples = differing(having)
    assert {frozenset(snapshot.topics_of([one])) for one in examples} == {
        frozenset(found[n][1]) for n in wanted
    }
    assert len(examples) == len({frozenset(found[n][1]) for n in wanted})


# Messages of recordings that overlap here and there.


@pytest.fixture(scope="module")
def overlapping(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Fourteen recordings, and the log times of their messages."""
    path = tmp_path_factory.mktemp("overlapping")
    dice = random.Random(5)
    times: dict[str, list[int]] = {}
    with hl.open(path / "store", create=True) as store:
        for number in range(14):
            begin = 10**9 + number * 10_000 + dice.choice([0, 0, -15_000, 9_000])
            length = 45_000 if number == 4 else 8_000
            own = sorted(begin + dice.randrange(length) for _ in range(30))
            with store.start(str(number)) as recording:
                for n, time in enumerate(own):
                    recording.write(Channel("/n", "json", None), b'{"n": %d}' % n, log_time=time)
            times[recording.id] = own
        yield store, times


@pytest.mark.parametrize("more", [1, 2, 64])
@pytest.mark.parametrize("backwards", [False, True])
def test_messages_are_in_order_however_recordings_are_grouped(
    overlapping: Any, limit: Limit, more: int, backwards: bool
) -> None:
    limit(planner_group_growth=more)
    store, times = overlapping
    wanted = sorted(
        (time, recording, n) for recording, own in times.items() for n, time in enumerate(own)
    )
    query = store.topic("/n")
    if backwards:
        query, wanted = query.reverse(), wanted[::-1]

    def seen(asked: hl.Query) -> list[tuple[int, str, int]]:
        return [(m.log_time_ns, m.recording, m.fields["n"]) for m in asked]

    assert seen(query) == wanted
    assert seen(query.limit(50)) == wanted[:50]
    assert seen(query.every(7)) == wanted[::7]
    begin, end = wanted[40][0], wanted[300][0]
    low, high = min(begin, end), max(begin, end)
    cut = [one for one in wanted if low <= one[0] < high]
    assert seen(query.between(low, high)) == cut
    assert query.between(low, high).count() == len(cut)
    assert query.between(low, high).to_pandas()["n"].tolist() == [n for *_, n in cut]
    late = [one for one in wanted if one[2] >= 20]
    assert seen(query.where("n >= 20")) == late
    moment = wanted[77][0]
    assert store.topic("/n").at(moment).log_time_ns == moment


def test_a_store_without_a_catalog_is_listed_by_its_manifests(tmp_path: Path, calls: Calls) -> None:
    """No log is opened, and the catalog is written at once; an edit reads one manifest."""
    path, source = tmp_path / "store", Channel("/n", "json", Schema("n", "jsonschema", b"{}"))
    with hl.open(path, create=True, mongo="none") as store:
        for number in range(5):
            with store.start(f"run {number}", tags={"n": str(number)}) as recording:
                for time in range(number):
                    recording.write(source, b'{"n":1}', log_time=10**18 + time)
        store.mark("run 2", "start", "here")
        store.edit("run 3", note="seen")
        wanted, entries = (
            store.session.look().summaries,
            [one.messages for one in store.recordings()],
        )
    (path / CATALOG).unlink()
    opened, written = calls(SegmentReader, "_records"), calls(Cells, "write")
    with hl.open(path, mongo="none") as store:
        assert store.session.look().summaries == wanted
        assert (len(opened), len(written), store.topics()) == (0, 1, ["/hybridlog/marks", "/n"])
        assert [one.messages for one in store.recordings()] == entries
        assert not opened
        store.shared.catalog.summaries()
        read, listed = calls(DiskManifests, "_get"), calls(Cells, "each")
        for step in ({"note": "more"}, {"tag": {"k": "v"}}, {"name": "run 4"}, {"name": "z"}):
            store.edit("run 4", **step)
        assert (len(opened), [one for one in listed if isinstance(one[-1], str)]) == (0, [])
        assert len(read) <= 4 * 4
        assert max(one.name for one in store.shared.catalog.summaries()) == "z"


def test_a_recording_is_read_when_its_turn_comes(overlapping: Any, calls: Calls) -> None:
    store, _ = overlapping
    read = calls(StoreFiles, "see")
    store.refresh()
    next(iter(store.topic("/n")))
    assert 1 <= len(read) < 6
    with pytest.raises(TopicError):
        store.entry("nothing")


def test_topics_that_another_process_changes_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer is of one moment, the next one of the newest."""
    path = tmp_path / "store"
    with hl.open(path, create=True, mongo="none") as store:
        for name in ("a", "b"):
            with store.start(name) as recording:
                recording.write(Channel(f"/{name}", "json", None, {}), b"{}", log_time=10**18)
    with hl.open(path, mongo="none") as store, hl.open(path, mongo="none") as other:
        assert len(store.recordings()) == 2
        places.change_in(places.folder(path, "b"), lambda now: replace(now, tags={"seen": "yes"}))
        ask = store.shared.catalog.damaged

        def asked(recordings: Collection[str]) -> Any:
            monkeypatch.undo()
            other.mark("a", "start", "a topic of its own")
            store.shared.catalog.summaries()
            return ask(recordings)

        monkeypatch.setattr(store.shared.catalog, "damaged", asked)
        store.shared.invalidate()
        assert [one.topic_count for one in store.session.look().summaries] == [1, 1]
        assert store.topic("/a").count() == store.topic("/b").count() == 1
        store.refresh()
        assert [one.topic_count for one in store.session.look().summaries] == [2, 1]
