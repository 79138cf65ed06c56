"""Parameters that several commands share, and types of parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import Any, Final

import click

from hybridlog.cli.completion import (
    complete_condition,
    complete_recording,
    complete_running,
    complete_tag,
    complete_topic,
    complete_type,
)
from hybridlog.cli.output import parse_size
from hybridlog.formats import formats_of
from hybridlog.query.choice import Choice
from hybridlog_storage.errors import UsageError

PATH: Final = click.Path(readable=False, path_type=Path)
"""A path that click does not check: the library's errors name a cure and have exit codes."""

store = click.option(
    "--store",
    type=PATH,
    envvar="HYBRIDLOG_STORE",
    show_envvar=True,
    metavar="DIR",
    help="Directory of the store.",
)
mongo = click.option(
    "--mongo",
    envvar="HYBRIDLOG_MONGO_URI",
    show_envvar=True,
    metavar="URI",
    help="URI of the MongoDB that holds the index, 'embedded' for our own, or 'none'; without, "
    "the one that the store was made with.",
)
cache_size = click.option(
    "--cache-size",
    type=int,
    envvar="HYBRIDLOG_CACHE_SIZE",
    show_envvar=True,
    metavar="MB",
    help="Size of the embedded MongoDB's cache, from 256; without, the one that the store was "
    "made with, or 256.",
)
VERBOSE: Final = f"{__name__}.verbose"
"""Key in `click.Context.meta`: True with `--verbose`."""

as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON, for scripts.")
quiet = click.option("--quiet", "-q", is_flag=True, help="No progress, no tables; errors only.")
verbose = click.option(
    "--verbose",
    "-v",
    is_flag=True,
    expose_value=False,
    callback=lambda ctx, _, value: ctx.meta.update({VERBOSE: value}),
    help="Say what the answer has cost.",
)
force = click.option("--force", "-f", is_flag=True, help="Overwrite existing files.")
strict = click.option(
    "--strict",
    is_flag=True,
    help="Fail, with exit code 11, if the ledger knows of losses in this range.",
)
count = click.option("--count", is_flag=True, help="Only print how many.")
_CHOICE: Final = (
    click.option(
        "--recording",
        "-r",
        multiple=True,
        metavar="RECORDING",
        shell_complete=complete_recording,
        help="Only this recording: label, name, the beginning of a label or an id, or a glob "
        "such as 'monday*'. Repeatable.",
    ),
    click.option(
        "--tag",
        multiple=True,
        metavar="K=V",
        shell_complete=complete_tag,
        help="Only recordings with this tag; K alone is any value. Repeatable.",
    ),
    click.option(
        "--has",
        multiple=True,
        metavar="TOPIC",
        shell_complete=complete_topic,
        help="Only recordings with this topic. Repeatable.",
    ),
    click.option(
        "--type",
        "types",
        multiple=True,
        metavar="TYPE",
        shell_complete=complete_type,
        help="Only recordings with messages of this type: sensor_msgs/Imu, Imu, or a glob. "
        "Repeatable.",
    ),
    click.option(
        "--during",
        nargs=2,
        metavar="T0 T1",
        help="Only recordings with a time in this range: ISO 8601, epoch seconds, now, start, end.",
    ),
    click.option(
        "--with",
        "conditions",
        multiple=True,
        metavar="TOPIC: PREDICATE",
        shell_complete=complete_condition,
        help="Only recordings with a message that satisfies this, such as "
        "'scan: ranges.min < 0.5'. Repeatable.",
    ),
)


