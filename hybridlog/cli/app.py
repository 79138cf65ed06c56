"""Commands and their options. Imports nothing heavy: `--help` answers at once."""

# ruff: noqa: FBT002, PLR0917 - typer makes options of parameters

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from hybridlog.cli.complete import (
    complete_field,
    complete_recording,
    complete_running,
    complete_topic,
)
from hybridlog.cli.exit_codes import as_text


class _Group(TyperGroup):
    """The commands; a reader of our output that has gone, as `head` does, is no error."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise typer.Exit(0) from None


class _RecordCommand(TyperCommand):
    """`record`, with two ways of writing options that the parser does not know."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take `--ros1 URI` for `--ros1 --master URI`, and `--throttle A B` for `A=B`."""
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
                # Where a value was forgotten, the next option must not be taken for it.
                has_value = bool(rest) and _is_value(rest[0])
                written.append(f"{word}={rest.pop(0)}" if has_value else word)
            else:
                written.append(word)
        return super().parse_args(ctx, written)


def _is_value(word: str) -> bool:
    return not word.startswith("-")


def _is_file(word: str) -> bool:
    return os.path.exists(word)  # noqa: PTH110 - what is too long for a path is no error here


app = typer.Typer(
    name="hybridlog",
    cls=_Group,
    help=(
        "Record what a robot says, and ask it.\n\n"
        "Payloads go into MCAP files, fields into MongoDB, one reader joins the two."
    ),
    epilog=(
        "The store is --store, else HYBRIDLOG_STORE, else ./hybridlog-store.\n\n"
        f"\b\nExit codes:\n{as_text()}"
    ),
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


class ClockName(StrEnum):
    """Which time a range is about."""

    LOG = "log"
    PUBLISH = "publish"
    HEADER = "header"


class Compression(StrEnum):
    """Compression of chunks."""

    ZSTD = "zstd"
    LZ4 = "lz4"
    NONE = "none"


class FetchFormat(StrEnum):
    """What `fetch` writes."""

    TABLE = "table"
    JSONL = "jsonl"
    CSV = "csv"
    PARQUET = "parquet"
    ARROW = "arrow"
    NPZ = "npz"
    MCAP = "mcap"
    BAG = "bag"
    RAW = "raw"


class ExportFormat(StrEnum):
    """What `export` writes."""

    PARQUET = "parquet"
    CSV = "csv"
    MCAP = "mcap"
    BAG = "bag"


# Paths are judged by the library, whose errors have messages and exit codes of their own:
# hence `readable=False` on each, which leaves typer's own check out.
StoreOption = Annotated[
    Path | None,
    typer.Option(
        "--store",
        envvar="HYBRIDLOG_STORE",
        help="Directory of the store.",
        metavar="DIR",
        readable=False,
    ),
]
MongoOption = Annotated[
    str | None,
    typer.Option(
        "--mongo",
        envvar="HYBRIDLOG_MONGO_URI",
        help="URI of the MongoDB that holds the index, or 'embedded' for our own; "
        "without, the one that the store was made with.",
        metavar="URI",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress, no tables; errors only.")
]
RecordingOption = Annotated[
    list[str] | None,
    typer.Option(
        "--recording",
        "-r",
        help="Only this recording (id, name, or the beginning of an id). Repeatable.",
        metavar="RECORDING",
        autocompletion=complete_recording,
    ),
]
OnlyRecordings = Annotated[
    list[str] | None,
    typer.Argument(
        help="Only these recordings.", metavar="RECORDING", autocompletion=complete_recording
    ),
]
OneRecording = Annotated[
    str,
    typer.Argument(
        help="A recording: label, name, or the beginning of its id.",
        metavar="RECORDING",
        autocompletion=complete_recording,
    ),
]
RunningOption = Annotated[
    list[str] | None,
    typer.Option(
        "--recording",
        "-r",
        help="Only this recorder (id or name of its recording, or the beginning of the id). "
        "Repeatable.",
        metavar="RECORDING",
        autocompletion=complete_running,
    ),
]
BetweenOption = Annotated[
    tuple[str, str] | None,
    typer.Option(
        help="From T0 up to, not including, T1: ISO 8601 (UTC without a zone), epoch seconds, "
        "integer nanoseconds, +5s or 1m30s from the start, -10s from the end, start, end.",
        metavar="T0 T1",
    ),
]
WhereOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Only messages that satisfy this, such as 'ranges.min < 0.5 and "
        "scan_time > 0'. Repeatable.",
        metavar="PREDICATE",
    ),
]
CountOption = Annotated[bool, typer.Option("--count", help="Only print how many.")]
OneTopicOption = Annotated[
    str,
    typer.Option(
        "--topic",
        "-t",
        help="Full name, or an unambiguous short one (scan).",
        metavar="TOPIC",
        autocompletion=complete_topic,
    ),
]
AtLeastOption = Annotated[
    str | None,
    typer.Option(help="Only those of at least this length, such as 60s.", metavar="DURATION"),
]
ForceOption = Annotated[bool, typer.Option("--force", "-f", help="Overwrite existing files.")]


