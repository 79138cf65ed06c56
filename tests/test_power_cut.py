"""After a power cut: what was promised is there, and what is missing is told."""

from __future__ import annotations

import random
import struct
from contextlib import closing, suppress
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.disk import files
from hybridlog_storage.errors import HybridlogError, SegmentError
from hybridlog_storage.manifest import Manifest, replace
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.chunk import PackedChunk
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings
from tests import places
from tests.power import PowerCut

CHANNEL = Channel("/a", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"), {})
OTHER = Channel("/b", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"), {})
COUNT = 40


def message(number: int) -> bytes:
    text = random.Random(number).randbytes(200 + 37 * number % 900).hex().encode()
    return struct.pack("<I", len(text)) + text


WANT = {
    "/a": [message(n) for n in range(0, COUNT, 2)],
    "/b": [message(n) for n in range(1, COUNT, 2)],
}


class Run:
    """A recording that is made while the power may fail."""

    def __init__(self, place: Path, sync: str, calls: int | None) -> None:
        self.store = place / "store"
        with hl.open(self.store, mongo="none", create=True):
            pass
        self.power = PowerCut(self.store, calls)
        self.written: list[int] = []
        """Messages that were flushed with `sync="chunk"`: promised to be there."""
        self.sealed = 0
        self.is_closed = False
        self.settings = SegmentSettings(chunk_size=2048, segment_size=9000, sync=sync)  # type: ignore[arg-type]

    def go(self, monkeypatch: pytest.MonkeyPatch) -> None:
        tell = RecordingWriter._publish

        def told(writer: RecordingWriter, chunk: PackedChunk) -> None:
            if not self.power.is_off:
                self.written.append(int(chunk.parts["messages"].sum()))
            tell(writer, chunk)

        with monkeypatch.context() as patch:
            patch.setattr(files, "system", self.power)
            patch.setattr(RecordingWriter, "_publish", told)
            store = hl.open(self.store, mongo="none")
            try:
                with suppress(HybridlogError, OSError):
                    recording = store.start("run", settings=self.settings)
                    for number in range(COUNT):
                        recording.write(
                            (CHANNEL, OTHER)[number % 2], message(number), log_time=1000 + number
                        )
                        if number % 8 == 7:
                            recording.capture.writer.flush()
                    recording.close()
                    self.is_closed = not self.power.is_off
            finally:
                with suppress(HybridlogError, OSError):
                    store.close()


def check(found: Path, run: Run, sync: str) -> str:
    """What somebody finds, held against what was promised; returns the recording's status."""
    try:
        return look(found, run, sync)
    except SegmentError:
        assert sync == "never"  # nothing was promised but that this is told
        return "unreadable"


def look(found: Path, run: Run, sync: str) -> str:
    with closing(hl.open(found, mongo="none")) as store:
        store.shared.recover()
        entries = store.recordings()
        if sync == "never" and store.shared.repairs.unreadable:
            return "unreadable"
        assert not store.shared.repairs.unreadable
        if not entries:
            assert not run.is_closed
            assert sync != "chunk" or not run.written
            return "nothing"
        (entry,) = entries
        got: dict[str, list[bytes]] = {"/a": [], "/b": []}
        if entry.channels:
            for one in store.all_topics():
                got[one.topic].append(bytes(one.raw))
                assert bytes(one.raw) == message(one.log_time_ns - 1000)
        store.refresh()  # what could not be read is known now
        (entry,) = entries = store.recordings()
        lost = sum(row["count"] or 0 for row in entry.losses)
        count = sum(map(len, got.values()))
        assert count == entry.messages
        if entry.status == "complete":
            assert got == WANT
        if run.is_closed and sync != "never":
            assert (entry.status, got) == ("complete", WANT)
        if sync == "chunk":
            assert count >= sum(run.written)
        assert count + lost <= COUNT
        # Once more: what was found is found again, byte for byte.
        with closing(hl.open(found, mongo="none")) as again:
            assert again.recordings() == entries
        return entry.status


def calls_of(tmp_path: Path, sync: str, monkeypatch: pytest.MonkeyPatch) -> int:
    run = Run(tmp_path / "whole", sync, None)
    run.go(monkeypatch)
    assert run.is_closed
    assert check(run.store, run, sync) == "complete"
    return run.power.calls


def test_a_segment_of_the_last_group_that_a_power_cut_took(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path / "whole", "seal", None)
    run.go(monkeypatch)
    (folder,) = places.folders(run.store)
    last = places.manifest(run.store, "run").files[-1]
    assert last.number > last.group

    def how(now: Manifest) -> Manifest:
        before = tuple(file for file in now.files if file.group != last.group)
        return replace(now, status="open", files=before)

    places.change_in(folder, how)
    (folder / last.name).unlink()
    assert check(run.store, run, "never") == "recovered"


@pytest.mark.parametrize(
    ("cuts", "fates"), [(5, 2), pytest.param(1000, 4, marks=pytest.mark.exhaustive)]
)
@pytest.mark.parametrize("sync", ["chunk", "seal", "never"])
def test_a_power_cut_while_recording(
    tmp_path: Path, sync: str, monkeypatch: pytest.MonkeyPatch, cuts: int, fates: int
) -> None:
    calls = calls_of(tmp_path, sync, monkeypatch)
    assert calls > 20
    seen = set()
    for number in range(1, calls + 1, max(calls // cuts, 1)):
        run = Run(tmp_path / f"cut{number}", sync, number)
        run.go(monkeypatch)
        for fate in range(fates):
            found = tmp_path / f"found{number}-{fate}"
            run.power.after_cut(found, random.Random(f"{sync}{number}{fate}"))
            seen.add(check(found, run, sync))
    assert seen >= ({"nothing"} if sync == "never" else {"nothing", "recovered"})
    told = {"nothing", "recovered", "complete", "damaged", "unproven"}
    assert seen <= (told | {"unreadable"} if sync == "never" else told)
