"""What a running recording has and an answer has not: a number, or the flush interval."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.errors import IncompleteError
from tests.cli.running import run
from tests.indexed import documents_of
from tests.limits import Limit
from tests.live.speaker import talking, text, text_channel, wait_until_flushed

SECOND = 1_000_000_000
CHANNEL = text_channel("/a")


TOLD = "live is being recorded: 3 messages not written yet"


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A store with a recording: of /a two messages are flushed and three are not, of /b one."""
    with talking(tmp_path_factory.mktemp("live") / "store") as (robot, store):
        robot.say("/a", "2", time=2 * SECOND)
        robot.say("/quiet", "0", time=1 * SECOND)
        wait_until_flushed(store, 3)
        robot.hold()
        robot.say("/a", "3", "4", "5", time=3 * SECOND)
        robot.say("/b", "6", time=3 * SECOND)
        yield store


def test_the_number_is_that_of_the_topics_asked(live: hl.Store) -> None:
    query = live.topic("/a")
    assert query.count() == 2
    assert [*query.completeness().sentences] == [f"{TOLD}, nor in this answer."]
    assert query.completeness().unwritten == 3
    assert not query.completeness().has_losses
    with pytest.raises(IncompleteError, match="3 messages not written yet"):
        query.completeness().check()
    quiet = live.topic("/quiet")
    assert not quiet.completeness().sentences
    assert quiet.completeness().unwritten == 0
    quiet.completeness().check()
    # An alignment tells it once for all topics.
    aligned = live.align("/a", ["/quiet"])
    aligned.to_arrow()
    told = [line for line in aligned.remarks() if "being recorded" in line]
    assert told == [f"{TOLD}, nor in this answer."]
    # An answer that is full lacks nothing that comes later.
    for limit, lacks in ((1, False), (2, False), (3, True)):
        query = live.topic("/a").limit(limit)
        assert len(list(query)) == min(limit, 2)
        assert bool(query.completeness().sentences) == lacks
    last = live.topic("/a").limit(1).reverse()
    list(last)
    assert last.completeness().sentences


def test_it_is_told_only_where_the_time_reaches_past_the_last_flush(live: hl.Store) -> None:
    query = live.topic("/a")
    whole = live.topic("/a").windows(after="1s")
    early = query.between(None, 2 * SECOND).windows(after="500ms")
    for part, unwritten in (
        (query.between("start", "end"), 3),
        (query.between(None, 2 * SECOND + 1), 3),
        (query.between("+1s", None), 3),
        (query.between(None, 2 * SECOND), 0),
        (query.between("start", "-1s"), 0),
        (query.during(whole), 3),
        (query.during(whole).between(None, 2 * SECOND), 0),
        (query.during(early), 0),
        (query.between(None, 2 * SECOND).clock("header"), 3),
    ):
        assert part.completeness().unwritten == unwritten, part
        assert len(part.completeness().sentences) == (unwritten > 0)
    options = ["fetch", "-t", "/a", "--count", "--strict", "--between", "start"]
    done = run(*options, "2000000000ns", store=live.directory.path)
    assert (done.out, "not written" in done.err) == ("1\n", False)
    assert TOLD.partition(": ")[2] in run(*options, "end", store=live.directory.path, code=11).err


def test_every_command_tells_it(live: hl.Store, tmp_path: Path) -> None:
    for words in (
        ["fetch", "-t", "/a", "--count"],
        ["fetch", "-t", "/a", "--where", "data == '2'"],
        ["check", "-t", "/a"],
        ["intervals", "-t", "/a", "--gaps"],
        ["intervals", "-t", "/a", "--where", "data == '2'"],
        ["intervals", "-t", "/a", "--changes", "data"],
        ["export", tmp_path / "a.mcap", "-t", "/a"],
        ["sql", "select count(*) from a"],
    ):
        done = run(*words, store=live.directory.path)
        assert TOLD in done.err, (words, done.err)
        assert "lost" not in done.err


def test_without_a_socket_it_is_told_in_words(tmp_path: Path) -> None:
    path = tmp_path / "store"
    with hl.open(path, create=True) as store:
        recording = store.start("own", flush_interval_s=0.5)
        for number in (1, 2):
            recording.write(CHANNEL, text("x"), log_time=number * SECOND)
        wait_until_flushed(store, 2)
        query = store.topic("/a")
        assert [*query.completeness().sentences] == [
            "own is being recorded: up to 0.5 s not written yet, nor in this answer."
        ]
        assert query.completeness().unwritten is None
        assert not query.completeness().has_losses
        with pytest.raises(IncompleteError, match=r"up to 0\.5 s not written yet"):
            query.completeness().check()
        query.between(None, 2 * SECOND).completeness().check()
        assert "up to 0.5 s not written yet" in run("fetch", "-t", "/a", "--count", store=path).err
        recording.close()
        assert not query.completeness().sentences
        assert query.completeness().unwritten == 0
        query.completeness().check()


@pytest.mark.mongo
def test_what_the_index_lacks_is_told_where_mongodb_answers(tmp_path: Path, limit: Limit) -> None:
    limit(index_interval=lambda _: 3600.0)
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        recording = store.start("own", flush_interval_s=0.1)
        for number in range(5):
            recording.write(CHANNEL, text("x"), log_time=(1 + number) * SECOND)
        wait_until_flushed(store, 5)
        query = store.topic("/a")
        documents = documents_of(store, "/a")
        late = f"{5 - len(documents)} messages of own are not in the index"
        assert len(documents) < 5
        raw = query.where({"data": "x"})
        assert raw.count() == len(documents)
        assert any(late in line for line in raw.completeness().sentences)
        with pytest.raises(IncompleteError, match=late):
            raw.between(None, 5 * SECOND + 1).completeness().check()
        # What others answer is whole.
        same = query.where("data == 'x'")
        assert same.count() == len(list(same)) == 5
        assert same.counters.unindexed == 0
        recording.close()
        assert raw.count() == 5
        assert raw.counters.unindexed == 0
