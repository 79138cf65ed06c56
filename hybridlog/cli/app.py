"""Opens the store of a command, and turns errors into exit codes; the root command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from hybridlog import __version__
from hybridlog.cli.output import Bar, counted, notes
from hybridlog_storage.errors import (
    NO_SPACE,
    DiskFullError,
    HybridlogError,
    WithoutMongoError,
)

if TYPE_CHECKING:
    from hybridlog.store import Store


DIFFERENT: Final = 12
INTERNAL: Final = 70

EXIT_CODES: Final = {
    0: "done",
    1: "verify found something, keep lacks room, or an error that has no code of its own",
    2: "wrong usage: an option, a topic, a time or a predicate",
    3: "a log that cannot be read, or a robot that was never reached",
    4: "a damaged log, or lost messages: the rest is stored",
    5: "the store is missing, read-only, damaged, or of a newer format",
    6: "MongoDB does not answer, or died",
    7: "no space left on the disk, or too few file handles or too little memory",
    8: "this content is in the store already",
    9: "an optional package is missing",
    10: "no fields: the message definition does not give them",
    11: "--strict: messages of the asked range are lost, or not written yet",
    DIFFERENT: "check --contract: a rule is broken; diff: something differs",
    INTERNAL: "an error in hybridlog itself",
    130: "interrupted (Ctrl-C): undone, or finished by a later command",
    143: "ended (SIGTERM): undone, or finished by a later command",
}


def of_os_error(error: OSError) -> int:
    """The code for an operating system error that the library has not mapped."""
    return DiskFullError.exit_code if error.errno in NO_SPACE else HybridlogError.exit_code


GROUPS: Final = {
    "Record": ["record", "mark", "top"],
    "Look": ["ls", "info", "view", "open", "plot"],
    "Ask": ["fetch", "intervals", "stats", "align", "sql", "tf", "check", "diff"],
    "Export": ["export", "copy", "mcp"],
    "Maintain": ["tag", "edit", "keep", "index", "verify", "rm", "demo"],
}
"""Names of the commands by group, in the order of the help text."""

COMMANDS: Final = [name for group in GROUPS.values() for name in group]
"""Names of all commands, each of which lies in the module of its name."""


class _LazyGroup(click.Group):
    """A group whose command `name` is the function `name_command` in the module of its name."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return COMMANDS

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f"hybridlog.cli.commands.{cmd_name}")
        command: click.Command = getattr(module, f"{cmd_name}_command")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = formatter.width - max(map(len, COMMANDS)) - 6
        for title, names in GROUPS.items():
            found = [(name, self.get_command(ctx, name)) for name in names]
            with formatter.section(title):
                formatter.write_dl(
                    [(name, one.get_short_help_str(width)) for name, one in found if one],
                    col_max=12,
                )

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_epilog(ctx, formatter)
        with formatter.section("Exit codes"):
            formatter.write_dl([(f"{code:>3}", meaning) for code, meaning in EXIT_CODES.items()])


@click.group(
    name="hybridlog",
    cls=_LazyGroup,
    # Names only: an unknown command is compared with them, and `get_command` loads one.
    commands=dict.fromkeys(COMMANDS, click.Command(None)),
    context_settings={"show_default": True, "help_option_names": ["-h", "--help"]},
    epilog="The store is --store, else HYBRIDLOG_STORE, else ./hybridlog-store.",
)
@click.version_option(__version__, message="hybridlog %(version)s", help="Print the version.")
def app() -> None:
    """Record what a robot says, and ask it.

    Payloads go into MCAP files, fields into MongoDB, one reader joins the two.
    """
    # No command multiplies matrices, and starting a thread a processor for that takes time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@contextmanager
def opened_store(
    path: Path | None,
    mongo: str | None,
    *,
    quiet: bool = False,
    snapshot: bool = False,
    records: bool = False,
    verifies: bool = False,
    **how: Any,
) -> Iterator[Store]:
    """The open store, in a block around which its repairs are reported.

    With `snapshot`, all that the command asks is of one moment. With `records` it records, also
    while MongoDB is unavailable; with `verifies` it says itself what `hybridlog verify --repair`
    cures.
    """
    from hybridlog_storage.cache import import_numpy_late

    import_numpy_late()
    from hybridlog.store import open_store

    with Bar("indexing", quiet=quiet) as bar:
        store = open_store(path, mongo=mongo, progress=bar.part, **how)
    with store:
        doing = "so the files answer"
        if records:
            doing = store.shared.index.index_to_record("Recording").without
        told = _repairs(store, doing, verifies=verifies)
        notes(told)
        try:
            yield store.snapshot() if snapshot else store
        finally:
            later = _repairs(store, "" if records else doing, verifies=verifies)
            notes(one for one in later if one not in told)


def _repairs(store: Store, doing: str, *, verifies: bool) -> list[str]:
    """Sentences about repairs since the last call, what cannot be mended, and what is missing."""
    repairs, found = store.shared.repairs, list[str]()
    for recording, segments in repairs.recovered.items():
        kept = counted(sum(one.messages for one in segments), "message")
        found.append(f"Recording {recording} was cut short by a crash: {kept} of it are recovered.")
        found += (f"  damaged: {damage}" for one in segments for damage in one.damage)
    found += (
        f"Recording {recording} cannot be read: {reason}"
        for recording, reason in repairs.unreadable.items()
        if not (verifies and "`hybridlog verify --repair`" in reason)
    )
    directory = store.directory
    if not (directory.is_writable or directory.is_remote or directory.read_only):
        found.append(f"The store {store.directory.path} is read-only; its segments answer.")
    reason = store.shared.index.unavailable
    is_wanted = reason is not None and not isinstance(reason, WithoutMongoError)
    if doing and is_wanted and store.directory.is_writable:
        found.append(f"MongoDB is unavailable, {doing}: {reason}")
    return found
