"""The commands and their options: `python -m benchmarks`, and `hybridlog bench`.

Imports nothing heavy: `--help` answers at once.
"""

# ruff: noqa: FBT002, PLR0917 - typer makes options of parameters

from __future__ import annotations

import sys
from collections.abc import Sequence
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

_EXIT_CODES = (
    "\b\nExit codes:\n"
    "    0  done\n"
    "    1  a run failed, or backends gave different answers\n"
    "    2  the question is wrong: an option, a name, a directory\n"
    "    3  a log cannot be read\n"
    "  130  interrupted (Ctrl-C); the same command goes on where it stopped\n"
    "  143  ended (SIGTERM); so does it then"
)

app = typer.Typer(
    name="benchmarks",
    help=(
        "Measure what databases, files and hybridlog keep of a robot's messages.\n\n"
        "Three studies: what is kept of uniform streams, what is kept of logs, and how "
        "fast questions are answered. Results go into a directory; a study that was stopped "
        "goes on when the same command is given again. Try `all --quick` first."
    ),
    epilog=_EXIT_CODES,
    no_args_is_help=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)


class Part(StrEnum):
    """What `all` consists of."""

    THROUGHPUT = "throughput"
    CEILINGS = "ceilings"
    PERSISTENCE = "persistence"
    SPEED_UP = "speed-up"
    QUERIES = "queries"
    READING = "reading"


_PARTS = f"[{'|'.join(Part)}]"


QuickOption = Annotated[
    bool,
    typer.Option(
        "--quick",
        help="Few messages, few repetitions, the ends of each axis: minutes, not hours.",
    ),
]
BackendsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--backends",
        "-b",
        help="Only these, with commas between them; the beginning of a name will do if no "
        "other begins so. Repeatable.",
        metavar="NAME,…",
    ),
]
ListOption = Annotated[
    bool,
    typer.Option("--list-backends", help="Show the backends, and whether they can run here."),
]
OutOption = Annotated[
    Path,
    typer.Option(
        "--out",
        "-o",
        help="Where journal and report go; what is in the journal is not run again.",
        metavar="DIR",
        readable=False,
    ),
]
WorkOption = Annotated[
    Path | None,
    typer.Option(
        help="Where loads and the backends' data go, and where loads are kept; without, a "
        "temporary directory.",
        metavar="DIR",
        readable=False,
    ),
]
RestartOption = Annotated[
    bool, typer.Option("--restart", help="Begin anew; the journal that is there is set aside.")
]
ReportOption = Annotated[
    bool, typer.Option("--report/--no-report", help="Write the report at the end.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]
SeedOption = Annotated[int, typer.Option(help="Of all loads.", metavar="N", min=0)]
RepetitionsOption = Annotated[
    int | None,
    typer.Option(
        "--repetitions",
        "-n",
        help="Of every run; without, as each study needs.",
        metavar="N",
        min=1,
    ),
]
SizesOption = Annotated[
    str | None,
    typer.Option(help="Message sizes, such as 5kB,640kB; without, the paper's.", metavar="SIZE,…"),
]
RatesOption = Annotated[
    str | None,
    typer.Option(help="Rates a topic in Hz, such as 4,64; without, the paper's.", metavar="HZ,…"),
]
MessagesOption = Annotated[
    int | None, typer.Option(help="Messages a topic; without, 500.", metavar="N", min=1, max=10**7)
]
TopicsOption = Annotated[
    int | None, typer.Option(help="Topics; without, 20.", metavar="N", min=1, max=10**4)
]
SecondsOption = Annotated[
    float | None,
    typer.Option(
        help="Length of each run that looks for a ceiling.", metavar="S", min=0.1, max=86400
    ),
]
SpeedOption = Annotated[
    float,
    typer.Option(help="Publish N times as fast as recorded.", metavar="N", min=0.01, max=10**6),
]
LogsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--logs",
        "-l",
        help="Publish this log, a bag or an MCAP file, or all in a directory. Repeatable.",
        metavar="FILE",
        readable=False,
    ),
]
MadeOption = Annotated[
    bool,
    typer.Option("--made/--no-made", help="Publish the logs that are made like the paper's, too."),
]
LogSecondsOption = Annotated[
    float | None,
    typer.Option(
        help="Most of each log that is published, from its beginning; without, 60, and 20 where "
        "it is played faster.",
        metavar="S",
        min=0.1,
        max=86400,
    ),
]
CeilingsOption = Annotated[
    bool, typer.Option("--ceilings/--no-ceilings", help="Look for each backend's ceiling, too.")
]
SpeedUpOption = Annotated[
    bool,
    typer.Option("--speed-up/--no-speed-up", help="Play the logs faster until one drops, too."),
]
ReadingOption = Annotated[
    bool, typer.Option("--reading/--no-reading", help="Fetch slices and whole tables, too.")
]


