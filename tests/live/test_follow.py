"""Messages of running recordings as they come: each once, until the recordings end."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.errors import UsageError
from tests.cli.running import COMMAND, environment, run
from tests.live.speaker import talking, wait_until_flushed
from tests.waiting import wait_for


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "store"


class Followed:
    """A command that follows, and its lines."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.lines: list[str] = []
        self.notes = ""
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(iter(self.process.stdout.readline, ""))

    def join(self) -> None:
        self._reader.join(60)

    def wait(self, lines: int) -> list[str]:
        wait_for(lambda: len(self.lines) >= lines)
        return self.lines

    def ended(self) -> int:
        """Wait for the end; returns the exit code."""
        assert self.process.stderr is not None
        self.notes = self.process.stderr.read()
        self.join()
        assert "Traceback" not in self.notes
        return self.process.wait(60)

    @property
    def texts(self) -> list[str]:
        return [json.loads(line)["data"] for line in self.lines]


@contextmanager
def follow(store: Path, *arguments: object) -> Iterator[Followed]:
    command = [*COMMAND, "fetch", "--store", str(store), "--follow", *map(str, arguments)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    ) as process:
        followed = Followed(process)
        try:
            yield followed
        finally:
            process.kill()
            followed.join()


def test_each_message_comes_once_whenever_it_was_sent(path: Path) -> None:
    with talking(path) as (one, store):
        following = store.topic("/a").follow()
        one.say("/a", "3 s", time=3_000_000_000)
        assert next(following).fields["data"] == "3 s"
        # It comes later, and its log time lies before what was given.
        one.say("/a", "2 s", time=2_000_000_000)
        assert next(following).fields["data"] == "2 s"
        one.say("/a", "4 s", "5 s", time=4_000_000_000)
        assert [m.fields["data"] for m in islice(following, 2)] == ["4 s", "5 s"]
        one.say("/a", "last", time=1_500_000_000)
        one.recorder.stop()
        assert [message.fields["data"] for message in following] == ["last"]


def test_each_mark_comes_once_whatever_is_removed_meanwhile(path: Path) -> None:
    with talking(path) as (one, store), hl.open(path) as other:
        (name,) = [found.name for found in store.session.look().summaries]
        for number in range(3):
            other.mark(name, "start", f"before {number}")
        following = store.topic("marks").follow()
        other.unmark(name, "before 1")
        other.mark(name, "start", "first")
        assert next(following).fields["text"] == "first"
        other.unmark(name, "before 0")
        other.mark(name, "+0s", "second")
        one.say("/a", "later", time=2_000_000_000)
        other.mark(name, "+1s", "third")
        assert [m.fields["text"] for m in islice(following, 2)] == ["second", "third"]
        one.recorder.stop()
        assert [*following] == []


def test_it_goes_on_while_segments_are_sealed(path: Path) -> None:
    said = [str(number) for number in range(60)]
    with talking(path, segment_s=0.3, flush_s=0.1) as (one, store):
        following = store.topic("/a").between("start", "end").follow()

        def speak() -> None:
            for word in said:
                one.say("/a", word)
                time.sleep(0.02)
            one.recorder.stop()

        speaking = threading.Thread(target=speak)
        speaking.start()
        found = [message.fields["data"] for message in following]
        speaking.join()
        assert found == ["first", *said]
        (entry,) = store.recordings()
        assert entry.segments > 2


def test_conditions_limits_and_ranges_hold(path: Path) -> None:
    second = 1_000_000_000
    with talking(path) as (one, store):
        topic = store.topic("/a")
        some = topic.where("data in ['b', 'c']").follow()
        two = topic.limit(2).follow()
        thirds = topic.every(3).follow()
        whole = topic.between("start", "end").follow()
        late = topic.between("+2s", 6 * second).follow()
        one.say("/a", "a", time=2 * second)
        one.say("/a", "b", time=3 * second)
        one.say("/a", "c", time=5 * second)
        one.say("/a", "d", time=6 * second)
        assert [m.fields["data"] for m in two] == ["a", "b"]
        one.recorder.stop()
        found = [[m.fields["data"] for m in each] for each in (some, thirds, whole, late)]
        assert found == [["b", "c"], ["a", "d"], ["first", "a", "b", "c", "d"], ["b", "c"]]


