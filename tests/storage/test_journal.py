"""The journal: its lines, what damage does to them, and when they are on the disk."""

from __future__ import annotations

import errno
import json
import os
import random
import string
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlog_storage import journal
from hybridlog_storage.disk import files
from hybridlog_storage.errors import DiskFullError, StoreError
from hybridlog_storage.journal import (
    ADOPTED,
    BEGUN,
    ENDED,
    JOURNAL,
    MARKED,
    NOTED,
    PINNED,
    REBUILT,
    REMOVING,
    RENAMED,
    SEALED,
    TAGGED,
    UNPINNED,
    UNTAGGED,
    Journal,
    JournalState,
    decode,
    encode,
    event,
    parse,
)
from tests import odd_values
from tests.limits import Limit
from tests.storage.steps import Steps, name_of, through

ID = "0123456789abcdef" * 2
STORE = "5" * 32
PAYLOADS: dict[str, Any] = {
    "file": "topic=a/b.parquet",
    "bytes": 90,
    "digest": "sha256:b",
    "topic": "/a",
    "messages": 7,
}


def begun(**other: Any) -> dict[str, Any]:
    values = {
        "id": ID,
        "store": STORE,
        "name": "rün",
        "tags": {"place": "lab"},
        "source": {"path": "/x"},
        "created": 2**62,
        "origin": {},
    }
    return event(BEGUN, **{**values, **other})


def sealed(number: int, digest: str = "sha256:a", **other: Any) -> dict[str, Any]:
    counted = {"id": 1, "topic": "/a", "messages": 5 + number, "payload_bytes": 50}
    values = {
        "segment": number,
        "file": f"{number:06d}.mcap",
        "bytes": 1000 + number,
        "digest": digest,
        "channels": [{**counted, "first": -5, "last": 2**62}],
    }
    return event(SEALED, **{**values, **other})


def whole_life() -> list[dict[str, Any]]:
    """A journal with each kind of event."""
    return [
        begun(),
        sealed(0),
        sealed(1),
        event(ENDED, end={"status": "complete", "losses": []}),
        event(RENAMED, name="new"),
        event(TAGGED, key="who", value="me"),
        event(TAGGED, key="place", value="hall"),
        event(UNTAGGED, key="place"),
        event(NOTED, text="wind\nand rain"),
        event(MARKED, time=-7, text="slipped", tags={"a": "b"}, segment=2),
        sealed(2),
        event(ADOPTED, store="6" * 32),
        event(PINNED, id="a", **{"from": -7, "to": 9}, topics=["/a"], reason="slipped"),
        event(PINNED, id="b"),
        event(UNPINNED, id="b"),
        event("expired", anything=[1, {"b": None}]),
        event("compacted", files=[PAYLOADS]),
        event("of another version"),
        event(REMOVING, by=5),
    ]


def state_of(*lines: Mapping[str, Any]) -> JournalState:
    return parse(b"".join(map(encode, lines)))


# The format of a line.


def test_a_line_is_checksum_space_json_line_feed() -> None:
    line = encode({"event": "noted", "at": 5, "text": "ä\n"})
    assert line == b"%08x %b\n" % (zlib.crc32(line[9:-1]), line[9:-1])
    assert json.loads(line[9:-1]) == {"event": "noted", "at": 5, "text": "ä\n"}
    assert line.count(b"\n") == 1
    assert decode(line[:-1]) == {"event": "noted", "at": 5, "text": "ä\n"}


def test_an_event_says_when_it_happened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "time", SimpleNamespace(time_ns=lambda: 77))
    assert event("noted", text="x") == {"event": "noted", "at": 77, "text": "x"}


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.text()
    | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
EVENTS = st.dictionaries(st.text(), VALUES, max_size=5).map(lambda v: {**v, "event": "x"})


@given(EVENTS)
def test_what_is_written_is_read(line: dict[str, Any]) -> None:
    written = encode(line)
    assert written.count(b"\n") == 1
    assert decode(written[:-1]) == line


@given(st.lists(EVENTS, max_size=6))
def test_lines_are_read_one_by_one(lines: list[dict[str, Any]]) -> None:
    data = b"".join(map(encode, lines))
    assert list(journal.read_lines(data)) == list(enumerate(lines, 1))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "\ud800", {1, 2}, b"x"])
def test_what_json_cannot_say_is_not_written(value: object) -> None:
    with pytest.raises((ValueError, TypeError)):
        encode({"event": "x", "value": value})