@app.callback(invoke_without_command=True)
def root(context: typer.Context, backends: ListOption = False) -> None:
    """Options before the command."""
    if backends:
        _list(as_json=False)
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def throughput(
    quick: QuickOption = False,
    backends: BackendsOption = None,
    list_backends: ListOption = False,
    out: OutOption = Path("benchmark-results"),
    sizes: SizesOption = None,
    rates: RatesOption = None,
    messages: MessagesOption = None,
    topics: TopicsOption = None,
    ceilings: CeilingsOption = True,
    seconds: SecondsOption = None,
    repetitions: RepetitionsOption = None,
    seed: SeedOption = 1,
    work: WorkOption = None,
    restart: RestartOption = False,
    report: ReportOption = True,
    as_json: JsonOption = False,
) -> None:
    """Study 1: what is kept of uniform streams.

    Twenty topics, eight message sizes by three rates, as in the paper; then the largest load
    of which each backend keeps everything.
    """
    from benchmarks.campaign import Choices

    parts = ["throughput", *(["ceilings"] if ceilings else [])]
    _go(
        Choices(
            parts,
            out,
            quick=quick,
            backends=backends,
            sizes=sizes,
            rates=rates,
            messages=messages,
            topics=topics,
            seconds=seconds,
            repetitions=repetitions,
            seed=seed,
            work=work,
            restart=restart,
            report=report,
            as_json=as_json,
        ),
        only_list=list_backends,
    )


@app.command()
def persistence(
    quick: QuickOption = False,
    backends: BackendsOption = None,
    list_backends: ListOption = False,
    out: OutOption = Path("benchmark-results"),
    logs: LogsOption = None,
    made: MadeOption = True,
    log_seconds: LogSecondsOption = None,
    speed: SpeedOption = 1.0,
    speed_up: SpeedUpOption = True,
    repetitions: RepetitionsOption = None,
    seed: SeedOption = 1,
    work: WorkOption = None,
    restart: RestartOption = False,
    report: ReportOption = True,
    as_json: JsonOption = False,
) -> None:
    """Study 2: what is kept of logs.

    Published as they were recorded, then faster until something is dropped: made ones like
    the paper's, and the real ones that lie beside the checkout, or those of --logs instead.
    """
    from benchmarks.campaign import Choices

    parts = ["persistence", *(["speed-up"] if speed_up else [])]
    _go(
        Choices(
            parts,
            out,
            quick=quick,
            backends=backends,
            logs=logs or (),
            made=made,
            log_seconds=log_seconds,
            speed=speed,
            repetitions=repetitions,
            seed=seed,
            work=work,
            restart=restart,
            report=report,
            as_json=as_json,
        ),
        only_list=list_backends,
    )


@app.command()
def queries(
    quick: QuickOption = False,
    backends: BackendsOption = None,
    list_backends: ListOption = False,
    out: OutOption = Path("benchmark-results"),
    reading: ReadingOption = True,
    repetitions: RepetitionsOption = None,
    seed: SeedOption = 1,
    work: WorkOption = None,
    restart: RestartOption = False,
    report: ReportOption = True,
    as_json: JsonOption = False,
) -> None:
    """Study 3: how fast questions are answered.

    The paper's four, to every system in its own language; then slices, messages at random,
    whole tables.
    """
    from benchmarks.campaign import Choices

    parts = ["queries", *(["reading"] if reading else [])]
    _go(
        Choices(
            parts,
            out,
            quick=quick,
            backends=backends,
            repetitions=repetitions,
            seed=seed,
            work=work,
            restart=restart,
            report=report,
            as_json=as_json,
        ),
        only_list=list_backends,
    )