def test_globs_take_topics_that_appear_later(path: Path) -> None:
    with talking(path) as (one, store):
        every = store.topic("/*").follow("/*")
        named = store.topic("/a").follow("/a")
        one.say("/new", "of a new topic")
        first = next(every)
        assert (first.topic, first.fields["data"]) == ("/new", "of a new topic")
        one.say("/a", "x")
        assert next(every).topic == next(named).topic == "/a"
        one.recorder.stop()
        assert list(every) == list(named) == []


def test_what_has_no_end_yet_is_refused(path: Path) -> None:
    with talking(path) as (one, store):
        topic = store.topic("/a")
        for asked in (
            topic.reverse(),
            topic.between("start", "-1s"),
            topic.during(topic.windows(after=1)),
            topic.where({"data": "x"}),
        ):
            with pytest.raises(UsageError):
                asked.follow()
        with pytest.raises(UsageError, match="snapshot"):
            store.snapshot().topic("/a").follow()
        one.recorder.stop()
        with pytest.raises(UsageError, match="none of those asked about"):
            topic.follow()


def test_the_command_prints_lines_and_ends_with_the_recording(path: Path) -> None:
    mongo = ("--mongo", "mongodb://127.0.0.1:9/?serverSelectionTimeoutMS=200")
    with (
        talking(path) as (one, _),
        follow(path, "-t", "/*", "--between", "start", "end") as all_of_it,
        follow(path, "-t", "a", "-r", "live", "--where", "data != 'b'", "-F", "csv", *mongo) as csv,
    ):
        csv.wait(1)  # it has begun: the header
        one.say("/a", "b", "c")
        one.say("/b", "d")
        assert csv.wait(2)[1].endswith(',"c"\n')
        all_of_it.wait(4)
        assert sorted(all_of_it.texts) == ["b", "c", "d", "first"]
        one.recorder.stop()
        assert (all_of_it.ended(), csv.ended()) == (0, 0)
        assert "live has ended: complete." in all_of_it.notes
        assert len(csv.lines) == 2


def test_a_killed_recorder_ends_it(path: Path) -> None:
    with (
        talking(path) as (one, _),
        follow(path, "-t", "a", "--between", "start", "end") as followed,
    ):
        one.say("/a", "flushed")
        followed.wait(2)
        one.kill()
        assert followed.ended() == 0
        assert followed.texts == ["first", "flushed"]
        assert "live has ended: cut short by a crash" in followed.notes


def test_the_command_refuses_what_makes_no_sense(path: Path) -> None:
    with talking(path) as (one, _):
        for options in (
            ["--reverse"],
            ["--count"],
            ["--strict"],
            ["--at", "+1s"],
            ["-o", path / "x.jsonl"],
            ["--format", "parquet"],
            ["--format", "table"],
            ["--where", "/a: data == 'x'", "--within", "1s"],
        ):
            done = run("fetch", "-t", "a", "--follow", *options, store=path, code=2)
            assert not done.out
        assert "no topic '/z'" in run("fetch", "-t", "/z", "--follow", store=path, code=2).err
        one.recorder.stop()
        assert "none of those asked" in run("fetch", "-t", "a", "--follow", store=path, code=2).err


def test_only_what_was_flushed_since_and_is_in_the_range_is_read(path: Path) -> None:
    second = 1_000_000_000
    with talking(path) as (one, store):
        for number in range(2, 8):
            one.say("/a", str(number), time=number * second)
            wait_until_flushed(store, number)
        query = store.topic("/a").between("-2s", "end")
        following = query.follow()
        assert [m.fields["data"] for m in islice(following, 2)] == ["6", "7"]
        assert query.counters.chunks_read == 2
        for number in (8, 9):
            one.say("/a", str(number), time=number * second)
            assert next(following).fields["data"] == str(number)
        assert query.counters.chunks_read == 4
        past = store.topic("/a").between(2 * second, 4 * second).follow()
        assert [m.fields["data"] for m in past] == ["2", "3"]
        one.recorder.stop()
        assert list(following) == []