@given(st.binary(max_size=60))
def test_bytes_that_are_no_journal_say_nothing(data: bytes) -> None:
    state = parse(data)
    assert state == JournalState(
        damaged=state.damaged, lines=data.count(b"\n"), length=state.length, torn=state.torn
    )
    assert state.damaged == list(range(1, data.count(b"\n") + 1))
    assert state.length + state.torn == len(data)
    assert not state.is_proof


@pytest.mark.parametrize(
    "text",
    [b"", b"5", b"[]", b"null", b'"event"', b"{}", b'{"event":5}', b"{", b"\xff", b"[" * 100_000],
)
def test_a_line_that_is_no_event_is_damaged_whatever_its_checksum(text: bytes) -> None:
    line = b"%08x %b" % (zlib.crc32(text), text)
    assert decode(line) is None
    state = parse(encode(begun()) + line + b"\n" + encode(sealed(0)))
    assert state.damaged == [2]
    assert state.sealed.keys() == {0}


@pytest.mark.parametrize("change", [str.upper, lambda s: s.replace(" ", "\t"), lambda s: " " + s])
def test_a_checksum_is_written_in_one_way(change: Callable[[str], str]) -> None:
    lines = (encode({**begun(), "n": n})[:-1].decode() for n in range(1000))
    line = next(line for line in lines if not line[:8].isdigit())
    head = change(line[:9])
    assert head != line[:9]
    assert decode((head + line[9:]).encode()) is None


# What a whole journal says.


def test_a_whole_life() -> None:
    lines = whole_life()
    state = state_of(*lines)
    assert (state.id, state.store, state.name) == (ID, "6" * 32, "new")
    assert state.begun == lines[0]
    assert state.tags == {"who": "me"}
    assert state.notes == [{"at": lines[8]["at"], "text": "wind\nand rain"}]
    assert state.marks == [{"time": -7, "text": "slipped", "tags": {"a": "b"}, "segment": 2}]
    assert {n: (s.file, s.bytes, s.digest, s.messages) for n, s in state.sealed.items()} == {
        n: (f"{n:06d}.mcap", 1000 + n, "sha256:a", 5 + n) for n in range(3)
    }
    assert state.sealed[1].channels == tuple(lines[2]["channels"])
    assert state.sealed[1].at == lines[2]["at"]
    pin = {"id": "a", "from": -7, "to": 9, "topics": ["/a"], "reason": "slipped"}
    assert state.pins == {"a": pin}
    assert state.end == {"status": "complete", "losses": []}
    assert state.removing
    assert (state.moving, state.rebuilt, state.replaced) == (None, None, [])
    assert (state.lines, state.torn, state.damaged) == (len(lines), 0, [])
    assert state.length == sum(len(encode(line)) for line in lines)
    assert state.is_proof


def test_only_what_was_there_all_the_time_is_a_proof() -> None:
    assert state_of(begun()).is_proof
    assert not parse(b"").is_proof
    assert not state_of(begun(), event(REBUILT, reason="it was not there")).is_proof
    assert state_of(begun(), event(REBUILT, reason="it")).rebuilt == "it"
    assert not state_of(sealed(0)).is_proof
    assert not parse(encode(begun()) + b"damaged\n").is_proof


def test_a_journal_without_its_beginning_says_so() -> None:
    state = state_of(sealed(0), event(NOTED, text="x"))
    assert state.damaged == [0]
    assert state.sealed.keys() == {0}
    assert state.notes
    # A beginning that comes later is none.
    late = state_of(sealed(0), begun())
    assert late.damaged == [0]
    assert not late.is_proof
    assert parse(b"damaged\n" + encode(sealed(0))).damaged == [1]


def test_a_second_beginning_changes_nothing() -> None:
    other = begun(id="f" * 32, name="other", tags={"x": "y"}, store="7" * 32)
    state = state_of(begun(), other)
    assert state.damaged == [2]
    assert (state.id, state.name, state.tags, state.store) == (ID, "rün", {"place": "lab"}, STORE)
    assert not state.is_proof


def test_a_segment_that_came_out_of_a_crash_otherwise_is_remembered() -> None:
    state = state_of(begun(), sealed(0, "sha256:a"), sealed(0, "sha256:a"))
    assert state.replaced == []
    state = state_of(begun(), sealed(0, "sha256:a"), sealed(0, "sha256:b", bytes=7))
    ((before, after),) = state.replaced
    assert (before.digest, after.digest) == ("sha256:a", "sha256:b")
    assert state.sealed[0] == after
    assert after.bytes == 7


