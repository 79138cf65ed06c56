"""A store whose disk is full can be read, and recordings can be removed to make room."""

from __future__ import annotations

import errno
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.disk import files
from hybridlog_storage.disk.files import System
from hybridlog_storage.messages import Channel
from tests import places
from tests.running.running import NO_MONGODB as NOWHERE


class FullDisk(System):
    """No byte more can be written; names can be changed, and files removed."""

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        raise OSError(errno.ENOSPC, "full")

    def pwritev(self, fd: int, parts: Sequence[memoryview], position: int) -> int:
        raise OSError(errno.ENOSPC, "full")


def test_a_crash_on_a_full_disk_waits_for_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    channel = Channel("/a", "json", None, {})
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("whole") as recording:
            recording.write(channel, b'{"n": 1}')
        running = store.start("crash", flush_interval_s=0.05)
        for n in range(50):
            running.write(channel, b'{"n": %d}' % n, log_time=n)
        while sum(running.capture.writer.written.values()) < 50:
            time.sleep(0.01)
        shutil.copytree(tmp_path / "store", tmp_path / "after", ignore=lambda *_: ["mongod"])
        running.close()
    with monkeypatch.context() as patch:
        patch.setattr(files, "system", FullDisk())
        with hl.open(tmp_path / "after", mongo=NOWHERE) as store:
            assert {r.name: r.status for r in store.recordings()} == {
                "whole": "complete",
                "crash": "unfinished",
            }
            assert [bytes(m.raw) for m in store.topic("/a").in_recording("whole")] == [b'{"n": 1}']
            store.remove("whole")
            assert [r.name for r in store.recordings()] == ["crash"]
            assert "whole" not in places.names(tmp_path / "after")
    with hl.open(tmp_path / "after", mongo=NOWHERE) as store:
        store.edit("crash", tag={"a": "b"})
        (entry,) = store.recordings()
        assert (entry.name, entry.status, entry.messages) == ("crash", "recovered", 50)
