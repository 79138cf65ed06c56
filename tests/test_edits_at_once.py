"""Many processes edit one recording: nothing that was acknowledged is lost, no reader fails."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places

CHANNEL = Channel("/n", "json", None, {})
BEGIN = 1_700_000_000 * 10**9
SETTINGS = SegmentSettings(chunk_size=4 << 10, segment_size=64 << 10, sync="never")

_EDITS = """
import sys
import hybridlog as hl
from hybridlog_storage.errors import HeldError
path, recording, who, count = *sys.argv[1:4], int(sys.argv[4])
def until_acknowledged(change, **values):  # a disk may stand still for longer than others wait
    while True:
        try:
            return change(recording, **values)
        except HeldError:
            pass
with hl.open(path, mongo="none") as store:
    for n in range(count):
        one = f"{who}-{n}"
        until_acknowledged(store.edit, tag={one: str(n)})
        until_acknowledged(store.edit, note=one)
        until_acknowledged(store.pin, topics=["/n"], reason=one)
        until_acknowledged(store.edit, name=f"name-{one}")
"""
_READS = """
import sys
import hybridlog as hl
path, recording = sys.argv[1:3]
known = 0
with hl.open(path, mongo="none") as store:
    while True:
        store.refresh()
        entry = store.entry(recording)
        topic = store.topic("/n").in_recording(recording)
        numbers = [message.fields["n"] for message in topic]
        assert numbers == list(range(len(numbers))), numbers
        assert known <= len(numbers) <= topic.count()
        known = len(numbers)
        print(known, flush=True)
"""
_VERIFIES = """
import sys
import hybridlog as hl
path, recording = sys.argv[1:3]
with hl.open(path, mongo="none") as store:
    while True:
        found = store.verify([recording]).findings
        assert not found, found
        print(len(found), flush=True)
"""


def start(script: str, *args: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", script, *map(str, args)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


@pytest.mark.parametrize(
    ("editors", "edits"),
    [(3, 4), pytest.param(10, 50, marks=[pytest.mark.exhaustive, pytest.mark.timeout(1800)])],
)
def test_what_was_acknowledged_while_it_was_recorded_is_there(
    tmp_path: Path, editors: int, edits: int
) -> None:
    path = tmp_path / "store"
    with hl.open(path, mongo="none", create=True) as store:
        recording = store.start("run", settings=SETTINGS)
        written = 0

        def write() -> None:
            nonlocal written
            payload = json.dumps({"n": written, "pad": "-" * 500}).encode()
            recording.write(CHANNEL, payload, log_time=BEGIN + written * 10**6)
            written += 1

        while not store.topics():  # until something is in a file
            write()
            store.refresh()
        others = [start(script, path, recording.id) for script in (_READS, _VERIFIES)]
        firsts = [one.stdout.readline() if one.stdout else "" for one in others]
        writers = [start(_EDITS, path, recording.id, f"p{n}", edits) for n in range(editors)]
        try:
            while any(one.poll() is None for one in writers):
                assert all(one.poll() is None for one in others), [
                    one.communicate() for one in others if one.poll() is not None
                ]
                write()
                time.sleep(0.002)
        finally:
            for one in others:
                one.terminate()
            said = [one.communicate() for one in (*writers, *others)]
        assert [one.returncode for one in writers] == [0] * editors, said
        # Both have come to an end of what they do at least once, and nothing failed.
        assert all(firsts), said
        assert not any("Traceback" in err for _, err in said[editors:]), said
        recording.close()
        wanted = {f"p{who}-{n}" for who in range(editors) for n in range(edits)}
        store.refresh()
        entry = store.entry(recording.id)
        assert entry.tags.keys() == wanted
        assert sorted(note.text for note in entry.manifest.notes) == sorted(wanted)
        assert sorted(pin.reason for pin in entry.manifest.pins) == sorted(wanted)
        assert entry.name in {f"name-p{who}-{edits - 1}" for who in range(editors)}
        assert (entry.status, entry.messages) == ("complete", written)
        manifest = places.manifest(path, recording.id)
        assert manifest.changes >= 4 * editors * edits
        assert not store.verify().findings
