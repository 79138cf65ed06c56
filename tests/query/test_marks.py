"""Marks with an end, and events of Foxglove, as intervals."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import foxglove
import pytest
from foxglove.channels import EventChannel, LogChannel
from foxglove.messages import Event, KeyValuePair, Log, Timestamp
from mcap.reader import make_reader
from msgspec import structs
from starlette.testclient import TestClient

import hybridlog as hl
from hybridlog.query.answers.interval_queries import marks_in
from hybridlog.record.marks import MARK_CHANNEL, MARKS_SEGMENT, mark_payload, with_marks
from hybridlog.view.guard import Admission
from hybridlog.view.server import make_app
from hybridlog_storage.errors import SegmentError, StoreError, TimeError, UsageError
from hybridlog_storage.manifest import MAX_MARKS, Mark, replace
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.chunk_table import places_of
from tests import places
from tests.cli.within import answer
from tests.independent import write_mcap

S = 10**9
BEGIN = 1000
"""Log time of the first message, s; one a second follows."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    folder = tmp_path_factory.mktemp("marks")
    log = folder / "events.mcap"
    json_event = foxglove.Schema(name="foxglove.Event", encoding="jsonschema", data=b"{}")
    with foxglove.open_mcap(str(log)):
        said, events = LogChannel("/log"), EventChannel("/events")
        other = foxglove.Channel("/json", schema=json_event, message_encoding="json")
        for number in range(100):
            said.log(Log(message=str(number)), log_time=(BEGIN + number) * S)
        pairs = [KeyValuePair(key="name", value="turn"), KeyValuePair(key="way", value="left")]
        events.log(
            Event(
                start_time=Timestamp(BEGIN + 10, 5),
                end_time=Timestamp(BEGIN + 20, 0),
                metadata=pairs,
            ),
            log_time=(BEGIN + 30) * S,
        )
        moment = {"sec": BEGIN + 50, "nsec": 0}
        value: dict[str, Any] = {"start_time": moment, "end_time": moment, "metadata": []}
        other.log(json.dumps(value).encode(), log_time=(BEGIN + 50) * S)
    with hl.open(folder / "store", create=True, mongo="none") as store:
        store.record(log, name="drive")
        store.mark("drive", "+60s", "carpet", {"floor": "soft"}, until="+64s")
        yield store


