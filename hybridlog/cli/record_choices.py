"""The parameters of `hybridlog record`, and the rules for giving them together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import click

from hybridlog.cli import output
from hybridlog.cli.binder import argument, option
from hybridlog.cli.completion import complete_topic
from hybridlog.cli.options import (
    AsJson,
    Between,
    InStore,
    Latched,
    Quiet,
    cache_size,
)
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from hybridlog.store import Store
    from hybridlog_storage.segments.segment_writer import SegmentSettings

DEFAULT_CHUNK: Final = 2 << 20
"""Bytes of a chunk."""


_LIVE: Final = ("ros1", "master", "ros2", "foxglove", "replay")
"""Parameters that name a source of live messages."""
_OF_LOGS: Final = ("between", "again", "watch", "no_latched", "original_times")


def _live(help: str, metavar: str | None = None, **settings: Any) -> Any:  # noqa: A002
    """An option for live recording."""
    return option(help, metavar, **{"needs": _LIVE, "section": "Live recording", **settings})


@dataclass(frozen=True, kw_only=True)
class RecordChoices(Between, Latched, InStore, AsJson, Quiet):
    """The parameters as typed."""

    paths: tuple[Path, ...] = argument(
        "ROS 1 bags, ROS 2 bags (files or directories), MCAP files, and directories with any "
        "of them.",
        "[PATH]...",
    )
    topics: tuple[str, ...] = option(
        "Only these: name, glob, or re:REGEX.", "TOPIC", name="--topic", short="-t"
    )
    exclude: tuple[str, ...] = option("Not these.", "TOPIC", short="-x")
    no_index: tuple[str, ...] = option(
        "No documents in MongoDB for these: questions about them read tables.", "TOPIC"
    )
    name: str | None = option("Name of the recording; without, the file's.", "NAME")
    again: bool = option("Record it even if its content is in the store.")
    watch: bool = option(
        "Go on recording logs that come into the directories, when they are complete, until "
        "Ctrl-C.",
        excludes=("name",),
    )
    settle: str = option(
        "With --watch: a file that does not say so is complete when unchanged for this time.",
        "TIME",
        default="60s",
    )
    chunk_size: str | None = option(
        "Uncompressed size of a chunk, such as 512KiB; without, 2MiB, less where --budget is "
        "small.",
        "SIZE",
    )
    compression: str = option(
        "Compression of chunks.", type=click.Choice(["zstd", "lz4", "none"]), default="zstd"
    )
    level: int = option("zstd level, 1 to 19.", "N", type=click.IntRange(1, 19), default=3)
    ros1: bool = option(
        "Record a running ROS 1 robot; the URI of a master may follow, else ROS_MASTER_URI "
        "names it.",
        excludes=_OF_LOGS,
    )
    master: str | None = option("The ROS 1 master.", "URI", excludes=_OF_LOGS)
    ros2: bool = option("Record a running ROS 2 robot; needs rclpy.", excludes=_OF_LOGS)
    qos: Path | None = _live(
        "With --ros2: YAML file of QoS overrides, as for rosbag2.", "FILE", needs=("ros2",)
    )
    foxglove: str | None = option(
        "Record what a Foxglove WebSocket server sends.", "URL", excludes=_OF_LOGS
    )
    replay: Path | None = option(
        "Play a log at the speed of a robot, and record that.", "FILE", excludes=_OF_LOGS
    )
    speed: float = _live(
        "With --replay: N times as fast.",
        "N",
        type=click.FloatRange(min=0.01),
        default=1.0,
        needs=("replay",),
    )
    duration: str | None = _live("Stop after this time, such as 10m.", "TIME")
    max_messages: int | None = _live(
        "Stop after this number of messages.", "N", type=click.IntRange(min=1)
    )
    max_size: str | None = _live("Stop after this size of payloads, such as 10GB.", "SIZE")
    split_size: str = _live("Start a new segment file after this size.", "SIZE", default="1GiB")
    split_duration: str = _live("Start a new segment file after this time.", "TIME", default="10m")
    use_sim_time: bool = _live("Log times are those of /clock, the time of a simulation.")
    throttle: tuple[str, ...] = _live(
        "At most this rate of messages, such as /camera 5Hz.",
        "TOPIC RATE",
        shell_complete=complete_topic,
    )
    priority: tuple[str, ...] = _live(
        "low, normal or high: when more arrives than can be written, payloads of the lowest "
        "priority are dropped first.",
        "TOPIC WORD",
        shell_complete=complete_topic,
    )
    budget: str | None = _live(
        "Size of payloads in memory; without, a sixteenth of all memory.", "SIZE"
    )
    reserve: str = _live("Stop when the disk has less than this free.", "SIZE", default="1GB")
    flush_interval: str = _live("The most that a killed recorder can lose.", "TIME", default="1s")
    ring: str | None = _live("Keep only the last TIME, and what is pinned.", "TIME")
    trigger: tuple[str, ...] = _live(
        "Mark and pin what is around such a message: '/diagnostics: status[*].level >= 2'.",
        "TOPIC: PREDICATE",
    )
    before: str | None = _live(
        "Pin so much before a trigger or SIGUSR1; without, all that the ring has.", "TIME"
    )
    after: str | None = _live("Pin so much after it.", "TIME")
    contract: Path | None = _live(
        "Tell and mark topics that are silent for longer than the rules in this file allow, "
        "and judge the recording at its end.",
        "FILE",
    )
    set_tag: tuple[str, ...] = option("Store KEY=VALUE with it.", "K=V")
    cache_size: int | None = cache_size()

    @property
    def is_live(self) -> bool:
        """True when a source of live messages is given."""
        return self.is_ros1 or self.ros2 or self.foxglove is not None or self.replay is not None

    @property
    def is_ros1(self) -> bool:
        """True when a ROS 1 robot is recorded."""
        return self.ros1 or self.master is not None


def check_choices(choices: RecordChoices) -> None:
    """Refuse parameters that do not fit together.

    Raises:
        UsageError: Neither a log nor a robot, or what is not fit for several logs.
    """
    if choices.master is not None and not choices.master.strip():
        raise UsageError("A ROS master's URI looks like http://host:11311; this one is empty.")
    if choices.paths and choices.is_live:
        hint = ""
        if choices.is_ros1 and choices.master is None:
            hint = " A ROS master's URI looks like http://host:11311, and follows --ros1."
        raise UsageError(
            f"Give either logs to record or a robot (--ros1, --ros2, …), not both.{hint}"
        )
    if not choices.paths and not choices.is_live:
        raise UsageError(
            "Nothing to record: give a log, or --ros1, --ros2, --foxglove URL or --replay FILE."
        )
    if choices.is_live:
        return
    if choices.name is not None and len(choices.paths) > 1:
        raise UsageError("--name names one recording: give one path, or leave it out.")
    choices.check_latched(None)
    for path in choices.paths if choices.watch else ():
        if not path.is_dir():
            raise UsageError(f"--watch takes directories, and {path} is none.")


def segment_settings(choices: RecordChoices, chunk_size: int = DEFAULT_CHUNK) -> SegmentSettings:
    """Chunks and compression.

    Args:
        choices: The parameters.
        chunk_size: Bytes of a chunk if the user does not say.

    Raises:
        UsageError: The chunk size is no size.
    """
    from hybridlog_storage.segments.segment_writer import SegmentSettings

    return SegmentSettings(
        chunk_size=chunk_size
        if choices.chunk_size is None
        else output.parse_size(choices.chunk_size),
        compression=cast(Any, choices.compression),
        level=choices.level,
    )


def opened_to_record(
    choices: RecordChoices, *, recover: bool = True
) -> AbstractContextManager[Store]:
    """The store, which is made if there is none; see `opened_store`."""
    return choices.opened(
        create=True,
        cache_mb=choices.cache_size,
        quiet=choices.quiet,
        is_lasting=True,
        records=True,
        recover=recover,
    )
