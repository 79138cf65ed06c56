"""A recorder in a process of its own, which is told what to record."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import hybridlog as hl
from hybridlog.live.recorder import Recorder, RecorderOptions
from hybridlog.live.recording import LiveRecording
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.live.speaker import Speaker, text, text_channel


class Robot:
    """A recorder in another process; its messages are texts."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.pid = process.pid

    def say(self, topic: str, *texts: str, time: int | None = None) -> None:
        for content in texts:
            self._tell([topic, content, time])

    def hold(self) -> None:
        self._tell("hold")

    def end(self) -> None:
        self._tell(None)
        assert self._process.wait(60) == 0

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)
        self._process.wait(60)

    def _tell(self, line: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(line) + "\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline() == "done\n"


@contextmanager
def robot(
    store: Path, name: str = "live", segment_s: float = 600, flush_s: float = 0.2
) -> Iterator[Robot]:
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.live.robot", str(store), name, str(segment_s), str(flush_s)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "done\n"
        yield Robot(process)
    finally:
        process.kill()
        process.communicate()


def main(store: str, name: str, segment_s: float, flush_s: float) -> None:
    """Record what lines of standard input say: topic, text and log time; null ends."""
    options = RecorderOptions(
        name=name,
        reserve_bytes=0,
        flush_interval_s=flush_s,
        settings=SegmentSettings(segment_span_s=segment_s),
    )
    with hl.open(store, create=True) as opened:
        speaker = Speaker()
        recorder = Recorder(opened, [speaker], options, lambda _: None)
        recorder.start()
        recorder.look()
        channels: dict[str, Channel] = {}
        print("done", flush=True)
        for line in sys.stdin:
            told = json.loads(line)
            if told is None:
                recorder.stop()
                print("done", flush=True)
                return
            if told == "hold":
                # A chunk is not closed before its time.
                LiveRecording._take = lambda self: None  # type: ignore[method-assign]
                print("done", flush=True)
                continue
            topic, content, time = told
            channel = channels.setdefault(topic, text_channel(topic))
            speaker.say(channel, text(content), time)
            recorder.look()
            print("done", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4]))