def times(query: hl.Query) -> list[int]:
    return [one.log_time_ns // S - BEGIN for one in query]


def test_marks_are_intervals_of_questions(store: hl.Store) -> None:
    said = store.topic("log")
    carpet = "/hybridlog/marks: text = 'carpet'"
    assert times(said.where(carpet, within="0s")) == [60, 61, 62, 63, 64]
    assert times(said.where(carpet, within="1s")) == [59, 60, 61, 62, 63, 64, 65]
    # The mark begins before the range, and the event's message comes after it.
    assert times(said.between("+63s", "+70s").where(carpet, within="0s")) == [63, 64]
    turn = "/events: metadata[*].value = 'left'"
    assert times(said.between("+15s", "+17s").where(turn, within="0s")) == [15, 16]
    found = store.topic("events").windows()
    assert [(one.begin_ns, one.end_ns) for one in found] == [
        ((BEGIN + 10) * S + 5, (BEGIN + 20) * S)
    ]
    assert times(said.during(found)) == [*range(11, 20)]
    assert times(said.where("not /json: end_time.sec > 0", within="0s"))[49:52] == [49, 51, 52]
    with pytest.raises(UsageError, match="needs a length"):
        said.windows()


def test_a_mark_is_removed(store: hl.Store, tmp_path: Path) -> None:
    path = Path(shutil.copytree(store.directory.path, tmp_path / "store"))
    with hl.open(path, mongo="none") as opened:
        opened.mark("drive", "+70s", "carpet")
        opened.mark("drive", "+80s", "stairs")
        with pytest.raises(UsageError, match="no mark 'floor'"):
            opened.unmark("drive", "floor")
        with pytest.raises(UsageError, match="at this time"):
            opened.unmark("drive", "carpet", "+71s")
    answer("mark", "carpet", "-r", "drive", "--at", "+70s", "--remove", store=path)
    answer("mark", "carpet", "-r", "drive", "--until", "+70s", "--remove", store=path, code=2)
    marks = "/hybridlog/marks"
    with hl.open(path, mongo="none") as opened:
        assert [m.text for m in opened.entry("drive").manifest.marks] == ["carpet", "stairs"]
        assert times(opened.topic(marks)) == [60, 80]
        opened.unmark("drive", "carpet")
        assert times(opened.topic(marks)) == [80]
        opened.unmark("drive", "stairs")
        assert marks not in opened.topics()
        opened.mark("drive", "+90s", "end")
        assert times(opened.topic(marks)) == [90]
        assert opened.verify().findings == []
        assert len(opened.topic("log").to_arrow()) == 100


def test_marks_that_were_set_meanwhile_are_not_taken_for_others(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        write_mcap(tmp_path / "a.mcap", [(Channel("/n", "json", None), BEGIN * S, b"{}")])
        store.record(tmp_path / "a.mcap", name="drive")
        one, two = (
            with_marks(store.mark("drive", "+0s", text)).flushed[MARKS_SEGMENT]
            for text in ("carpet", "stairs")
        )
        (place,) = places_of(one.table)
        assert len(one.reader.read_chunk(place).batch) == 1
        with pytest.raises(SegmentError, match="Ask again"):
            two.reader.read_chunk(place)


def test_marks_answer_as_messages_do(tmp_path: Path) -> None:
    """Those that a recorder noted, and those that were set, in every format and count."""
    said = [(BEGIN + 3, "b", {"k": "1"}, None), (BEGIN + 2, "a", {}, BEGIN + 7)]
    answers = []
    for are_set in (False, True):
        path = tmp_path / str(are_set)
        with hl.open(path, create=True, mongo="none") as store:
            with store.start("drive") as recording:
                for number in range(10):
                    time = (BEGIN + number) * S
                    recording.write(NUMBERS, b'{"n": %d}' % number, log_time=time)
                for begin, text, tags, end in [] if are_set else said:
                    payload = mark_payload(text, tags, None if end is None else end * S)
                    recording.write(MARK_CHANNEL, payload, log_time=begin * S)
            for begin, text, tags, end in said if are_set else []:
                until = None if end is None else f"+{end - BEGIN}s"
                store.mark("drive", f"+{begin - BEGIN}s", text, tags, until=until)
        answers.append([*_answers(path)])
    messages, marks = answers
    assert marks == messages


NUMBERS = Channel("/n", "json", None)


def _answers(path: Path) -> Iterator[object]:
    for form in ("jsonl", "csv", "json", "table"):
        yield answer("fetch", "-t", "marks", "-F", form, store=path).out
    yield answer("fetch", "-t", "*", "--reverse", "--limit", "8", "-F", "jsonl", store=path).out
    yield answer("fetch", "-t", "marks", "--between", "+2.5s", "end", "--count", store=path).out
    yield answer("stats", "-t", "marks", store=path).out
    for question in (
        ("intervals", "-t", "marks", "--where", "text = 'a'"),
        ("fetch", "-t", "/n", "--where", "/hybridlog/marks: tags.k = '1'", "--within", "1s"),
        ("sql", "select t, end_t, text, tags from marks order by t"),
        ("sql", 'select t, pub, text, "end", tags_.k from hybridlog__marks order by seq % 2'),
    ):
        yield answer(*question, store=path).out
    out = path.with_suffix(".mcap")
    answer("fetch", "-t", "*", "-F", "mcap", "-o", str(out), store=path)
    with out.open("rb") as file:
        yield [
            (channel.topic, schema and schema.name, message.log_time, message.data)
            for schema, channel, message in make_reader(file).iter_messages()
        ]
    with hl.open(path, mongo="none") as store:
        marks = store.topic("marks")
        yield store.topics(), store.entry("drive").messages, store.entry("drive").span
        yield [(m.log_time_ns, m.publish_time_ns, m.fields) for m in marks.reverse()]
        yield marks.between("+2s", "+3s").count(), marks.where("text = 'b'").count()
        yield marks.to_arrow().to_pylist(), [*marks.completeness().sentences]
        yield [(one.begin_ns, one.end_ns) for one in marks.windows()]
        yield store.topic("*").count(), marks.at("+4s").fields, marks.at("+2.5s").fields
        yield str(marks.completeness()), store.verify().findings


def test_a_recording_has_ten_thousand_marks(store: hl.Store, tmp_path: Path) -> None:
    path = Path(shutil.copytree(store.directory.path, tmp_path / "store"))
    many = [Mark(f"{n:016x}", (BEGIN + n % 90) * S + n, f"mark {n}") for n in range(MAX_MARKS)]
    with hl.open(path, mongo="none") as opened:
        manifests, (entry,) = opened.directory.manifests, opened.recordings()
        manifests.change(entry.id, lambda now: replace(now, marks=tuple(many)))
        with pytest.raises(StoreError, match="10,000 marks, the most that a recording can have"):
            opened.mark("drive", "+5s", "too much")
    answer("mark", "again", "-r", "drive", "--at", "+5s", store=path, code=5)
    with hl.open(path, mongo="none") as opened:
        marks = opened.topic("/hybridlog/marks")
        assert marks.count() == len(marks.to_arrow()) == MAX_MARKS
        assert [m.fields["text"] for m in marks.where("text = 'mark 777'")] == ["mark 777"]
        opened.unmark("drive", "mark 777")
        opened.mark("drive", "+5s", "room again")
        assert marks.where("text = 'mark 777' or text = 'room again'").count() == 1


def test_marks_in_sql_and_in_the_timeline(store: hl.Store) -> None:
    rows = store.sql("select t, end_t, text, tags from marks order by t").to_arrow().to_pylist()
    found = [(row["t"], row["end_t"], row["text"], dict(row["tags"])) for row in rows]
    assert found == [
        ((BEGIN + 10) * S + 5, (BEGIN + 20) * S, "turn", {"name": "turn", "way": "left"}),
        ((BEGIN + 50) * S, None, "", {}),
        ((BEGIN + 60) * S, (BEGIN + 64) * S, "carpet", {"floor": "soft"}),
    ]
    app = make_app(store, Admission(token="a-token", port=4242))
    client = TestClient(app, base_url="http://127.0.0.1:4242/a-token/")
    info = client.get("recording", params={"recording": "drive"}).json()
    assert [(one["at"], one["end"], one["text"]) for one in info["marks"]] == [  # by log time
        (10 * S + 5, 20 * S, "turn"),
        (50 * S, 50 * S, ""),
        (60 * S, 64 * S, "carpet"),
    ]


def test_a_mark_ends_after_it_begins(store: hl.Store) -> None:
    with pytest.raises(TimeError, match="cannot end before it begins"):
        store.mark("drive", "+5s", "x", until="+4s")
    (mark,) = store.entry("drive").manifest.marks
    assert mark.end - mark.time == 4 * S
    manifest = places.manifest(store.directory.path, "drive")
    wrong = [structs.replace(one, end=one.time - 1) for one in manifest.marks]
    with pytest.raises(ValueError, match="ends before it begins"):
        replace(manifest, marks=tuple(wrong))


def test_an_odd_event_is_a_mark_where_its_message_is(tmp_path: Path) -> None:
    """Times and metadata of JSON that are none are left out."""
    odd: list[dict[str, Any]] = [
        {"start_time": {"sec": "x"}, "end_time": [], "metadata": [5, {"key": "name"}]},
        {"start_time": {"sec": 10**30}, "end_time": 10**30, "metadata": "x"},
        {"start_time": None, "metadata": [{"key": "name", "value": ["a"]}]},
    ]
    event = foxglove.Schema(name="foxglove.Event", encoding="jsonschema", data=b"{}")
    with foxglove.open_mcap(str(tmp_path / "odd.mcap")):
        channel = foxglove.Channel("/odd", schema=event, message_encoding="json")
        for number, value in enumerate(odd):
            channel.log(json.dumps(value).encode(), log_time=(BEGIN + number) * S)
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        (recording,) = [store.record(tmp_path / "odd.mcap", name="odd").entry.id]
        found = [*marks_in(store.session, [recording])]
    assert [(one.begin, one.end) for one in found] == [
        ((BEGIN + number) * S, None) for number in range(len(odd))
    ]
