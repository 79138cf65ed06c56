"""Writes the log of the simulated robot as an ordinary ROS bag.

One second at a time is generated, sorted by log time and written.
The same arguments give the same bytes.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import lz4.frame
import numpy as np
from rosbags import rosbag1

from benchmarks.simulator.robot import Robot
from benchmarks.simulator.topics import DEMO, RobotConfig, Speaker, Types, topics_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from benchmarks.simulator.topics import Topic

DEFAULT_DURATION_S, DEFAULT_SEED = 60.0, 1
_FACTS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "/r_gripper_controller/command": ("gripper_closings", lambda m: m.position == 0),
    "/base/scan": ("near_scans", lambda m: m.ranges.min() < 0.5),
    "/diagnostics": ("errors", lambda m: any(status.level >= 2 for status in m.status)),
}


class BagSummary(NamedTuple):
    """A written bag: bytes on disk, messages by topic, start in ns since the epoch.

    `truth` has the right answers to questions: `gripper_closings` (commands with position
    0), `near_scans` (with a range below 0.5 m), `errors` (diagnostics with an error in them).
    """

    path: Path
    size: int
    messages: Mapping[str, int]
    start_ns: int
    truth: Mapping[str, int]


def write_bag(
    path: Path | str,
    *,
    duration_s: float = DEFAULT_DURATION_S,
    seed: int = DEFAULT_SEED,
    is_compressed: bool = False,
    topics: Iterable[str] | None = None,
    config: RobotConfig | None = None,
) -> BagSummary:
    """Simulate a robot and write its log."""
    path = Path(path)
    speaker = Speaker(Robot(duration_s, seed), config or RobotConfig(), Types())
    wanted = None if topics is None else {*topics}
    every = topics_of(speaker.config)
    chosen = [topic for topic in every if wanted is None or topic.name in wanted]
    assert wanted is None or len(chosen) == len(wanted), wanted
    counts = Counter({topic.name: 0 for topic in chosen})
    truth = Counter({fact: 0 for fact, _ in _FACTS.values()})
    writer = rosbag1.Writer(path)
    if is_compressed:
        writer.set_compression(writer.CompressionFormat.LZ4)
        # A tenth smaller, and read as fast.
        writer.compressor = lambda chunk: bytes(lz4.frame.compress(chunk, compression_level=12))
    with writer:
        connections = [
            writer.add_connection(
                topic.name,
                topic.spelled,
                typestore=speaker.types.store,
                callerid=topic.node,
                latching=int(topic.latched) or None,
            )
            for topic in chosen
        ]
        for log_time, _, index, payload, fact in _messages(speaker, chosen):
            writer.write(connections[index], log_time, payload)
            counts[chosen[index].name] += 1
            truth[fact] += 1
    del truth[""]
    size = path.stat().st_size
    return BagSummary(path, size, dict(counts), speaker.robot.start_ns, dict(truth))


def write_demo(path: Path) -> BagSummary:
    """Write the demo bag, and beside it, as JSON, what the simulation counted."""
    summary = write_bag(path, is_compressed=True, config=DEMO)
    counted = {"messages": summary.messages, **summary.truth}
    path.with_suffix(".json").write_text(json.dumps(counted, indent=1) + "\n")
    return summary


def _messages(speaker: Speaker, topics: list[Topic]) -> Iterator[tuple[int, int, int, bytes, str]]:
    """Log time, order of arrival, index of the topic, payload and the fact in it, if any."""
    robot, arrival = speaker.robot, 0
    end_ns = robot.start_ns + round(robot.duration_s * 1e9)
    # The last log time of each topic: jitter must not swap two of its messages.
    last, waiting = [robot.start_ns] * len(topics), []
    for block in range(int(np.ceil(robot.duration_s))):
        end = min(block + 1.0, robot.duration_s)
        for index, topic in enumerate(topics):
            ticks = topic.ticks(block, end, block, robot)
            if not len(ticks.seconds):
                continue
            log_times = topic.log_times(ticks, robot.seed)
            log_times = np.maximum.accumulate(np.maximum(log_times, last[index]))
            last[index] = log_times[-1]
            name, shows = _FACTS.get(topic.name, ("", bool))
            messages = topic.messages(speaker, ticks)
            for log_time, message in zip(log_times.tolist(), messages, strict=True):
                # Messages that arrive after the recording has stopped are not in it.
                if log_time < end_ns:
                    payload = speaker.types.encode(message, topic.spelled)
                    fact = name if shows(message) else ""
                    waiting.append((log_time, arrival, index, payload, fact))
                    arrival += 1
        waiting.sort()
        # A message of the next span can be stamped, and logged, from `end` on.
        border = robot.start_ns + round(end * 1e9)
        ready = sum(message[0] < border for message in waiting)
        yield from waiting[:ready]
        del waiting[:ready]
