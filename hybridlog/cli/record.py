"""`hybridlog record`."""

from __future__ import annotations

import os
from typing import Any

import click
from click.core import ParameterSource

from hybridlog.cli import options
from hybridlog.cli.completion import complete_topic
from hybridlog.cli.record_choices import RecordChoices, check_choices


class _LiveOption(click.Option):
    """An option for live recording, which is refused when logs are given."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        record = super().get_help_record(ctx)
        if record is None or record[1].startswith("With --"):
            return record
        return record[0], f"Live: {record[1]}"


class _RecordCommand(click.Command):
    """`record`, with two spellings of options that click does not know."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read `--ros1 URI` as `--ros1 --master URI`, and `--throttle A B` as `A=B`."""
        written: list[str] = []
        rest = list(args)
        while rest:
            word = rest.pop(0)
            before = written[-1] if written else ""
            if word.startswith("--ros1="):
                written += ["--master", word.removeprefix("--ros1=")]
            elif before == "--ros1" and _is_value(word) and not _is_file(word):
                written += ["--master", word]
            elif before in {"--throttle", "--priority"} and "=" not in word:
                # The next option is no value, even where a value was forgotten.
                has_value = bool(rest) and _is_value(rest[0])
                written.append(f"{word}={rest.pop(0)}" if has_value else word)
            else:
                written.append(word)
        return super().parse_args(ctx, written)


def _is_value(word: str) -> bool:
    return not word.startswith("-")


def _is_file(word: str) -> bool:
    return os.path.exists(word)  # noqa: PTH110 - a word that is too long for a path is no error


