"""Help, completion, exit codes, and the modules that commands import."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import cast

import click
import pytest

from hybridlog.cli.app import COMMANDS, EXIT_CODES, GROUPS, app
from tests.json_schemas import misfit, schema_of, schemas

from .running import COMMAND, complete, environment, run

ROOT = Path(__file__).parents[2]
HEAVY = {"numpy", "pandas", "pyarrow", "pymongo", "rosbags", "mcap", "zstandard"}

LISTED = """
import atexit, os, sys
os._exit = sys.exit  # a command leaves without the interpreter's own end

@atexit.register
def show():
    is_late = "__file__" not in vars(sys.modules.get("numpy", os))  # and was not needed
    shown = [name for name in sys.modules if name != "numpy" or not is_late]
    print("", *shown, sep="\\n", file=sys.stderr)

from hybridlog.cli import main
main()
"""


def modules_of(*arguments: object, **variables: str) -> set[str]:
    """Modules that a command imports."""
    ended = subprocess.run(
        [sys.executable, "-c", LISTED, *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(**variables),
        check=True,
    )
    return set(ended.stderr.splitlines())


def test_help_imports_little() -> None:
    """Each module costs about a millisecond: the number of modules is the time of the start."""
    for arguments, most in ((("--help",), 235), (("fetch", "--help"), 185)):
        loaded = modules_of(*arguments)
        assert not {name.split(".")[0] for name in loaded} & HEAVY
        assert len(loaded) < most, sorted(loaded)


def test_looking_imports_neither_numbers_nor_tables(store: Path) -> None:
    line = f"fetch --store {store} /base/sc"
    words = {"COMP_WORDS": f"hybridlog {line}", "COMP_CWORD": str(len(line.split()))}
    found = modules_of(_HYBRIDLOG_COMPLETE="bash_complete", **words)
    for asked in (("ls", "--tag", "place"), ("info", "robot")):
        found |= modules_of(*asked, "--store", store)
    assert not {name.split(".")[0] for name in found} & (HEAVY - {"mcap", "zstandard"})


def test_help_names_commands_and_exit_codes() -> None:
    out = run("--help").out
    assert run("-h").out == out
    assert run("fetch", "-h").out == run("fetch", "--help").out
    assert len(COMMANDS) <= 28
    for title, commands in GROUPS.items():
        lines = out.split(f"\n{title}:\n")[1].splitlines()
        assert [line.split()[0] for line in lines[: len(commands)]] == [*commands]
    for code, meaning in EXIT_CODES.items():
        assert f"{code} {meaning}" in " ".join(out.split())
    assert "..." not in out.split("Record:")[1].split("The store is")[0]


def test_version() -> None:
    from hybridlog import __version__

    assert run("--version").out == f"hybridlog {__version__}\n"


def test_every_extra_is_named() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (listed,) = re.findall(r"Extras: (.+), or `all`", (ROOT / "README.md").read_text())
    extras = {*project["optional-dependencies"]} - {"all", "bench", "dev"}
    assert extras <= {*re.findall(r"`([^`]+)`", listed)}


@pytest.mark.parametrize(
    "arguments",
    [("nothing",), ("ls", "--nothing"), ("fetch",), ("fetch", "-t", "x", "--limit", "-1")],
)
def test_wrong_usage_is_code_2(arguments: tuple[str, ...]) -> None:
    done = run(*arguments, code=2)
    assert done.out == ""
    assert done.err.startswith("hybridlog: ")
    assert done.err.count("\n") <= 2


def test_completion(store: Path) -> None:
    assert complete(f"info --store {store} r") == ["robot"]
    assert complete(f"fetch --store {store} --recording t") == ["torn"]
    assert complete(f"fetch --store {store} --topic /base/s") == ["/base/scan"]
    assert complete(f"info --losses --store {store} -t /base/s") == ["/base/scan"]
    assert "--between" in complete("fetch --be")
    assert complete("info --store /nowhere r") == []


def commands() -> dict[str, click.Command]:
    context = click.Context(app)
    found = {name: app.get_command(context, name) for name in COMMANDS}
    return {name: command for name, command in found.items() if command is not None}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command_describes_it_and_every_parameter(name: str) -> None:
    out = run(*name.split(), "--help").out
    command: click.Command = app
    for word in name.split():
        found = cast("click.Group", command).get_command(click.Context(command), word)
        assert found is not None
        command = found
    assert out.startswith(f"Usage: hybridlog {name} ")
    assert command.help is not None
    assert command.get_short_help_str(200) in " ".join(out.split())
    for each in getattr(command, "commands", {}):
        assert f"\n  {each} " in out
        test_help_of_a_command_describes_it_and_every_parameter(f"{name} {each}")
    for parameter in command.params:
        assert parameter.help, parameter.name
        shown = parameter.opts if isinstance(parameter, click.Option) else [parameter.metavar]
        for word in shown:
            assert word in out, (parameter.name, word)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_gets_its_completion_script(shell: str) -> None:
    script = run(_HYBRIDLOG_COMPLETE=f"{shell}_source").out
    assert f"_HYBRIDLOG_COMPLETE={shell}_complete" in script


def test_a_reader_that_ends_early_is_no_error(store: Path) -> None:
    variables = environment(HYBRIDLOG_STORE=str(store), PYTHONUNBUFFERED="1")
    for arguments in (("info",), ("fetch", "-t", "*image_raw", "-F", "raw")):
        read, write = os.pipe()
        os.close(read)
        command = [*COMMAND, *arguments]
        ended = subprocess.run(
            command, stdout=write, stderr=subprocess.PIPE, env=variables, check=True
        )
        os.close(write)
        assert b"Traceback" not in ended.stderr
        assert b"BrokenPipe" not in ended.stderr


UNNEEDED = {
    *("PIL", "asyncio", "bson", "pandas", "pyarrow", "pydantic", "pymongo", "rosbags"),
    *("picows", "subprocess", "typer", "websockets"),
}


@pytest.mark.parametrize(
    ("wanted", "most"),
    # A slice parses definitions, to complete them.
    [(("--count",), 120), (("-F", "raw"), 120), (("-F", "mcap"), 137)],
)
def test_a_fetch_by_topic_and_time_imports_what_it_needs(
    wanted: tuple[str, ...], most: int, store: Path
) -> None:
    question = ("fetch", "--store", store, "-t", "scan", "--between", "+1s", "+2s")
    loaded = modules_of(*question, *wanted)
    assert not {name.split(".")[0] for name in loaded} & UNNEEDED
    ours = {name for name in loaded if name.split(".")[0] in {"hybridlog", "hybridlog_storage"}}
    unneeded = (
        "hybridlog.columns.tables",
        "hybridlog.frames",
        "hybridlog.index.indexing",
        "hybridlog.record.recorder",
    )
    assert not {name for name in ours if name.startswith(unneeded)}
    assert "numpy.ma" not in loaded
    # Each module costs about a millisecond.
    assert len(ours) < most, sorted(ours)


@pytest.mark.parametrize(
    "arguments",
    [
        ("tag", "robot"),
        ("fetch", "scan", "odom", "-n", "3"),
        ("align", "scan", "-r", "robot", "--step", "1s"),
        ("sql", "select topic, messages from topics"),
        ("tf", "-r", "robot"),
        ("tf", "odom", "base_link", "--tag", "place", "--step", "1s"),
        ("diff", "robot", "torn"),
        ("info", "--tables", "-t", "scan"),
        ("keep", "--max-age", "9y", "--dry-run"),
        pytest.param(("index", "address"), marks=pytest.mark.mongo),
        pytest.param(("index", "rebuild", "-r", "odd"), marks=pytest.mark.mongo),
    ],
    ids=" ".join,
)
def test_json_is_all_that_is_on_standard_output(arguments: tuple[str, ...], store: Path) -> None:
    done = run(*arguments, "--json", store=store, code=12 if arguments[0] == "diff" else 0)
    assert not misfit(done.json, schema_of(arguments))


def test_every_command_with_json_has_a_schema() -> None:
    have = {
        name
        for name, command in commands().items()
        if any(parameter.name == "as_json" for parameter in command.params)
    }
    assert have - {"top"} <= {name.split()[0] for name in schemas()}
    (group,) = [one for one in commands().values() if isinstance(one, click.Group)]
    for name, one in group.commands.items():
        if any(parameter.name == "as_json" for parameter in one.params):
            assert schema_of(["index", name])
