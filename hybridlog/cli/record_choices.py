"""The options of `hybridlog record`, and what it tells of each recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import click
from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.options import (
    SECONDS,
    SIZE,
    SOME_SECONDS,
    Amount,
    AsJson,
    Between,
    InStore,
    Latched,
    Quiet,
    argument,
    option,
    parse_seconds,
)
from hybridlog.wording import parse_size
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.query.topics import TopicMatcher
    from hybridlog.record.recorder import RecordReport
    from hybridlog_storage.segments.segment_writer import SegmentSettings

_CHUNK: Final = 2 << 20
"""Bytes of a chunk."""
ENVIRONMENT_MASTER: Final = "ROS_MASTER_URI"
"""The master of ROS 1 that is meant without a URI."""
_LIVE: Final = ("ros1", "ros2", "foxglove", "replay")
"""Parameters that name a source of live messages."""
_OF_LOGS: Final = ("paths", "between", "again", "watch", "no_latched", "original_times")


def _live(help: str, metavar: str | None = None, **settings: Any) -> Any:  # noqa: A002
    """An option for live recording."""
    return option(help, metavar, **{"needs": _LIVE, "section": "Live recording", **settings})


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
    settle: float = option(
        "With --watch: a file that does not say so is complete when unchanged for this time.",
        "TIME",
        type=SECONDS,
        default="60s",
        needs=("watch",),
    )
    compression: str = option(
        "Compression of chunks.", type=click.Choice(["zstd", "lz4", "none"]), default="zstd"
    )
    level: int = option("zstd level, 1 to 19.", "N", type=click.IntRange(1, 19), default=3)
    ros1: str | None = option(
        "Record a running ROS 1 robot; the URI of a master may follow, else ROS_MASTER_URI "
        "names it.",
        "[URI]",
        is_flag=False,
        flag_value=ENVIRONMENT_MASTER,
        excludes=_OF_LOGS,
    )
    ros2: bool = option("Record a running ROS 2 robot; needs rclpy.", excludes=_OF_LOGS)
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
    duration: float | None = _live("Stop after this time, such as 10m.", "TIME", type=SOME_SECONDS)
    max_messages: int | None = _live(
        "Stop after this number of messages.", "N", type=click.IntRange(min=1)
    )
    split_size: int = _live(
        "Start a new segment file after this size.",
        "SIZE",
        type=Amount(parse_size, "1MiB"),
        default="1GiB",
    )
    split_duration: float = _live(
        "Start a new segment file after this time.", "TIME", type=SOME_SECONDS, default="10m"
    )
    use_sim_time: bool = _live("Log times are those of /clock, the time of a simulation.")
    throttle: tuple[tuple[str, str], ...] = _live(
        "At most this rate of messages, such as /camera 5Hz.",
        "TOPIC RATE",
        nargs=2,
    )
    priority: tuple[tuple[str, str], ...] = _live(
        "low, normal or high: when more arrives than can be written, payloads of the lowest "
        "priority are dropped first.",
        "TOPIC WORD",
        nargs=2,
    )
    budget: int | None = _live(
        "Size of payloads in memory; without, a sixteenth of all memory.",
        "SIZE",
        type=Amount(parse_size, "1MiB"),
    )
    reserve: int = _live(
        "Stop when the disk has less than this free.", "SIZE", type=SIZE, default="1GB"
    )
    flush_interval: float = _live(
        "The most that a killed recorder can lose.",
        "TIME",
        type=Amount(parse_seconds, "1ns", "1h"),
        default="1s",
    )
    ring: float | None = _live(
        "Keep only the last TIME, and what is pinned.",
        "TIME",
        type=Amount(parse_seconds, "1ns", "24h"),
        excludes=("use_sim_time", "contract"),
    )
    trigger: tuple[str, ...] = _live(
        "Mark and pin what is around such a message: '/diagnostics: status[*].level >= 2'.",
        "TOPIC: PREDICATE",
    )
    before: float | None = _live(
        "Pin so much before a trigger or SIGUSR1; without, all that the ring has.",
        "TIME",
        type=Amount(parse_seconds, most="24h"),
    )
    after: float | None = _live(
        "Pin so much after it.", "TIME", type=Amount(parse_seconds, most="24h")
    )
    contract: Path | None = _live(
        "Tell and mark topics that are silent for longer than the rules in this file allow, "
        "and judge the recording at its end.",
        "FILE",
    )
    no_derive: bool = _live(
        "Make no tables and no index now: a later command does.",
        excludes=("ring", "trigger", "contract"),
    )
    set_tag: tuple[str, ...] = option("Store KEY=VALUE with it.", "K=V")

    @property
    def is_live(self) -> bool:
        """True when a source of live messages is given."""
        return self.ros2 or (self.ros1, self.foxglove, self.replay) != (None, None, None)

    def check(self) -> None:
        """Refuse parameters that do not fit together."""
        if self.ros1 is not None and not self.ros1.strip():
            raise UsageError("A ROS master's URI looks like http://host:11311; this one is empty.")
        if not self.paths and not self.is_live:
            raise UsageError(
                "Nothing to record: give a log, or --ros1, --ros2, --foxglove URL or --replay FILE."
            )
        for path in self.paths if self.watch else ():
            if not path.is_dir():
                raise UsageError(f"--watch takes directories, and {path} is none.")

    def matchers(self) -> tuple[TopicMatcher | None, TopicMatcher | None]:
        """Matchers of topics and of those without documents; new at each call, since they count."""
        from hybridlog.query.topics import matcher

        chosen = matcher(self.topics, self.exclude) if self.topics or self.exclude else None
        return chosen, matcher(self.no_index) if self.no_index else None

    def segment_settings(self, chunk_size: int = _CHUNK) -> SegmentSettings:
        """Chunks and compression."""
        from hybridlog_storage.segments.segment_writer import SegmentSettings

        form = cast("Any", self.compression)
        return SegmentSettings(chunk_size=chunk_size, compression=form, level=self.level)


def row_of(report: RecordReport, path: object) -> dict[str, Any]:
    """A recorded log as a row of JSON: that of `ls`, and what came of the log."""
    from hybridlog.cli.commands.ls import recording_dict
    from hybridlog.entries import summary_of
    from hybridlog.record.losses import losses_of

    entry = report.entry
    stats = [channel.stats for channel in entry.channels]
    return {
        "path": str(path),
        **recording_dict(summary_of(entry)),
        "messages_indexed": report.indexed,
        "messages_unreadable": sum(one.unreadable for one in stats),
        "messages_surplus": sum(one.surplus for one in stats),
        "messages_skipped": report.skipped,
        "messages_latched": report.latched,
        "attachments": entry.attachments,
        "metadata_records": entry.metadata_records,
        # A live source has no size of its own.
        "bytes_in": entry.manifest.source.bytes or sum(one.payload_bytes for one in stats),
        "seconds": round(report.elapsed_s, 3),
        "losses": losses_of(entry),
        "damage": [{**asdict(d), "file": str(d.file)} for d in report.damage],
        "not_indexed": {
            c.topic: report.not_indexed[c.id] for c in entry.channels if c.id in report.not_indexed
        },
    }


def line_of(row: Mapping[str, Any]) -> str:
    """A recorded log in a line, without counts of zero."""
    more = (("skipped", "left out"), ("latched", "from before"))
    told = [
        output.counted(row["messages"], "message"),
        output.size(row["stored_bytes"]),
        *(f"{row[f'messages_{key}']} {what}" for key, what in more if row[f"messages_{key}"]),
        *([f"{row['attachments']} attachments"] if row["attachments"] else ()),
        f"from {row['path']}",
    ]
    return f"{row['name']}: {', '.join(told)}"


def remarks_on(report: RecordReport) -> Iterator[str]:
    """A line for each topic with messages whose fields are not all there, or not all they hold."""
    for channel in report.entry.channels:
        unreadable, surplus = channel.stats.unreadable, channel.stats.surplus
        if channel.is_indexed and channel.id in report.not_indexed:
            yield f"{channel.topic}: not indexed beyond time: {report.not_indexed[channel.id]}"
        if unreadable:
            unfit = output.unfit(unreadable)
            yield f"{channel.topic}: {unfit}, or the index; stored, without fields in it"
        if surplus:
            yield (
                f"{channel.topic}: {output.counted(surplus, 'message')} with bytes left over "
                "behind the last field; the fields are read"
            )


def not_indexed(report: RecordReport) -> str:
    """The sentence about messages that the index lacks, because it failed."""
    return (
        f"{report.failure} {stored(report.missed)} but not in the index; the next command that "
        "opens the store catches up."
    )


def stored(messages: int) -> str:
    """A number of stored messages: `1 message is stored`."""
    return f"{output.counted(messages, 'message')} {'is' if messages == 1 else 'are'} stored"
