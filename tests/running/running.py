"""A recording that goes on, written by a thread of this process."""

from __future__ import annotations

import threading
import time
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import hybridlog as hl
from hybridlog.live import LiveOptions, LiveRecording
from hybridlog.record.losses import Cause
from hybridlog_storage.manifest import Loss
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.running.methods import LABEL, TAGS
from tests.running.sequence import CHANNELS, SECOND, START, Known, Sent, messages
from tests.waiting import wait_for

SETTINGS = {
    "one": SegmentSettings(chunk_size=8192, sync="never"),
    "many": SegmentSettings(chunk_size=4096, segment_size=20_000, compression="none", sync="never"),
}
"""One segment, or many."""
NO_MONGODB = "mongodb://127.0.0.1:9/x?serverSelectionTimeoutMS=50&connectTimeoutMS=50"
FLUSH_S = 0.1


class Running:
    """A recording that goes on.

    Args:
        recording: The recording.
        store: The store that writes it.
        before: The store, opened before the recording began.

    Attributes:
        sent: Messages written so far.
        step: The next step of the sequence.
        times: When each step was written, by `monotonic`.
    """

    def __init__(self, recording: LiveRecording, store: hl.Store, before: hl.Store) -> None:
        self.recording = recording
        self.store = store
        self.before = before
        self.sent: list[Sent] = []
        self.step = 0
        self.times: list[float] = []

    @property
    def path(self) -> Path:
        return self.store.directory.path

    def write(self, steps: int, pause_s: float = 0.0) -> None:
        """Write the messages of some steps."""
        for step in range(self.step, self.step + steps):
            for one in messages(step, step + 1, len(self.sent)):
                self.sent.append(one)  # first: it may be flushed at once
                self.recording.write(
                    CHANNELS[one.topic],
                    one.raw,
                    log_time=one.log_time,
                    publish_time=one.publish_time,
                )
            self.step = step + 1
            self.times.append(time.monotonic())
            if pause_s:
                time.sleep(pause_s)

    def written_before(self, time: float) -> int:
        """The number of steps that were written by a time."""
        return bisect_right(self.times, time)

    def lose(self) -> None:
        """Note three lost messages."""
        times = {"first": START + SECOND, "last": START + SECOND + 1}
        self.recording.ledger.note(Loss(Cause.TRANSPORT, "/said", 3, **times))

    def flushed(self, limit_s: float = 60) -> Known:
        """Wait until everything is in the files and the index; return what is there."""
        self.seen_by(self.before, limit_s)
        wait_for(lambda: not self.recording.lag)
        return Known(self.sent)

    def seen_by(self, store: hl.Store, limit_s: float = 60) -> None:
        """Wait until a store sees everything, and the losses."""
        until = time.monotonic() + limit_s
        while True:
            entry = next((e for e in store.recordings() if e.name == LABEL), None)
            if entry is not None and entry.messages >= len(self.sent) and entry.losses:
                assert entry.messages == len(self.sent)
                return
            assert time.monotonic() < until, entry
            time.sleep(0.02)

    @contextmanager
    def writing(self, steps: int, pause_s: float) -> Iterator[threading.Thread]:
        """Write in the background."""
        failed: list[BaseException] = []

        def work() -> None:
            try:
                self.write(steps, pause_s)
            except BaseException as error:
                failed.append(error)

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield thread
        finally:
            thread.join()
        assert not failed, failed


@contextmanager
def begun(path: Path, kind: str, steps: int = 200, mongo: str | None = None) -> Iterator[Running]:
    """A recording with the first steps of the sequence."""
    options = LiveOptions(settings=SETTINGS[kind], flush_interval_s=FLUSH_S, tags=TAGS)
    with (
        hl.open(path, create=True, mongo=mongo) as store,
        hl.open(path, mongo=mongo) as before,
    ):
        assert LABEL not in before.recordings().names
        with store.start(LABEL, options) as recording:
            running = Running(recording, store, before)
            running.lose()
            running.write(steps)
            running.flushed()
            while not (entry := before.entry(LABEL)).flushed or (
                kind == "many" and len(entry.digests) < 4
            ):
                running.write(3)
                running.flushed()
            yield running
