"""The parameters of `hybridlog record`, and the rules for giving them together."""

from __future__ import annotations

from collections.abc import Sequence
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


class LiveOption(click.Option):
    """An option for live recording, which is refused when logs are given."""

    section = "Live recording"


@dataclass(frozen=True, kw_only=True)
class RecordChoices(Between, Latched, InStore, AsJson, Quiet):
    """The parameters as typed.

    Attributes:
        live_options: The options for live recording that were given.
    """

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
        "Go on recording logs that come into the directories, when they are complete, until Ctrl-C."
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
        "names it."
    )
    master: str | None = option("The ROS 1 master.", "URI")
    ros2: bool = option("Record a running ROS 2 robot; needs rclpy.")
    qos: Path | None = option(
        "With --ros2: YAML file of QoS overrides, as for rosbag2.",
        "FILE",
        kind=LiveOption,
    )
    foxglove: str | None = option("Record what a Foxglove WebSocket server sends.", "URL")
    replay: Path | None = option("Play a log at the speed of a robot, and record that.", "FILE")
    speed: float = option(
        "With --replay: N times as fast.",
        "N",
        type=click.FloatRange(min=0.01),
        default=1.0,
        kind=LiveOption,
    )
    duration: str | None = option("Stop after this time, such as 10m.", "TIME", kind=LiveOption)
    max_messages: int | None = option(
        "Stop after this number of messages.", "N", type=click.IntRange(min=1), kind=LiveOption
    )
    max_size: str | None = option(
        "Stop after this size of payloads, such as 10GB.", "SIZE", kind=LiveOption
    )
    split_size: str = option(
        "Start a new segment file after this size.", "SIZE", default="1GiB", kind=LiveOption
    )
    split_duration: str = option(
        "Start a new segment file after this time.", "TIME", default="10m", kind=LiveOption
    )
    use_sim_time: bool = option(
        "Log times are those of /clock, the time of a simulation.", kind=LiveOption
    )
    throttle: tuple[str, ...] = option(
        "At most this rate of messages, such as /camera 5Hz.",
        "TOPIC RATE",
        shell_complete=complete_topic,
        kind=LiveOption,
    )
    priority: tuple[str, ...] = option(
        "low, normal or high: when more arrives than can be written, payloads of the lowest "
        "priority are dropped first.",
        "TOPIC WORD",
        shell_complete=complete_topic,
        kind=LiveOption,
    )
    budget: str | None = option(
        "Size of payloads in memory; without, a sixteenth of all memory.", "SIZE", kind=LiveOption
    )
    reserve: str = option(
        "Stop when the disk has less than this free.", "SIZE", default="1GB", kind=LiveOption
    )
    flush_interval: str = option(
        "The most that a killed recorder can lose.", "TIME", default="1s", kind=LiveOption
    )
    ring: str | None = option(
        "Keep only the last TIME, and what is pinned.", "TIME", kind=LiveOption
    )
    trigger: tuple[str, ...] = option(
        "Mark and pin what is around such a message: '/diagnostics: status[*].level >= 2'.",
        "TOPIC: PREDICATE",
        kind=LiveOption,
    )
    before: str | None = option(
        "Pin so much before a trigger or SIGUSR1; without, all that the ring has.",
        "TIME",
        kind=LiveOption,
    )
    after: str | None = option("Pin so much after it.", "TIME", kind=LiveOption)
    contract: Path | None = option(
        "Tell and mark topics that are silent for longer than the rules in this file allow, "
        "and judge the recording at its end.",
        "FILE",
        kind=LiveOption,
    )
    set_tag: tuple[str, ...] = option("Store KEY=VALUE with it.", "K=V")
    cache_size: int | None = cache_size()
    live_options: tuple[str, ...] = ()

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
        UsageError: A log and a robot at once, neither of them, or options of the other.
    """
    _check_sources(choices)
    if not choices.is_live:
        if choices.name is not None and len(choices.paths) > 1:
            raise UsageError("--name names one recording: give one path, or leave it out.")
        choices.check_latched(None)
        _check_watch(choices)
        return
    if choices.watch:
        raise UsageError("--watch is for directories of logs, not for a running robot.")
    if choices.between is not None or choices.again:
        raise UsageError("--between and --again are for logs, not for a running robot.")
    if choices.no_latched or choices.original_times:
        raise UsageError("--no-latched and --original-times are for --between, and logs.")
    if choices.master is not None and not choices.master.strip():
        raise UsageError("A ROS master's URI looks like http://host:11311; this one is empty.")
    if choices.qos is not None and not choices.ros2:
        raise UsageError("--qos is for --ros2.")
    if "--speed" in choices.live_options and choices.replay is None:
        raise UsageError("--speed is for --replay.")


def _check_watch(choices: RecordChoices) -> None:
    if not choices.watch:
        return
    if choices.name is not None:
        raise UsageError("--name names one recording; --watch makes many: leave it out.")
    for path in choices.paths:
        if not path.is_dir():
            raise UsageError(f"--watch takes directories, and {path} is none.")


def _check_sources(choices: RecordChoices) -> None:
    if choices.paths and choices.is_live:
        hint = ""
        if choices.is_ros1 and choices.master is None:
            hint = " A ROS master's URI looks like http://host:11311, and follows --ros1."
        raise UsageError(
            f"Give either logs to record or a robot (--ros1, --ros2, …), not both.{hint}"
        )
    if choices.paths and choices.live_options:
        are = "is" if len(choices.live_options) == 1 else "are"
        raise UsageError(
            f"{_listed(choices.live_options)} {are} for a running robot (--ros1, --ros2, "
            "--foxglove) or --replay, not for logs."
        )
    if not choices.paths and not choices.is_live:
        raise UsageError(
            "Nothing to record: give a log, or --ros1, --ros2, --foxglove URL or --replay FILE."
        )


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


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
