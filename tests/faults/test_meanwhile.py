"""What another process does between two looks at the store."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.errors import TopicError
from hybridlog_storage.mongo.index_state import IndexState
from tests import places
from tests.calls import Calls
from tests.faults.cases import Bench
from tests.faults.scenarios import scenario
from tests.faults.stores import Case, look


@pytest.fixture
def case(bench: Bench) -> Iterator[Case]:
    with scenario(bench, "tag").prepared.copy(bench.server, bench.path / "meanwhile") as copy:
        yield copy


def once(action: Callable[[], object], calls: Calls, looking: str = "looks") -> None:
    """Have something happen after all recordings were looked at."""
    done: list[object] = []

    def looked(found: object, *_: object) -> object:
        if not done:
            done.append(action())
        return found

    calls.change(StoreDirectory, looking, looked)


def test_a_recording_that_is_removed_is_no_unreadable_one(
    case: Case, monkeypatch: pytest.MonkeyPatch, calls: Calls
) -> None:
    once(lambda: StoreDirectory(case.path).manifests.remove(places.id_of(case.path, "a")), calls)
    with case.open() as store:
        assert {entry.name for entry in store.recordings()} == {"b"}
        assert not store.repairs.unreadable
    monkeypatch.undo()
    assert look(case).recordings.keys() == {"b"}


def test_what_the_index_lacks_while_documents_go(case: Case) -> None:
    with case.open() as store:
        database = store.connect()
        query = store.topic("/number").where("n >= 0")
        whole = query.count()
        state = IndexState(database)
        (entry,) = store.select(["a"])
        with store.directory.writing(entry.id):  # as the other process does
            state.begin(entry)
            database.delete("number", {"_meta.rec": entry.key})
            own = store.topic("/number").where({"n": {"$gte": 0}})
            lacks = store.query(["/number"], ["a"]).count()
            assert (own.count(), own.counters.unindexed) == (whole - lacks, lacks)
            # The messages themselves tell.
            assert query.count() == whole
            assert query.counters.documents_read == 0
            assert len(list(query)) == whole
            assert query.at("end").fields["n"] >= 0
            # Questions without a predicate or about the other recording need no payload scan.
            assert store.topic("/number").count() == whole
            assert len(list(store.topic("/number"))) == whole
            assert store.query(["/number"], ["b"]).where("n >= 0").count() > 0
        store.index.rebuild(["a"])
        assert (own.count(), own.counters.unindexed) == (whole, 0)


def test_what_goes_while_it_is_counted_is_noticed(case: Case, calls: Calls) -> None:
    from hybridlog_storage.mongo.database import Database

    with case.open() as store, case.open() as other:
        store.connect()
        other.connect()
        query = store.query(["/number"], ["a"]).where({"$expr": {"$gte": ["$n", 0]}})
        whole = query.count()
        asked: list[tuple[object, ...]] = calls(
            Database, "each", lambda *_: other.remove("a") if len(asked) == 1 else None
        )
        assert query.count() + query.counters.unindexed == whole
        assert query.counters.unindexed > 0
        with pytest.raises(TopicError, match="removed from the store"):
            query.count()
        with pytest.raises(TopicError):
            store.query(["/number"], ["a"])


def test_a_log_whose_last_segment_is_empty_is_recorded(bench: Bench) -> None:
    state = scenario(bench, "tag").before
    assert state.recordings["a"].entry["segments"] > len(state.recordings["a"].entry["spans"])