@app.callback(invoke_without_command=True)
def root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Options before the command."""
    if version:
        from hybridlog import __version__

        typer.echo(f"hybridlog {__version__}")
        raise typer.Exit


@app.command(cls=_RecordCommand)
def record(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(
            help="ROS 1 bags, ROS 2 bags (files or directories), MCAP files.",
            metavar="PATH",
            readable=False,
        ),
    ] = None,
    store: StoreOption = None,
    topics: Annotated[
        list[str] | None,
        typer.Option(
            "--topics",
            "-t",
            help="Only these: name, glob, or re:REGEX. Repeatable.",
            metavar="TOPIC",
        ),
    ] = None,
    exclude: Annotated[
        list[str] | None,
        typer.Option("--exclude", "-x", help="Not these. Repeatable.", metavar="TOPIC"),
    ] = None,
    between: BetweenOption = None,
    name: Annotated[
        str | None,
        typer.Option(help="Name of the recording; without, the file's.", metavar="NAME"),
    ] = None,
    tag: Annotated[
        list[str] | None, typer.Option(help="Keep KEY=VALUE with it. Repeatable.", metavar="K=V")
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Record it even if its content is in the store.")
    ] = False,
    chunk_size: Annotated[
        str,
        typer.Option(help="Uncompressed size of a chunk, such as 512KiB.", metavar="SIZE"),
    ] = "2MiB",
    compression: Annotated[
        Compression, typer.Option(help="Compression of chunks.")
    ] = Compression.ZSTD,
    level: Annotated[
        int, typer.Option(help="zstd level, 1 to 19.", metavar="N", min=1, max=19)
    ] = 1,
    ros1: Annotated[
        bool,
        typer.Option(
            "--ros1",
            help="Record a running ROS 1 robot; a master's URI may follow, without it "
            "ROS_MASTER_URI counts.",
        ),
    ] = False,
    master: Annotated[
        str | None, typer.Option("--master", help="The ROS 1 master.", metavar="URI")
    ] = None,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Record a running ROS 2 robot; needs rclpy.")
    ] = False,
    qos: Annotated[
        Path | None,
        typer.Option(
            help="ROS 2: YAML file of QoS overrides, as rosbag2 has them.",
            metavar="FILE",
            readable=False,
        ),
    ] = None,
    foxglove: Annotated[
        str | None,
        typer.Option(help="Record what a Foxglove WebSocket server sends.", metavar="URL"),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(
            help="Play a log as if a robot ran, and record that.", metavar="FILE", readable=False
        ),
    ] = None,
    speed: Annotated[float, typer.Option(help="Of --replay.", metavar="N", min=0.01)] = 1.0,
    duration: Annotated[
        str | None, typer.Option(help="Live: stop after so long, such as 10m.", metavar="TIME")
    ] = None,
    max_messages: Annotated[
        int | None, typer.Option(help="Live: stop after so many.", metavar="N", min=1)
    ] = None,
    max_size: Annotated[
        str | None,
        typer.Option(help="Live: stop after so many payload bytes, such as 10GB.", metavar="SIZE"),
    ] = None,
    split_size: Annotated[
        str | None, typer.Option(help="A new segment file after so many bytes.", metavar="SIZE")
    ] = None,
    split_duration: Annotated[
        str | None, typer.Option(help="A new segment file after so long.", metavar="TIME")
    ] = None,
    throttle: Annotated[
        list[str] | None,
        typer.Option(
            help="Live: at most so many messages a second, such as /camera 5Hz. Repeatable.",
            metavar="TOPIC RATE",
            autocompletion=complete_topic,
        ),
    ] = None,
    priority: Annotated[
        list[str] | None,
        typer.Option(
            help="Live: low, normal or high; who keeps payloads longest when more comes than "
            "can be written. Repeatable.",
            metavar="TOPIC WORD",
            autocompletion=complete_topic,
        ),
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option(
            help="Live: payload bytes in memory; a sixteenth of all if not said.", metavar="SIZE"
        ),
    ] = None,
    reserve: Annotated[
        str,
        typer.Option(help="Live: stop when the disk has less than this left.", metavar="SIZE"),
    ] = "1GB",
    flush_interval: Annotated[
        str, typer.Option(help="Live: what a kill can cost at most.", metavar="TIME")
    ] = "1s",
    ring: Annotated[
        str | None,
        typer.Option(
            help="Live: keep only the last TIME, in memory, and write it out when something "
            "happens: --trigger, SIGUSR1, or `hybridlog trigger`.",
            metavar="TIME",
        ),
    ] = None,
    trigger: Annotated[
        list[str] | None,
        typer.Option(
            help="With --ring: when a message fits, such as '/diagnostics: status[*].level >= 2'. "
            "Repeatable.",
            metavar="TOPIC: PREDICATE",
        ),
    ] = None,
    before: Annotated[
        str | None,
        typer.Option(help="With --ring: time before the trigger; else all.", metavar="TIME"),
    ] = None,
    after: Annotated[
        str | None, typer.Option(help="With --ring: time after the trigger.", metavar="TIME")
    ] = None,
    shared: Annotated[
        bool,
        typer.Option(
            "--shared", help="If this makes the store: let the group of its directory write it."
        ),
    ] = False,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Record logs, or a running robot, into the store.

    Each path becomes a recording: a ROS 1 bag, a ROS 2 bag (its directory or one file), an
    MCAP file. Content that is in the store already is refused unless --again. What of a
    damaged log can be read is stored, and the rest is told.

    With --ros1, --ros2, --foxglove or --replay, what a robot says is recorded as it comes,
    until Ctrl-C. What cannot be kept is counted: see `hybridlog losses`.
    """
    from hybridlog.cli import record as command
    from hybridlog.cli.live_choices import LiveChoices

    command.run(
        paths or [],
        LiveChoices(
            ros1=ros1 or master is not None,
            master=master,
            ros2=ros2,
            qos=qos,
            foxglove=foxglove,
            replay=replay,
            speed=speed,
            duration=duration,
            max_messages=max_messages,
            max_size=max_size,
            split_size=split_size,
            split_duration=split_duration,
            budget=budget,
            reserve=reserve,
            flush_interval=flush_interval,
            throttle=throttle,
            priority=priority,
            ring=ring,
            trigger=trigger,
            before=before,
            after=after,
        ),
        command.Choices(
            store,
            topics,
            exclude,
            between,
            name,
            tag,
            again,
            chunk_size,
            compression.value,
            level,
            shared,
            mongo,
            as_json,
            quiet,
        ),
    )