def choice(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that choose recordings; the function gets them as `choice`.

    Names in an argument of the command called `names` count as `--recording`.
    """

    @wraps(function)
    def chosen(
        *,
        recording: tuple[str, ...],
        tag: tuple[str, ...],
        has: tuple[str, ...],
        types: tuple[str, ...],
        during: tuple[str, str] | None,
        conditions: tuple[str, ...],
        names: tuple[str, ...] = (),
        **others: Any,
    ) -> Any:
        made = Choice.of(
            (*names, *recording), tag=tag, has=has, type=types, during=during, where=conditions
        )
        return function(choice=made, **others)

    for option in reversed(_CHOICE):
        chosen = option(chosen)
    return chosen


running = click.option(
    "--recording",
    "-r",
    multiple=True,
    metavar="RECORDING",
    shell_complete=complete_running,
    help="Only this recorder (id or name of its recording, or the beginning of the id). "
    "Repeatable.",
)
only_recordings = click.argument(
    "names",
    nargs=-1,
    metavar="[RECORDING]...",
    shell_complete=complete_recording,
    help="Only these recordings, as for --recording; without, all.",
)
one_recording = click.argument(
    "recording",
    metavar="RECORDING",
    shell_complete=complete_recording,
    help="A recording: label, name, or the beginning of its id.",
)
one_topic = click.option(
    "--topic",
    "-t",
    required=True,
    metavar="TOPIC",
    shell_complete=complete_topic,
    help="Full name, or an unambiguous short one (scan).",
)
topics = click.option(
    "--topic",
    "-t",
    required=True,
    multiple=True,
    metavar="TOPIC",
    shell_complete=complete_topic,
    help="Full name, an unambiguous short one (scan), a glob, or re:REGEX. Repeatable.",
)
only_topics = click.option(
    "--topic",
    "-t",
    multiple=True,
    metavar="TOPIC",
    shell_complete=complete_topic,
    help="Only these topics. Repeatable.",
)
between = click.option(
    "--between",
    nargs=2,
    metavar="T0 T1",
    help="From T0 up to, not including, T1: ISO 8601 (UTC without a zone), epoch seconds, "
    "integer nanoseconds, +5s or 1m30s from the start, -10s from the end, start, end.",
)
no_latched = click.option(
    "--no-latched",
    is_flag=True,
    help="With --between: leave out the latched messages and frames of video from before it.",
)
original_times = click.option(
    "--original-times",
    is_flag=True,
    help="Latched messages and frames from before the time range keep their log time.",
)
where = click.option(
    "--where",
    multiple=True,
    metavar="PREDICATE",
    help="Only messages that satisfy this, such as 'ranges.min < 0.5 and scan_time > 0'. "
    "Repeatable.",
)
near = click.option(
    "--tolerance",
    metavar="DURATION",
    help="Greatest distance in time, such as 20ms; without, any.",
)
in_frame = click.option(
    "--in-frame",
    "frame",
    metavar="FRAME",
    help="Points and poses in this frame, such as map, at the times of their headers.",
)
bag_storage = click.option(
    "--storage",
    type=click.Choice(["mcap", "sqlite3"]),
    help="For rosbag2: the storage of the bag; without, mcap.",
)
bag_file_size = click.option(
    "--file-size",
    metavar="SIZE",
    help="For rosbag2: begin a new file at so many bytes of payload, such as 500MB; without, 2GiB.",
)
tag_columns = click.option(
    "--tags", metavar="A,B", help="Tags of the recordings as columns, with commas between them."
)
at_least = click.option(
    "--at-least",
    metavar="DURATION",
    help="Only those of at least this length, such as 60s.",
)
tags = click.option(
    "--tag", multiple=True, metavar="K=V", help="Store KEY=VALUE with it. Repeatable."
)


def check_latched(*, no_latched: bool, original_times: bool, form: str | None) -> None:
    """Refuse options about latched messages that have no effect.

    Args:
        no_latched: `--no-latched` was given.
        original_times: `--original-times` was given.
        form: Format of the output; None for a recording.

    Raises:
        UsageError: They contradict each other, or the format has no such messages.
    """
    if no_latched and original_times:
        raise UsageError("--no-latched leaves no messages for --original-times: give one of them.")
    logs = formats_of("log")
    if original_times and form not in {None, *logs}:
        raise UsageError(
            f"Latched messages from before the time range are in {' and '.join(logs)}, not in "
            f"{form}: "
            "leave out --original-times."
        )


def bag_settings(storage: str | None, file_size: str | None, form: str) -> dict[str, Any]:
    """Arguments of the writer of a bag of ROS 2.

    Raises:
        UsageError: The format is another one, or the size is none.
    """
    if (storage, file_size) != (None, None) and form != "rosbag2":
        raise UsageError(f"--storage and --file-size are for rosbag2, not for {form}.")
    if form != "rosbag2":
        return {}
    settings: dict[str, Any] = {"storage": storage or "mcap"}
    if file_size is not None:
        settings["max_file"] = parse_size(file_size)
        if not settings["max_file"]:
            raise UsageError("--file-size must be more than 0.")
    return settings


def check_tags(tags: str | None, form: str) -> None:
    """Refuse --tags where the format has no columns.

    Raises:
        UsageError: It has none.
    """
    if tags is not None and form in formats_of("log", "payloads", "pictures", "video"):
        raise UsageError(f"--tags adds columns to tables, and {form} has none: leave it out.")


def parse_tags(pairs: Iterable[str]) -> dict[str, str]:
    """Tags from KEY=VALUE pairs.

    Raises:
        UsageError: A pair has no key or no equals sign.
    """
    tags = {}
    for pair in pairs:
        key, sign, value = pair.partition("=")
        if not sign or not key:
            raise UsageError(f"A tag is written KEY=VALUE, not {pair!r}.")
        tags[key] = value
    return tags