@click.command(cls=_RecordCommand)
@click.argument(
    "paths",
    nargs=-1,
    type=options.PATH,
    metavar="[PATH]...",
    help="ROS 1 bags, ROS 2 bags (files or directories), MCAP files, and directories with any "
    "of them.",
)
@options.store
@click.option(
    "--topics",
    "-t",
    multiple=True,
    metavar="TOPIC",
    help="Only these: name, glob, or re:REGEX. Repeatable.",
)
@click.option("--exclude", "-x", multiple=True, metavar="TOPIC", help="Not these. Repeatable.")
@click.option(
    "--no-index",
    multiple=True,
    metavar="TOPIC",
    help="No documents in MongoDB for these: questions about them read tables. Repeatable.",
)
@options.between
@options.no_latched
@options.original_times
@click.option("--name", metavar="NAME", help="Name of the recording; without, the file's.")
@options.tags
@click.option("--again", is_flag=True, help="Record it even if its content is in the store.")
@click.option(
    "--watch",
    is_flag=True,
    help="Go on recording logs that come into the directories, when they are complete, until "
    "Ctrl-C.",
)
@click.option(
    "--settle",
    default="60s",
    metavar="TIME",
    help="With --watch: a file that does not say so is complete when unchanged for this time.",
)
@click.option(
    "--chunk-size",
    metavar="SIZE",
    help="Uncompressed size of a chunk, such as 512KiB; without, 2MiB, less where --budget is "
    "small.",
)
@click.option(
    "--compression",
    type=click.Choice(["zstd", "lz4", "none"]),
    default="zstd",
    help="Compression of chunks.",
)
@click.option(
    "--level", type=click.IntRange(1, 19), default=3, metavar="N", help="zstd level, 1 to 19."
)
@click.option(
    "--ros1",
    is_flag=True,
    help="Record a running ROS 1 robot; the URI of a master may follow, else ROS_MASTER_URI "
    "names it.",
)
@click.option("--master", metavar="URI", help="The ROS 1 master.")
@click.option("--ros2", is_flag=True, help="Record a running ROS 2 robot; needs rclpy.")
@click.option(
    "--qos",
    cls=_LiveOption,
    type=options.PATH,
    metavar="FILE",
    help="With --ros2: YAML file of QoS overrides, as for rosbag2.",
)
@click.option("--foxglove", metavar="URL", help="Record what a Foxglove WebSocket server sends.")
@click.option(
    "--replay",
    type=options.PATH,
    metavar="FILE",
    help="Play a log at the speed of a robot, and record that.",
)
@click.option(
    "--speed",
    cls=_LiveOption,
    type=click.FloatRange(min=0.01),
    default=1.0,
    metavar="N",
    help="With --replay: N times as fast.",
)
@click.option(
    "--duration", cls=_LiveOption, metavar="TIME", help="Stop after this time, such as 10m."
)
@click.option(
    "--max-messages",
    cls=_LiveOption,
    type=click.IntRange(min=1),
    metavar="N",
    help="Stop after this number of messages.",
)
@click.option(
    "--max-size",
    cls=_LiveOption,
    metavar="SIZE",
    help="Stop after this size of payloads, such as 10GB.",
)
@click.option(
    "--split-size",
    cls=_LiveOption,
    default="1GiB",
    metavar="SIZE",
    help="Start a new segment file after this size.",
)
@click.option(
    "--split-duration",
    cls=_LiveOption,
    default="10m",
    metavar="TIME",
    help="Start a new segment file after this time.",
)
@click.option(
    "--use-sim-time",
    cls=_LiveOption,
    is_flag=True,
    help="Log times are those of /clock, the time of a simulation.",
)
@click.option(
    "--throttle",
    cls=_LiveOption,
    multiple=True,
    metavar="TOPIC RATE",
    shell_complete=complete_topic,
    help="At most this rate of messages, such as /camera 5Hz. Repeatable.",
)
@click.option(
    "--priority",
    cls=_LiveOption,
    multiple=True,
    metavar="TOPIC WORD",
    shell_complete=complete_topic,
    help="low, normal or high: when more arrives than can be written, payloads of the lowest "
    "priority are dropped first. Repeatable.",
)
@click.option(
    "--budget",
    cls=_LiveOption,
    metavar="SIZE",
    help="Size of payloads in memory; without, a sixteenth of all memory.",
)
@click.option(
    "--reserve",
    cls=_LiveOption,
    default="1GB",
    metavar="SIZE",
    help="Stop when the disk has less than this free.",
)
@click.option(
    "--flush-interval",
    cls=_LiveOption,
    default="1s",
    metavar="TIME",
    help="The most that a killed recorder can lose.",
)
@click.option(
    "--ring",
    cls=_LiveOption,
    metavar="TIME",
    help="Hold only the last TIME, in memory, and write it to disk at a trigger: --trigger, "
    "SIGUSR1, or `hybridlog trigger`.",
)
@click.option(
    "--trigger",
    cls=_LiveOption,
    multiple=True,
    metavar="TOPIC: PREDICATE",
    help="With --ring: a message that triggers, such as '/diagnostics: status[*].level >= 2'. "
    "Repeatable.",
)
@click.option(
    "--before",
    cls=_LiveOption,
    metavar="TIME",
    help="With --ring: time before the trigger; without, all.",
)
@click.option(
    "--after", cls=_LiveOption, metavar="TIME", help="With --ring: time after the trigger."
)
@click.option(
    "--contract",
    cls=_LiveOption,
    type=options.PATH,
    metavar="FILE",
    help="Tell and mark topics that are silent for longer than the rules in this file allow, and "
    "judge the recording at its end.",
)
@click.option(
    "--on-breach",
    cls=_LiveOption,
    metavar="COMMAND",
    help="With --contract: run this when a topic is silent; topic, rule and seconds follow.",
)
@click.option(
    "--shared",
    is_flag=True,
    help="If this makes the store: let the group of its directory write it.",
)
@options.mongo
@options.cache_size
@options.as_json
@options.quiet
@click.pass_context
def record_command(context: click.Context, /, **parameters: Any) -> None:
    """Record logs, or a running robot, into the store.

    Each path becomes a recording: a ROS 1 bag, a ROS 2 bag (its directory or one file), an
    MCAP file. All logs below a directory are recorded. Content that is in the store already is
    refused unless --again, or left out below a directory. The readable part of a damaged log is
    stored, and the rest is reported.

    With --ros1, --ros2, --foxglove or --replay, messages are recorded as they arrive, until
    Ctrl-C. Lost messages are counted: see `hybridlog losses`. Options marked "Live" are for
    this.
    """
    choices = RecordChoices(**parameters, live_options=_live_options(context))
    check_choices(choices)
    if choices.is_live:
        from hybridlog.cli.record_live import record_live

        record_live(choices)
    elif choices.watch:
        from hybridlog.cli.record_watch import record_watched

        record_watched(choices)
    else:
        from hybridlog.cli.record_logs import record_logs

        record_logs(choices)


def _live_options(context: click.Context) -> tuple[str, ...]:
    """The options for live recording that were given."""
    return tuple(
        parameter.opts[0]
        for parameter in context.command.params
        if isinstance(parameter, _LiveOption)
        and context.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE
    )