@app.command("all")
def everything(
    quick: QuickOption = False,
    backends: BackendsOption = None,
    list_backends: ListOption = False,
    out: OutOption = Path("benchmark-results"),
    only: Annotated[
        list[Part] | None,
        typer.Option("--only", help="Only this part. Repeatable.", metavar=_PARTS),
    ] = None,
    ceilings: CeilingsOption = True,
    speed_up: SpeedUpOption = True,
    reading: ReadingOption = True,
    sizes: SizesOption = None,
    rates: RatesOption = None,
    messages: MessagesOption = None,
    topics: TopicsOption = None,
    seconds: SecondsOption = None,
    logs: LogsOption = None,
    made: MadeOption = True,
    log_seconds: LogSecondsOption = None,
    speed: SpeedOption = 1.0,
    repetitions: RepetitionsOption = None,
    seed: SeedOption = 1,
    work: WorkOption = None,
    restart: RestartOption = False,
    report: ReportOption = True,
    as_json: JsonOption = False,
) -> None:
    """The three studies, one after the other."""
    from benchmarks.campaign import Choices

    without = {
        Part.CEILINGS: not ceilings,
        Part.SPEED_UP: not speed_up,
        Part.READING: not reading,
    }
    parts = [
        part.value for part in Part if (not only or part in only) and not without.get(part, False)
    ]
    _go(
        Choices(
            parts,
            out,
            quick=quick,
            backends=backends,
            sizes=sizes,
            rates=rates,
            messages=messages,
            topics=topics,
            seconds=seconds,
            logs=logs or (),
            made=made,
            log_seconds=log_seconds,
            speed=speed,
            repetitions=repetitions,
            seed=seed,
            work=work,
            restart=restart,
            report=report,
            as_json=as_json,
        ),
        only_list=list_backends,
    )


@app.command("report")
def write_report(out: OutOption = Path("benchmark-results"), as_json: JsonOption = False) -> None:
    """Draw the report again, from the journal."""
    from benchmarks import campaign

    raise typer.Exit(campaign.draw(out, as_json=as_json))


def _forward(name: str, module: str, about: str) -> None:
    """A command that reads its own arguments."""

    def command(
        arguments: Annotated[list[str] | None, typer.Argument(metavar="ARGUMENT")] = None,
    ) -> None:
        raise typer.Exit(import_module(module).main(arguments or []))

    app.command(
        name,
        help=about,
        add_help_option=False,
        context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
    )(command)


_forward("speed", "benchmarks.speed.command", "Hybridlog against its own speed targets.")
_forward(
    "live",
    "benchmarks.live.command",
    "Recording a running robot under load, beside rosbag record.",
)
_forward(
    "micro",
    "benchmarks.micro.command",
    "The hot paths, one at a time, and against another revision.",
)


def _go(choices: object, *, only_list: bool) -> None:
    from benchmarks import campaign

    assert isinstance(choices, campaign.Choices)
    if only_list:
        _list(as_json=choices.as_json)
        raise typer.Exit
    raise typer.Exit(campaign.run(choices, _called()))


def _list(*, as_json: bool) -> None:
    from benchmarks import campaign

    campaign.list_backends(as_json=as_json)


_calls: list[list[str]] = []
"""The words of the command that is being run, the last of them."""


def _called() -> list[str]:
    return _calls[-1]


def main(arguments: Sequence[str], program: str = "python -m benchmarks") -> int:
    """Run a command.

    Args:
        arguments: Without the program's name.
        program: How it was called, for messages.

    Returns:
        The exit code.
    """
    from hybridlog.cli import signals
    from hybridlog.cli.exit_codes import of_os_error
    from hybridlog.cli.output import printable
    from hybridlog_storage.errors import HybridlogError

    signals.install()
    _calls.append([*program.split(), *arguments])
    try:
        app(args=list(arguments), prog_name=program)
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    except HybridlogError as error:
        print(f"benchmarks: {printable(str(error))}", file=sys.stderr)
        return error.exit_code
    except signals.Stopped as stopped:
        print(f"\nbenchmarks: interrupted. {stopped.consequence}".rstrip(), file=sys.stderr)
        return stopped.exit_code
    except BrokenPipeError:
        return 0
    except OSError as error:
        told = f"{error}. What was measured before stays; the same command goes on with it."
        print(f"benchmarks: {printable(told)}", file=sys.stderr)
        return of_os_error(error)
    return 0
