"""What is lost is said with every answer that may lack it."""

from __future__ import annotations

from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.manifests import MANIFEST_OLD
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places

from .running import run

BEGIN_NS = 1_750_000_000_000_000_000
SECOND_NS = 10**9
PAYLOAD = b'{"x": "' + 2000 * b"-" + b'"}'
KEPT = Channel("/kept", "json", None, {})
LATE = Channel("/late", "json", None, {})


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """A recording that has lost the segment with its last message, and one that has none left."""
    path = tmp_path / "store"
    with hl.open(path, create=True) as store:
        for name in ("part", "gone"):
            # Each message is a chunk and a segment of its own.
            settings = SegmentSettings(chunk_size=1 << 10, segment_size=1)
            with store.start(name, settings=settings) as recording:
                for second in range(4):
                    channel = LATE if second == 3 else KEPT
                    time = BEGIN_NS + second * SECOND_NS
                    recording.write(channel, PAYLOAD, log_time=time)
    assert len(places.manifest(path, "part").logs) > 2
    ((last, _),) = places.logs_of(path, "part", "/late")
    last.unlink()
    for segment in places.folder(path, "gone").glob("*.mcap"):
        segment.unlink()
    return path


def test_a_recording_that_is_wholly_lost_is_missed(damaged: Path) -> None:
    done = run("fetch", "-t", "/kept", "--count", store=damaged)
    assert done.out == "3\n"
    assert "gone is not complete, so this answer may not be: 3 messages lost" in done.err
    done = run("fetch", "-t", "/late", "-r", "gone", "--count", store=damaged)
    assert done.out == "0\n"
    assert "gone is not complete, so this answer may not be: 1 message lost" in done.err


def test_times_behind_what_is_left_are_known_to_be_lost(damaged: Path) -> None:
    late = ("--between", str(BEGIN_NS + 3 * SECOND_NS), str(BEGIN_NS + 4 * SECOND_NS))
    for topic in ("/late", "/kept"):
        done = run("fetch", "-t", topic, "-r", "part", *late, "--count", store=damaged)
        assert done.out == "0\n"
        assert ("part is not complete" in done.err) == (topic == "/late")
    after = ("--between", str(BEGIN_NS + 5 * SECOND_NS), str(BEGIN_NS + 6 * SECOND_NS))
    done = run("fetch", "-t", "/kept", "-r", "part", *after, "--count", store=damaged, code=2)
    assert "Nothing was recorded between" in done.err


def test_what_was_lost_is_not_called_a_damaged_source(damaged: Path) -> None:
    rows = {line.split()[0]: line for line in run("ls", store=damaged).lines[1:]}
    assert rows["part"].endswith("stored data lost")
    assert rows["gone"].endswith("stored data lost")


@pytest.mark.parametrize("has_old", [True, False])
def test_a_lost_manifest_is_said_with_answers(damaged: Path, has_old: bool) -> None:
    recording = places.id_of(damaged, "part")
    (places.manifest_of(places.folder(damaged, "part"))).unlink()
    if not has_old:
        (places.folder(damaged, "part") / MANIFEST_OLD).unlink()
    done = run("fetch", "-t", "/kept", "--count", store=damaged, code=None)
    assert done.out == "0\n"
    assert f"Recording {recording} cannot be read: {recording} has no manifest" in done.err
    assert "1 recording cannot be read and is left out" in done.err
    run("fetch", "-t", "/kept", "--count", "--strict", store=damaged, code=11)
    run("verify", "--repair", store=damaged, code=None)
    done = run("fetch", "-t", "/kept", "-r", "part", "--count", store=damaged)
    assert done.out == "3\n"
    assert "part has lost its manifest once, so this answer may not be complete." in done.err
    info = run("info", "part", store=damaged).out
    why = "not known: its manifest was lost, so a segment may be missing"
    assert ("1 message lost in 1 place" if has_old else why) in info
    done = run("fetch", "-t", "/kept", "-r", "part", "--count", store=damaged)
    assert "part has lost its manifest once" in done.err


def test_info_shows_notes_and_marks(damaged: Path) -> None:
    run("edit", "part", "--note", "the wheel squeaks", store=damaged)
    assert run("ls", "-r", "part", store=damaged).lines[1].endswith(", the wheel squeaks")
    run("mark", "bump", "-r", "part", "--at", "+1s", store=damaged)
    assert "note       the wheel squeaks" in run("info", "part", store=damaged).out
    (told,) = run("info", "part", "--json", store=damaged).json
    assert [note["text"] for note in told["notes"]] == ["the wheel squeaks"]
    assert [(mark["text"], mark["time"]) for mark in told["marks"]] == [
        ("bump", BEGIN_NS + SECOND_NS)
    ]
