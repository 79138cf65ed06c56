"""`hybridlog record` and `demo`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import click

from hybridlog.cli.binder import argument, command
from hybridlog.cli.hints import Command
from hybridlog.cli.record_choices import RecordChoices, check_choices


class _RecordCommand(Command):
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


@command(RecordChoices, cls=_RecordCommand)
def record_command(choices: RecordChoices) -> None:
    """Record logs, or a running robot, into the store.

    Each path becomes a recording: a ROS 1 bag, a ROS 2 bag (its directory or one file), an
    MCAP file. All logs below a directory are recorded. Content that is in the store already is
    refused unless --again, or left out below a directory. The readable part of a damaged log is
    stored, and the rest is reported.

    With --ros1, --ros2, --foxglove or --replay, messages are recorded as they arrive, until
    Ctrl-C. Lost messages are counted: see `hybridlog info --losses`. Options under
    "Live recording" are for this.
    """
    check_choices(choices)
    if choices.is_live:
        from hybridlog.cli.record_live import record_live

        record_live(choices)
    elif choices.watch:
        from hybridlog.cli.record_logs import record_watched

        record_watched(choices)
    else:
        from hybridlog.cli.record_logs import record_logs

        record_logs(choices)


@dataclass(frozen=True, kw_only=True)
class _Demo:
    directory: Path = argument(
        "Directory for the bag and the store of the demo.",
        "[DIRECTORY]",
        default=Path("hybridlog-demo"),
    )


@command(_Demo)
def demo_command(given: _Demo) -> int:
    """Take a tour: record the log of a simulated robot, query it."""
    from hybridlog.demo import tour

    return tour.run(given.directory)
