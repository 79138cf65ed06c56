"""Help, exit codes, speed of the start, and what is not imported for it."""

from __future__ import annotations

import resource
import subprocess
import sys
import typing
from pathlib import Path

import pytest

from hybridlog.cli.app import app
from hybridlog.cli.main import EXIT_CODES

from .running import COMMAND, complete, environment, run

HEAVY = {"numpy", "pandas", "pyarrow", "pymongo", "rosbags", "mcap", "zstandard", "rich"}
COMMANDS = [
    "record",
    "losses",
    "top",
    "mark",
    "trigger",
    "ls",
    "info",
    "schema",
    "fetch",
    "export",
    "reindex",
    "verify",
    "rm",
    "demo",
]


def imported(*arguments: object) -> set[str]:
    """Top packages that a command imports."""
    ended = subprocess.run(
        [sys.executable, "-X", "importtime", *COMMAND[1:], *map(str, arguments)],
        capture_output=True,
        text=True,
        env=environment(),
        check=True,
    )
    lines = [line for line in ended.stderr.splitlines() if line.startswith("import time:")]
    return {line.rsplit("|", 1)[1].strip().split(".")[0] for line in lines}


def test_help_imports_nothing_heavy_and_is_fast() -> None:
    assert not imported("--help") & HEAVY
    assert not imported("fetch", "--help") & HEAVY
    times = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run("--help")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        # Work, not time gone by: others may be busy.
        times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        if times[-1] < 0.2:
            return
    assert min(times) < 0.6, times


def test_looking_imports_no_table_libraries(store: Path) -> None:
    for command in ("ls", "info"):
        assert not imported(command, "--store", store) & {"pandas", "pyarrow", "rosbags"}


def test_help_names_commands_and_exit_codes() -> None:
    out = run("--help").out
    for command in COMMANDS:
        assert f"\n  {command} " in out
        assert run(command, "--help").out.startswith("Usage: ")
    for code, meaning in EXIT_CODES.items():
        assert f"{code:>3}  {meaning}" in out
    assert "..." not in out.split("Commands:")[1].split("The store is")[0]


def test_version() -> None:
    from hybridlog import __version__

    assert run("--version").out == f"hybridlog {__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [("nothing",), ("ls", "--nothing"), ("fetch",), ("fetch", "-t", "x", "--limit", "-1")],
)
def test_wrong_usage_is_code_2(arguments: tuple[str, ...]) -> None:
    done = run(*arguments, code=2)
    assert done.out == ""
    assert "Error" in done.err


def test_usage_names_what_is_wanted() -> None:
    for command, words in (
        ("record", "[PATH]..."),
        ("schema", "{TOPIC}"),
        ("verify", "[RECORDING]..."),
        ("rm", "{RECORDING}..."),
        ("export", "-t, --topic TOPIC"),
    ):
        assert words in run(command, "--help").out


def test_completion(store: Path) -> None:
    assert complete(f"info --store {store} r") == ["robot"]
    assert complete(f"verify --store {store} o") == ["odd"]
    assert complete(f"fetch --store {store} --topic /base/s") == ["/base/scan"]
    assert complete(f"fetch --store {store} --topic sca") == ["scan"]
    # Two cameras have one, so the short name stands for none.
    assert complete(f"fetch --store {store} --topic image_") == []
    assert complete(f"fetch --store {store} --recording odd --topic /base") == []
    assert complete(f"fetch --store {store} --recording t") == ["torn"]
    assert complete(f"losses --store {store} -t /base/s") == ["/base/scan"]
    assert complete(f"record --store {store} --throttle /base/s") == ["/base/scan"]
    assert complete(f"top --store {store} --field /base/s") == ["/base/scan:"]
    assert complete(f"trigger x --store {store} -r r") == []  # nothing is recorded now
    assert "--between" in complete("fetch --be")
    assert complete("info --store /nowhere r") == []


def test_paths_are_judged_by_the_library() -> None:
    """Its errors say what to do and have exit codes of their own; typer's have neither."""
    seen = 0
    for command in app.registered_commands:
        assert command.callback is not None
        for hint in typing.get_type_hints(command.callback, include_extras=True).values():
            if typing.get_origin(hint) is typing.Annotated and "Path" in str(hint.__origin__):
                seen += 1
                assert not hint.__metadata__[0].readable, (command.callback.__name__, hint)
    assert seen > 10