@app.command()
def ls(
    store: StoreOption = None,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the recordings."""
    from hybridlog.cli import look

    look.list_recordings(store, mongo, as_json=as_json)


@app.command()
def info(
    what: Annotated[
        str | None,
        typer.Argument(
            help="A recording or a segment file; without, every recording.",
            metavar="RECORDING|SEGMENT",
            autocompletion=complete_recording,
        ),
    ] = None,
    store: StoreOption = None,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show topics, types, rates, sizes, times, clock skew, losses."""
    from hybridlog.cli import look

    look.show_info(what, store, mongo, as_json=as_json)


@app.command()
def losses(
    recording: Annotated[
        list[str] | None,
        typer.Argument(help="Recordings.", metavar="RECORDING", autocompletion=complete_recording),
    ] = None,
    store: StoreOption = None,
    topic: Annotated[
        list[str] | None,
        typer.Option(
            "--topic",
            "-t",
            help="Only of these. Repeatable.",
            metavar="TOPIC",
            autocompletion=complete_topic,
        ),
    ] = None,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what is missing, from when to when, and why."""
    from hybridlog.cli import losses as command

    command.show(recording or [], topic or [], store, mongo, as_json=as_json)


@app.command()
def top(
    recording: Annotated[
        str | None,
        typer.Argument(
            help="Which, when several are being recorded: id or name of the recording, or the "
            "beginning of the id.",
            metavar="RECORDING",
            autocompletion=complete_running,
        ),
    ] = None,
    store: StoreOption = None,
    field: Annotated[
        list[str] | None,
        typer.Option(
            help="Least, mean and greatest of a field in the last seconds, such as "
            "scan:ranges.min. Repeatable.",
            metavar="TOPIC:FIELD",
            autocompletion=complete_field,
        ),
    ] = None,
    last: Annotated[
        str, typer.Option(help="How many seconds --field looks back.", metavar="TIME")
    ] = "5s",
    once: Annotated[bool, typer.Option("--once", help="Show it once and leave.")] = False,
    mongo: MongoOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="A line of JSON a second, for scripts.")
    ] = False,
) -> None:
    """Watch a running recorder."""
    from hybridlog.cli import top as command

    command.run(recording, field or [], last, store, mongo, once=once, as_json=as_json)


@app.command()
def mark(
    text: Annotated[str, typer.Argument(help="What happened.", metavar="TEXT")],
    tag: Annotated[
        list[str] | None, typer.Option(help="Keep KEY=VALUE with it. Repeatable.", metavar="K=V")
    ] = None,
    recording: RunningOption = None,
    at: Annotated[
        str | None,
        typer.Option(
            help="Mark a recording that has ended, at this time: as for --between.", metavar="T"
        ),
    ] = None,
    store: StoreOption = None,
    quiet: QuietOption = False,
) -> None:
    """Set a mark that questions can use, now or at a time gone by.

    A mark is a message on /hybridlog/marks: `hybridlog fetch -t scan --event
    /hybridlog/marks "text = 'gripper slipped'" --before 5s --after 5s`.
    """
    if at is not None:
        from hybridlog.cli import edit

        edit.mark(text, tag or [], recording or [], at, store, quiet=quiet)
        return
    from hybridlog.cli import mark as command

    command.run(text, tag or [], recording or [], store, quiet=quiet)


@app.command()
def rename(
    recording: OneRecording,
    name: Annotated[str, typer.Argument(help="Its new name.", metavar="NAME")],
    store: StoreOption = None,
    quiet: QuietOption = False,
) -> None:
    """Give a recording another name.

    Its directory is renamed, too; the recording stays the same for everything else.
    """
    from hybridlog.cli import edit

    edit.rename(recording, name, store, quiet=quiet)


@app.command()
def tag(
    recording: OneRecording,
    pairs: Annotated[
        list[str] | None, typer.Argument(help="Tags; without, show them.", metavar="KEY=VALUE")
    ] = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Keep tags with a recording."""
    from hybridlog.cli import edit

    edit.tag(recording, pairs or [], store, as_json=as_json, quiet=quiet)


@app.command()
def untag(
    recording: OneRecording,
    keys: Annotated[list[str], typer.Argument(help="Keys of tags.", metavar="KEY")],
    store: StoreOption = None,
    quiet: QuietOption = False,
) -> None:
    """Remove tags of a recording."""
    from hybridlog.cli import edit

    edit.untag(recording, keys, store, quiet=quiet)


@app.command()
def note(
    recording: OneRecording,
    text: Annotated[str, typer.Argument(help="What to remember.", metavar="TEXT")],
    store: StoreOption = None,
    quiet: QuietOption = False,
) -> None:
    """Write a note about a recording; `info` shows it."""
    from hybridlog.cli import edit

    edit.note(recording, text, store, quiet=quiet)


@app.command(name="import")
def import_store(
    other: Annotated[
        Path, typer.Argument(help="The other store's directory.", metavar="STORE", readable=False)
    ],
    recording: Annotated[
        list[str] | None,
        typer.Option(
            "--recording",
            "-r",
            help="Only this recording of it (label, name, or id). Repeatable.",
            metavar="RECORDING",
        ),
    ] = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Copy recordings in from another store.

    Every byte is checked. After an interruption, run it again: what was copied stays.
    """
    from hybridlog.cli import edit

    edit.import_store(other, recording, store, as_json=as_json, quiet=quiet)


@app.command()
def trigger(
    name: Annotated[str, typer.Argument(help="Why, in a word.", metavar="NAME")],
    recording: RunningOption = None,
    store: StoreOption = None,
    quiet: QuietOption = False,
) -> None:
    """Let a recorder write its ring out now."""
    from hybridlog.cli import mark as command

    command.fire(name, recording or [], store, quiet=quiet)


@app.command()
def schema(
    topic: Annotated[
        str, typer.Argument(help="A topic.", metavar="TOPIC", autocompletion=complete_topic)
    ],
    store: StoreOption = None,
    recording: RecordingOption = None,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show a topic's message definition and its fields."""
    from hybridlog.cli import look

    look.show_schema(topic, store, recording, mongo, as_json=as_json)


@app.command()
def fetch(
    topic: Annotated[
        list[str],
        typer.Option(
            "--topic",
            "-t",
            help="Full name, an unambiguous short one (scan), a glob, or re:REGEX. Repeatable.",
            metavar="TOPIC",
            autocompletion=complete_topic,
        ),
    ],
    store: StoreOption = None,
    between: BetweenOption = None,
    clock: Annotated[
        ClockName, typer.Option(help="The time that --between is about.")
    ] = ClockName.LOG,
    at: Annotated[
        str | None,
        typer.Option(help="Only the message that was current at this time.", metavar="T"),
    ] = None,
    where: WhereOption = None,
    recording: RecordingOption = None,
    limit: Annotated[
        int | None,
        typer.Option("--limit", "-n", help="At most so many messages.", metavar="N", min=0),
    ] = None,
    every: Annotated[int, typer.Option(help="Only every n-th message.", metavar="N", min=1)] = 1,
    reverse: Annotated[bool, typer.Option("--reverse", help="Latest first.")] = False,
    fields: Annotated[
        str | None,
        typer.Option(help="Only these fields, with commas between them.", metavar="A,B.C"),
    ] = None,
    event: Annotated[
        tuple[str, str] | None,
        typer.Option(
            help="Only messages near those of TOPIC that satisfy PREDICATE, such as: rosout "
            "'level >= 8'. Needs --before or --after.",
            metavar="TOPIC PREDICATE",
        ),
    ] = None,
    before: Annotated[
        str | None,
        typer.Option(help="From so long before each event, such as 5min.", metavar="DURATION"),
    ] = None,
    after: Annotated[
        str | None,
        typer.Option(help="Until so long after each event.", metavar="DURATION"),
    ] = None,
    count: CountOption = False,
    form: Annotated[
        FetchFormat | None,
        typer.Option(
            "--format",
            "-F",
            help="Without: by the suffix of -o, else a table on a terminal, else jsonl.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Write to this file (raw: a directory); - is standard output.",
            metavar="FILE",
            readable=False,
        ),
    ] = None,
    force: ForceOption = False,
    mongo: MongoOption = None,
    quiet: QuietOption = False,
) -> None:
    """Fetch messages by topic, time and content.

    Without --format and -o: a table on a terminal, JSON lines elsewhere. What the answer has
    cost, and what it may lack, is said on standard error.
    """
    from hybridlog.cli import fetch as command

    command.run(
        command.Choices(
            topic,
            store,
            between,
            clock.value,
            at,
            where,
            recording,
            limit,
            every,
            reverse,
            fields,
            event,
            before,
            after,
            count,
            form.value if form else None,
            output,
            force,
            mongo,
            quiet,
        )
    )


@app.command()
def intervals(
    topic: OneTopicOption,
    store: StoreOption = None,
    between: BetweenOption = None,
    where: WhereOption = None,
    recording: RecordingOption = None,
    at_least: AtLeastOption = None,
    length: Annotated[
        str | None,
        typer.Option(
            help="Cut each into as many of exactly this length as fit, one after the other.",
            metavar="DURATION",
        ),
    ] = None,
    max_gap: Annotated[
        str | None,
        typer.Option(
            help="Believe a message for so long; without, until the next one.",
            metavar="DURATION",
        ),
    ] = None,
    count: CountOption = False,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Show when the messages of a topic satisfied a predicate.

    The state is what the last message said, until the next one or the end of the recording.
    """
    from hybridlog.cli import intervals as command

    asked = command.Asked(store, topic, between, where, recording, at_least, mongo)
    command.show_states(
        asked, length=length, max_gap=max_gap, count=count, as_json=as_json, quiet=quiet
    )


@app.command()
def changes(
    topic: OneTopicOption,
    fields: Annotated[
        str,
        typer.Option(help="Which fields, with commas between them.", metavar="A,B.C"),
    ],
    store: StoreOption = None,
    between: BetweenOption = None,
    where: WhereOption = None,
    recording: RecordingOption = None,
    pause: Annotated[
        str,
        typer.Option(help="Longest time between steps of one change.", metavar="DURATION"),
    ] = "1s",
    tolerance: Annotated[
        float,
        typer.Option(help="Numbers that differ by at most so much are the same.", metavar="X"),
    ] = 0.0,
    at_least: AtLeastOption = None,
    count: CountOption = False,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Show when fields of a topic changed.

    A step is a message that differs from the one before it; steps that follow each other
    within --pause are one change.
    """
    from hybridlog.cli import intervals as command

    asked = command.Asked(store, topic, between, where, recording, at_least, mongo)
    command.show_changes(
        asked,
        fields,
        pause=pause,
        tolerance=tolerance,
        count=count,
        as_json=as_json,
        quiet=quiet,
    )


@app.command()
def export(
    output: Annotated[
        Path,
        typer.Argument(
            help="File (mcap, bag) or directory (parquet, csv).", metavar="OUTPUT", readable=False
        ),
    ],
    form: Annotated[
        ExportFormat | None,
        typer.Option("--format", "-F", help="What to write; without, by the suffix (.mcap, .bag)."),
    ] = None,
    store: StoreOption = None,
    recording: RecordingOption = None,
    topic: Annotated[
        list[str] | None,
        typer.Option(
            "--topic",
            "-t",
            help="Only these. Repeatable.",
            metavar="TOPIC",
            autocompletion=complete_topic,
        ),
    ] = None,
    between: BetweenOption = None,
    force: ForceOption = False,
    mongo: MongoOption = None,
    quiet: QuietOption = False,
) -> None:
    """Export whole recordings; tables get one file a topic."""
    from hybridlog.cli import export as command

    command.run(
        output,
        form.value if form else None,
        command.Choices(store, recording, topic, between, force, mongo, quiet),
    )


@app.command()
def index(
    topic: Annotated[
        str | None,
        typer.Argument(help="A topic.", metavar="TOPIC", autocompletion=complete_topic),
    ] = None,
    field: Annotated[
        list[str] | None,
        typer.Argument(help="Its fields, the most telling first.", metavar="FIELD"),
    ] = None,
    store: StoreOption = None,
    remove: Annotated[bool, typer.Option("--remove", help="Drop this index.")] = False,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make questions about a field quick."""
    from hybridlog.cli import maintain

    maintain.index(topic, field or [], store, mongo, drop=remove, as_json=as_json, quiet=quiet)


@app.command()
def reindex(
    recording: RecordingOption = None,
    store: StoreOption = None,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make the index again from the segments, recording by recording.

    The others go on answering meanwhile. After an interruption, the next command that needs
    the index finishes the recording at which it was stopped.
    """
    from hybridlog.cli import maintain

    maintain.reindex(recording, store, mongo, as_json=as_json, quiet=quiet)


@app.command()
def verify(
    recording: OnlyRecordings = None,
    store: StoreOption = None,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Read everything, check checksums and references.

    Exits with 1, and a list with a cure for each, when something is off.
    """
    from hybridlog.cli import maintain

    maintain.verify(recording, store, mongo, as_json=as_json, quiet=quiet)


@app.command()
def repair(
    recording: OnlyRecordings = None,
    store: StoreOption = None,
    moved: Annotated[
        bool,
        typer.Option("--moved", help="The store was moved here: its index comes along."),
    ] = False,
    new_id: Annotated[
        bool,
        typer.Option(
            "--new-id",
            help="The store is a copy: make it a store of its own, with the index at --mongo.",
        ),
    ] = False,
    mongo: MongoOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Mend what can be mended without losing anything.

    Segments get their own names again, damaged summaries and journals are written again,
    catalog and index are brought up to date. Exits with 1, and a list, when something is
    left that only a copy can restore.
    """
    from hybridlog.cli import maintain

    maintain.repair(
        recording, store, mongo, moved=moved, new_id=new_id, as_json=as_json, quiet=quiet
    )


@app.command()
def rm(
    recording: Annotated[
        list[str],
        typer.Argument(help="Recordings.", metavar="RECORDING", autocompletion=complete_recording),
    ],
    store: StoreOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    mongo: MongoOption = None,
) -> None:
    """Delete recordings, payloads and index."""
    from hybridlog.cli import maintain

    maintain.remove(recording, store, mongo, yes=yes)


@app.command()
def trust(
    store: StoreOption = None,
    forget: Annotated[
        bool, typer.Option("--forget", help="Agree no more to what this store names.")
    ] = False,
) -> None:
    """Agree to the MongoDB that a store of somebody else's names.

    Without that, commands do not connect there: only what this user made is trusted. The
    password is not kept in the store: see HYBRIDLOG_MONGO_PASSWORD.
    """
    from hybridlog.cli import trust as command

    command.run(store, forget=forget)


@app.command()
def demo(
    directory: Annotated[
        Path,
        typer.Argument(
            help="Where the bag and the store of the demo go.", metavar="DIRECTORY", readable=False
        ),
    ] = Path("hybridlog-demo"),
    duration: Annotated[
        float, typer.Option(help="Seconds of robot time.", metavar="SECONDS", min=5)
    ] = 60.0,
    seed: Annotated[int, typer.Option(help="Another number, another drive.", metavar="N")] = 1,
) -> None:
    """Take a tour: simulate a robot, record it, ask it."""
    from hybridlog.demo import tour

    raise typer.Exit(tour.run(directory, duration_s=duration, seed=seed))
