"""What a manifest may hold, and how it is written."""

from __future__ import annotations

import json

import pytest
from blake3 import blake3
from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.errors import StoreError
from hybridlog_storage.manifest import (
    MAX_MARKS,
    Channel,
    File,
    Loss,
    Manifest,
    Mark,
    Note,
    Part,
    Pin,
    Source,
    decode,
    encode,
    free_name,
    is_id,
    name_of,
    new_id,
    new_random,
    replace,
)
from tests.limits import limits

ID = "20261128-robot-3f9a12bc04d7e615"
MARK = "00112233445566aa"
DIGEST = "ab" * 32
WHOLE = Manifest(
    id=ID,
    name="Roboter 7",
    created=1_700_000_000_000_000_001,
    changes=12,
    status="complete",
    source=Source("rosbag1", "/data/robot.bag", "ros1", "sha256:1", 1 << 40),
    tags={"site": "hall 3", "weather": ""},
    notes=(Note(5, "left wheel slips"),),
    marks=(Mark(MARK, 7, "bump", {"side": "left"}, 9), Mark("00112233445566ab", 7, "")),
    pins=(Pin(MARK, 1, 2, ("/scan",), "incident"), Pin("00112233445566ab")),
    channels={0: Channel("/scan", "ros1", "a/Scan", {"callerid": "/n"}, 5, 6, 7, 8)},
    files=(
        File(0, 0, "000000.mcap", "log", 9, DIGEST, 1, 7, 8, {0: Part(5, 6, 7, 8)}),
        File(1, 0, "000001.scan.mcap", "log", 9, DIGEST, 1, gone="elsewhere", copy="s3://lab/x"),
        File(1, 0, "000001.rows.parquet", "rows", 9, DIGEST, 1),
    ),
    losses=(Loss("transport", "/scan", None, 1, 2, "gap"),),
)


def stored(text: bytes) -> bytes:
    """Text with the right digest, as only a hostile store has it."""
    return b"%b\n%b\n" % (text, blake3(text).hexdigest().encode())


def changed(**values: object) -> bytes:
    return stored(json.dumps({"id": ID, "name": "run", "created": 1, **values}).encode())


def test_everything_comes_back() -> None:
    assert decode(encode(WHOLE)) == WHOLE
    smallest = Manifest(ID, "run", 1)
    assert decode(encode(smallest)) == smallest
    assert smallest.files == ()
    assert [file.is_here for file in WHOLE.files] == [True, False, True]


@given(
    created=st.integers(-(1 << 62), (1 << 63) - 1),
    name=st.text(min_size=1, max_size=40).filter(
        lambda t: not t.startswith(".") and not {"/", "\0"} & {*t}
    ),
    tags=st.dictionaries(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]),
                                 min_size=1, max_size=9), st.text(max_size=20)),
    times=st.lists(st.integers(0, 1 << 62), min_size=2, max_size=2).map(sorted),
)  # fmt: skip
def test_any_value_within_bounds_comes_back(
    created: int, name: str, tags: dict[str, str], times: list[int]
) -> None:
    loss = Loss("queue", first=times[0], last=times[1])
    one = Manifest(ID, name, created, tags=tags, losses=(loss,))
    assert decode(encode(one)) == one


def test_a_changed_byte_is_seen() -> None:
    data = encode(WHOLE)
    for place in range(len(data) - 1):
        spoiled = bytearray(data)
        spoiled[place] ^= 1
        with pytest.raises(ValueError):
            decode(bytes(spoiled))
    for length in range(len(data) - 1):
        with pytest.raises(ValueError):
            decode(data[:length])


FILE = {"number": 0, "group": 0, "name": "000000.mcap", "kind": "log", "bytes": 1,
        "digest": DIGEST, "written": 1}  # fmt: skip

ROWS = {**FILE, "name": "000000.rows.parquet", "kind": "rows"}