def test_a_mark_whose_segment_is_not_listed_was_told_in_vain() -> None:
    def mark(text: str, segment: int) -> dict[str, Any]:
        return event(MARKED, time=1, text=text, tags={}, segment=segment)

    assert state_of(begun(), mark("a", 1)).marks == []
    state = state_of(begun(), mark("cut short", 1), mark("again", 1), sealed(1))
    assert [m["text"] for m in state.marks] == ["again"]
    state = state_of(begun(), mark("a", 1), sealed(1), mark("b", 2), sealed(2), mark("c", 3))
    assert [m["text"] for m in state.marks] == ["a", "b"]


def test_a_renaming_says_which_label_becomes_which() -> None:
    state = state_of(begun(), event(RENAMED, name="x", **{"from": "a", "to": "b"}))
    assert (state.name, state.moving) == ("x", ("a", "b"))
    done = event(RENAMED, name="x")
    state = state_of(begun(), event(RENAMED, name="x", **{"from": "a", "to": "b"}), done)
    assert (state.name, state.moving) == ("x", None)


# Events that lack something.


def incomplete() -> Iterator[tuple[str, dict[str, Any]]]:
    """Each event, with one thing in it missing, of another type, or impossible."""
    needed = {
        BEGUN: ("id", "store", "name", "tags"),
        SEALED: ("segment", "file", "bytes", "digest", "channels"),
        ENDED: ("end",),
        RENAMED: ("name",),
        TAGGED: ("key", "value"),
        UNTAGGED: ("key",),
        NOTED: ("at", "text"),
        MARKED: ("time", "text", "tags", "segment"),
        UNPINNED: ("id",),
        ADOPTED: ("store",),
        REBUILT: ("reason",),
    }
    complete: dict[str, dict[str, Any]] = {}
    for line in [*whole_life(), event(REBUILT, reason="x")]:
        complete.setdefault(line["event"], line)
    for kind, names in needed.items():
        line = complete[kind]
        for name in names:
            yield f"{kind} without {name}", {k: v for k, v in line.items() if k != name}
            for wrong in (None, 5.5, [[]], {"a": 5}, True):
                if (name, wrong) == ("end", {"a": 5}):
                    continue
                yield f"{kind} {name} {wrong}", {**line, name: wrong}
    for wrong in ("", "0" * 31, "0" * 33, "g" * 32, "A" * 32):
        yield f"id {wrong}", {**complete[BEGUN], "id": wrong}
    for name, wrong in (("id", 5), ("from", 0.5), ("to", -9), ("topics", "/a"), ("reason", 1)):
        yield f"pin {name} {wrong}", {**complete[PINNED], name: wrong}
    for wrong in ("../000000.mcap", "/etc/passwd", "a/b", "", "..", "."):
        yield f"file {wrong}", {**complete[SEALED], "file": wrong}
    (counted,) = complete[SEALED]["channels"]
    for name in counted:
        channels = [{k: v for k, v in counted.items() if k != name}]
        yield f"channel without {name}", {**complete[SEALED], "channels": channels}
    yield "channel", {**complete[SEALED], "channels": ["x"]}
    yield "only to", event(RENAMED, name="other", to="b")
    yield "only from", event(RENAMED, name="other", **{"from": "a"})
    yield "from", event(RENAMED, name="other", **{"from": 5, "to": "b"})
    for wrong in ("../b", "a/b", "", ".", ".removed-b", "a\0b"):
        yield f"to {wrong}", event(RENAMED, name="other", **{"from": "a", "to": wrong})


INCOMPLETE = dict(incomplete())


@pytest.mark.parametrize("case", INCOMPLETE)
def test_an_event_that_lacks_something_is_damaged_and_changes_nothing(case: str) -> None:
    line = INCOMPLETE[case]
    before = [] if line["event"] == BEGUN else [begun(), sealed(7, "sha256:z")]
    state = state_of(*before, line, event(NOTED, at=5, text="after"))
    assert state.damaged == [len(before) + 1], line
    assert not state.is_proof
    without = state_of(*before, event("of another version"), event(NOTED, at=5, text="after"))
    without.damaged = [n for n in without.damaged if n]  # of the beginning
    state.damaged, state.length = without.damaged, without.length
    assert state == without


# Odd values, with a checksum that is right.