@pytest.mark.parametrize(
    "values",
    [
        {"id": "../../etc-0011223344556677"},
        {"id": "run"},
        {"name": "../run"},
        {"name": ".hidden"},
        {"name": "a/b"},
        {"name": ""},
        {"name": "a\0b"},
        {"created": 1 << 63},
        {"created": 1.5},
        {"created": "1"},
        {"created": None},
        {"status": "forgotten"},
        {"later": 1},
        {"tags": {"": "x"}},
        {"tags": {"a": 1}},
        {"files": [{**FILE, "name": "../../etc/passwd.mcap"}]},
        {"files": [{**FILE, "name": "000000.mcap\n"}]},
        {"files": [{**FILE, "name": "000001.mcap"}]},
        {"files": [{**FILE, "digest": "ab"}]},
        {"files": [{**FILE, "bytes": -1}]},
        {"files": [{**FILE, "number": 10**6, "name": "1000000.mcap"}]},
        {"files": [FILE, FILE]},
        {"files": [FILE, {**FILE, "name": "000000.1.mcap"}]},
        {"files": [{**FILE, "digest": f"sha256:{DIGEST}"}]},
        {"files": [ROWS]},
        {"files": [{**FILE, "gone": "expired"}]},
        {"files": [{**FILE, "gone": "expired"}, ROWS, ROWS]},
        {"files": [{**FILE, "parts": {"3": [1, 1]}}]},
        {"files": [{**FILE, "first": 2, "last": 1}]},
        {"files": [{**FILE, "gone": "lost"}]},
        {"channels": {"65536": {"topic": "/a"}}},
        {"channels": {"0": {"topic": "x" * 5000}}},
        {"channels": {"0": {"topic": "/a", "schema": "../../x"}}},
        {"marks": [{"id": MARK, "time": 2, "text": "", "end": 1}]},
        {"marks": [{"id": "x", "time": 2, "text": ""}]},
        {"marks": [{"id": MARK, "time": 2, "text": ""}] * 2},
        {"marks": [{"id": f"{n:016x}", "time": 2, "text": ""} for n in range(MAX_MARKS + 1)]},
        {"pins": [{"id": MARK, "first": 2, "last": 1}]},
        {"losses": [{"cause": "queue", "first": 2, "last": 1}]},
    ],
)
def test_what_no_writer_writes_is_refused(values: dict[str, object]) -> None:
    decode(changed())
    with pytest.raises(ValueError):
        decode(changed(**values))


def test_hostile_text_is_refused() -> None:
    for text in (b"", b"[]", b"null", b"[" * 10**6, b'{"id":' * 10**5, b"\xff", b"{}"):
        with pytest.raises(ValueError):
            decode(stored(text))


def test_what_would_not_be_read_is_not_written() -> None:
    one = Manifest(ID, "run", 1)
    for values in (
        {"name": "a/b"},
        {"tags": {"a": "\ud800"}},
        {"created": 1 << 63},
        {"notes": (Note(1, "x" * (1 << 17)),)},
    ):
        with pytest.raises(StoreError, match=r"run|a/b"):
            encode(replace(one, **values))
    with limits(manifest_bytes=len(encode(one))):
        assert decode(encode(one)) == one
        with pytest.raises(StoreError, match="too many files or losses"):
            encode(replace(one, changes=1))


def test_ids_are_readable_and_safe() -> None:
    for word in ("robot", "Robot 7.bag", "../../etc", "", "ü", "a" * 500, "--a--"):
        drawn = new_id(word)
        assert is_id(drawn)
        decode(changed(id=drawn))
    assert "-robot-7-bag-" in new_id("Robot 7.bag")
    assert new_random() != new_random()
    assert not any(map(is_id, ("", "robot", "A-3f9a12bc04d7e615", f"{ID}\n", f"../{ID}")))


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("robot", "robot"),
        ("my run/1", "my run-1"),
        ("../../etc", "-..-etc"),
        (".hidden", "hidden"),
        ("--all", "--all"),
        ("", "recording"),
        ("...", "recording"),
        ("äöü", "äöü"),
        ("x" * 300, "x" * 255),
        ("ä" * 200, "ä" * 127),
        ("a\0b\nc\x1b[1m\x85", "a-b-c-[1m-"),
    ],
)
def test_what_users_call_a_recording_becomes_a_name(text: str, name: str) -> None:
    assert name_of(text) == name_of(name) == name
    assert decode(encode(Manifest(new_id(text), name, 1))).name == name
    assert free_name(text, {"other"}) == name
    second = free_name(text, {name})
    assert second.endswith("-2")
    assert name_of(second) == second
    assert free_name(text, {name, second}).endswith("-3")