def as_written(line: Any) -> bytes:
    """A line as another program may write it: with NaN, and halves of surrogate pairs."""
    text = json.dumps(line, separators=(",", ":")).encode()
    return b"%08x %b\n" % (zlib.crc32(text), text)


FULL = [
    line if line["event"] != ENDED else {**line, "end": {
        "status": "damaged", "cut_bytes": 5, "damage": ["torn"], "later": [{"a": 1.5}],
        "losses": [{
            "cause": "segment", "file": "x", "offset": 5, "length": None, "reason": "r",
            "count": 3, "topic": "/a", "from": -5, "to": 2**62, "later": None,
        }],
    }}
    for line in [*whole_life(), event(RENAMED, name="a", **{"from": "a", "to": "b"}),
                 event("compacted", segments=[{"segment": 1, "digest": "d", "bytes": 7}])]
]  # fmt: skip


@settings(max_examples=600)
@given(st.sampled_from(odd_values.places(FULL)), odd_values.VALUES | st.just(...))
def test_an_odd_value_damages_its_line_or_can_be_kept_anywhere(
    place: tuple[int, odd_values.Path], value: Any
) -> None:
    number, path = place
    line = FULL[number]
    odd = (
        odd_values.without(line, path) if value is ... else odd_values.with_value(line, path, value)
    )
    state = parse(b"".join(map(as_written, [*FULL[:number], odd, *FULL[number + 1 :]])))
    kept = {field: getattr(state, field) for field in ("begun", "name", "tags", "notes", "end")}
    kept["marks"], kept["pins"] = state.marks, [*state.pins.values()]
    kept["sealed"] = [asdict(segment) for segment in state.sealed.values()]
    kept["payloads"] = [asdict(file) for file in state.payloads.values()]
    kept["thinned"], kept["moving"] = [*state.thinned.values()], state.moving
    encode({"event": "x", **kept})
    bson.encode(kept)
    for name in state.moving or ():
        assert Path("recordings", name).parent == Path("recordings")
        assert not name.startswith(".")
    if number + 1 in state.damaged and number:
        rest = [*FULL[:number], event("of another version"), *FULL[number + 1 :]]
        without = parse(b"".join(map(as_written, rest)))
        without.damaged, without.length = state.damaged, state.length
        assert state == without


# Damage.


LINES = whole_life()
DATA = b"".join(map(encode, LINES))


def events_of(data: bytes) -> list[dict[str, Any]]:
    return [line for _, line in journal.read_lines(data) if line is not None]


def is_noticed(state: JournalState) -> bool:
    return bool(state.damaged or state.torn)


@pytest.mark.parametrize(
    "turn", [0, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in range(1, 8))]
)
def test_every_flipped_bit_is_noticed_and_gives_never_another_event(turn: int) -> None:
    for byte in range(len(DATA)):
        bit = 8 * byte + (byte + turn) % 8
        data = bytearray(DATA)
        data[byte] ^= 1 << bit % 8
        found = events_of(bytes(data))
        # One line is lost, or two that became one, and the others are what they were.
        assert len(LINES) - 2 <= len(found) < len(LINES), bit
        left = iter(LINES)
        assert all(any(line == wanted for wanted in left) for line in found), bit
        assert is_noticed(parse(bytes(data))), bit


def test_every_cut_is_noticed_and_gives_never_another_event() -> None:
    starts = [0]
    for line in LINES:
        starts.append(starts[-1] + len(encode(line)))
    for size in range(len(DATA)):
        state = parse(DATA[:size])
        whole = max(n for n, start in enumerate(starts) if start <= size)
        assert events_of(DATA[:size]) == LINES[:whole]
        assert (state.length, state.torn) == (starts[whole], size - starts[whole])
        assert state.damaged == []
        # Between two lines nothing in the journal can tell: what lies beside it does.
        assert is_noticed(state) == (size not in starts)


def test_what_is_cut_out_or_doubled_in_the_middle_is_noticed() -> None:
    rng = random.Random(4)
    for _ in range(3000):
        start, end = sorted(rng.sample(range(len(DATA)), 2))
        data = DATA[:start] + DATA[end:] if rng.random() < 0.5 else DATA[:end] + DATA[start:]
        assert all(line in LINES for line in events_of(data))
        # Lines that are gone or doubled as a whole are told by what lies beside the journal.
        if not set(data.splitlines(keepends=True)) <= {encode(line) for line in LINES}:
            assert is_noticed(parse(data))


@given(st.binary(min_size=1, max_size=40), st.integers(0, len(DATA)))
def test_what_is_written_into_it_gives_no_event(junk: bytes, at: int) -> None:
    data = DATA[:at] + junk + DATA[at:]
    assert all(line in LINES for line in events_of(data))
    if junk.strip(b"\n"):
        assert is_noticed(parse(data))


# Appending.


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "store" / "recordings" / "run"
    path.mkdir(parents=True)
    return path


def test_appended_is_what_is_read(folder: Path) -> None:
    assert journal.read(folder) is None
    log = Journal(folder)
    for line in LINES[:3]:
        log.append(line)
    log.append(*LINES[3:])
    assert (folder / JOURNAL).read_bytes() == DATA
    assert journal.read(folder) == parse(DATA)


def test_a_check_sees_what_was_appended_before_and_keeps_a_line_out(folder: Path) -> None:
    def check(state: JournalState) -> None:
        if state.pins:
            raise StoreError("it is pinned")

    careful = Journal(folder, check=check)
    Journal(folder).append(begun())
    careful.append(event("expired"))
    Journal(folder).append(event(PINNED, id="a"))
    before = (folder / JOURNAL).read_bytes()
    with pytest.raises(StoreError, match="pinned"):
        careful.append(event("expired"))
    assert (folder / JOURNAL).read_bytes() == before


def test_lines_of_several_writers_are_whole(folder: Path) -> None:
    Journal(folder).append(begun())
    notes = [event(NOTED, text=f"{n} " + "x" * n) for n in range(60)]
    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda note: Journal(folder, sync=False).append(note), notes))
    state = journal.read(folder)
    assert state is not None
    assert not state.damaged
    assert sorted(n["text"] for n in state.notes) == sorted(n["text"] for n in notes)


@pytest.mark.parametrize("torn", [1, 8, 9, 30, 99_000])
def test_a_torn_last_line_is_cut_at_the_next_append(folder: Path, torn: int) -> None:
    path = folder / JOURNAL
    # Longer than what is looked at once, too.
    line = encode(event(NOTED, text=string.ascii_letters * 2000))
    path.write_bytes(DATA + line[:torn])
    state = journal.read(folder)
    assert state is not None
    assert state.torn == torn
    assert path.read_bytes() == DATA + line[:torn]
    note = event(NOTED, text="after")
    Journal(folder).append(note)
    assert path.read_bytes() == DATA + encode(note)


def test_a_line_of_which_only_the_end_is_missing_was_not_written(folder: Path) -> None:
    path = folder / JOURNAL
    path.write_bytes(DATA[:-1])
    Journal(folder).append()
    assert path.read_bytes() == b"".join(map(encode, LINES[:-1]))


def test_a_journal_of_one_torn_line_begins_anew(folder: Path) -> None:
    path = folder / JOURNAL
    path.write_bytes(encode(begun())[:50])
    Journal(folder).append(begun())
    assert len(events_of(path.read_bytes())) == 1
    assert parse(path.read_bytes()).torn == 0


def test_a_line_is_on_the_disk_before_append_returns(folder: Path) -> None:
    with through(steps := Steps()):
        Journal(folder).append(begun())
    assert steps.log == [
        ("create", JOURNAL), ("write", JOURNAL), ("sync", JOURNAL), ("sync", "run"),
    ]  # fmt: skip
    with through(steps := Steps()):
        Journal(folder).append(sealed(0), sealed(1))
    # The folder knows the name already.
    assert steps.log == [("create", JOURNAL), ("write", JOURNAL), ("sync", JOURNAL)]


def test_what_is_cut_off_is_cut_before_anything_is_written(folder: Path) -> None:
    (folder / JOURNAL).write_bytes(DATA + b"torn")
    with through(steps := Steps()):
        Journal(folder).append(event(NOTED, text="x"))
    assert [what for what, _ in steps.log] == ["create", "truncate", "write", "sync"]


def test_without_sync_nothing_is_synced(folder: Path) -> None:
    with through(steps := Steps()):
        Journal(folder, sync=False).append(begun())
    assert [what for what, _ in steps.log] == ["create", "write"]
    assert parse((folder / JOURNAL).read_bytes()).is_proof


class Filling(files.System):
    """A disk on which there is room for so many more bytes."""

    def __init__(self, room: int, number: int = errno.ENOSPC) -> None:
        self.room = room
        self.number = number

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        whole = b"".join(parts)[: self.room]
        if not whole:
            raise OSError(self.number, os.strerror(self.number))
        self.room -= len(whole)
        return os.write(fd, whole)


@pytest.mark.parametrize("room", [0, 1, 9, 100, 200])
def test_a_full_disk_leaves_the_journal_as_it_was(folder: Path, room: int) -> None:
    path = folder / JOURNAL
    path.write_bytes(DATA)
    lines = [event(NOTED, text="x" * 60), event(NOTED, text="y" * 60)]
    assert sum(len(encode(line)) for line in lines) > 200
    with through(Filling(room)), pytest.raises(DiskFullError, match="No space left"):
        Journal(folder).append(*lines)
    assert path.read_bytes() == DATA
    Journal(folder).append(*lines)
    assert path.read_bytes() == DATA + b"".join(map(encode, lines))


def test_a_full_disk_leaves_no_half_line_of_a_new_journal(folder: Path) -> None:
    with through(Filling(40)), pytest.raises(DiskFullError):
        Journal(folder).append(begun())
    assert (folder / JOURNAL).read_bytes() == b""
    with through(steps := Steps()):
        Journal(folder).append(begun())
    # Its name may not be on the disk yet.
    assert ("sync", "run") in steps.log
    assert journal.read(folder) == parse((folder / JOURNAL).read_bytes())


class Unsynced(files.System):
    """A disk that cannot keep a file."""

    def sync(self, fd: int) -> None:
        if name_of(fd) == JOURNAL:
            raise OSError(errno.EIO, "input/output error")


def test_what_is_not_on_the_disk_does_not_stand_there(folder: Path) -> None:
    path = folder / JOURNAL
    path.write_bytes(DATA)
    with through(Unsynced()), pytest.raises(StoreError, match=JOURNAL):
        Journal(folder).append(event(NOTED, text="x"))
    assert path.read_bytes() == DATA


def test_a_journal_that_cannot_be_written_is_told(folder: Path) -> None:
    with through(Filling(0, errno.EROFS)), pytest.raises(StoreError, match="Not allowed"):
        Journal(folder).append(begun())


@pytest.mark.parametrize("kind", ["symlink", "folder", "fifo"])
def test_only_an_ordinary_file_is_a_journal(folder: Path, tmp_path: Path, kind: str) -> None:
    path, elsewhere = folder / JOURNAL, tmp_path / "elsewhere"
    elsewhere.write_bytes(DATA)
    if kind == "symlink":
        path.symlink_to(elsewhere)
    elif kind == "folder":
        path.mkdir()
    else:
        os.mkfifo(path)
    with pytest.raises(StoreError, match=JOURNAL):
        journal.read(folder)
    if kind != "fifo":
        with pytest.raises(StoreError, match=JOURNAL):
            Journal(folder).append(begun())
    assert elsewhere.read_bytes() == DATA


def test_one_that_is_too_large_is_not_read(folder: Path, limit: Limit) -> None:
    (folder / JOURNAL).write_bytes(DATA)
    limit(max_journal=len(DATA))
    assert journal.read(folder) is not None
    limit(max_journal=len(DATA) - 1)
    with pytest.raises(StoreError, match="too large"):
        journal.read(folder)


# Writing it again.


def test_one_that_is_written_again_is_whole_or_as_it_was(folder: Path) -> None:
    path = folder / JOURNAL
    path.write_bytes(DATA[:500])
    lines = [begun(), event(REBUILT, reason="x")]
    with through(steps := Steps()):
        Journal(folder).replace(lines)
    assert path.read_bytes() == b"".join(map(encode, lines))
    assert (folder / "journal.old").read_bytes() == DATA[:500]
    assert [(what, name) for what, name in steps.log if what in {"rename", "sync"}][-2:] == [
        ("rename", JOURNAL), ("sync", "run"),
    ]  # fmt: skip
    total = len(steps.log)
    for at in range(total):
        path.write_bytes(DATA)
        (folder / "journal.old").unlink(missing_ok=True)
        with through(Steps(fail_from=at)), pytest.raises((StoreError, DiskFullError)):
            Journal(folder).replace(lines)
        now = path.read_bytes()
        assert now in {DATA, b"".join(map(encode, lines))}, at
        if now != DATA:
            assert (folder / "journal.old").read_bytes() == DATA
        for left in folder.glob(".journal*"):
            left.unlink()


def test_one_that_was_not_there_leaves_no_old_one(folder: Path) -> None:
    Journal(folder).replace([begun()])
    assert sorted(p.name for p in folder.iterdir()) == [JOURNAL]
