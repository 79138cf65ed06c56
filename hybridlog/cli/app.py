"""The root command and its entry point: opens stores, turns errors into messages and exit codes."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn, TextIO

import click

from hybridlog import __version__
from hybridlog.cli import signals
from hybridlog.cli.output import Bar, counted, notes, printable
from hybridlog_storage.disk.files import undo_unfinished
from hybridlog_storage.errors import NO_SPACE, DiskFullError, HybridlogError, WithoutMongoError

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


@contextlib.contextmanager
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
        index, doing = store.shared.index, "so the files answer"
        doing = index.index_to_record("Recording").without if records else doing
        notes(told := _repairs(store, doing, verifies=verifies))
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


_COMPLETE = "_HYBRIDLOG_COMPLETE"
"""Environment variable in which a shell asks for completions, and for the script that does."""


def main() -> NoReturn:
    """Run the command line and exit with one of `EXIT_CODES`."""
    signals.install()
    sys.meta_path.insert(0, _WithoutPandas())
    # A shell may have closed them: `hybridlog ls >&-`.
    # What is written then fails, so that no answer is lost in silence.
    if sys.stdout is None:
        fd = os.open(os.devnull, os.O_RDONLY)
        sys.stdout = os.fdopen(fd, "w", encoding="utf-8")
    sys.stderr = sys.stderr or Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        # Characters that the terminal's encoding lacks are shown as escapes.
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        code = _run()
    except signals.Stopped as stopped:
        undo_unfinished()
        code = _complain(signals.INTERRUPTED, stopped.exit_code)
    _leave(_flushed(code))


def _run() -> int:
    code = 0
    try:
        if _COMPLETE in os.environ:
            from click.shell_completion import shell_complete

            return shell_complete(app, {}, "hybridlog", _COMPLETE, os.environ[_COMPLETE])
        with app.make_context("hybridlog", sys.argv[1:]) as context:
            app.invoke(context)
    except click.exceptions.Exit as leaving:
        code = leaving.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        code = error.exit_code
    except click.ClickException as error:
        lines = [error.format_message()]
        if isinstance(error, click.UsageError) and error.ctx is not None:
            lines.append(f"`{error.ctx.command_path} --help` shows what there is.")
        code = _complain("\n".join(lines), error.exit_code)
    except click.Abort:
        code = _complain("aborted.")
    except HybridlogError as error:
        code = _complain("\n".join([str(error), *getattr(error, "__notes__", ())]), error.exit_code)
    except BrokenPipeError:
        _discard(sys.stdout)
    except OSError as error:
        # The library maps most of these; the rest are such as a failing disk.
        where = "standard output, or a temporary file, cannot be written: "
        said = str(error) if error.filename else f"{where}{error.strerror or error}"
        code = _complain(said, of_os_error(error))
    except MemoryError:
        code = _complain("there is not enough memory for this: ask for less at a time.")
    except Exception:
        traceback.print_exc()
        said = "this is an error in hybridlog: please report it with the lines above."
        code = _complain(said, INTERNAL)
    return code


def _complain(text: str, code: int = HybridlogError.exit_code) -> int:
    """Print an error; gives the exit code."""
    lines = "\n".join(map(printable, f"hybridlog: {text}".split("\n")))
    try:
        print(lines, file=sys.stderr, flush=True)  # noqa: T201
    except OSError:
        _discard(sys.stderr)
    return code


def _flushed(code: int) -> int:
    """The exit code after the last bytes are written, which fails on a full disk."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of the output has ended, as `head` does: this is no error.
        _discard(sys.stdout)
    except OSError as error:
        _discard(sys.stdout)
        said = f"standard output cannot be written: {error.strerror}"
        failed = _complain(said, of_os_error(error))
        return code or failed
    return code


def _leave(code: int) -> NoReturn:
    """End the process without the interpreter's cleanup; everything is closed and flushed.

    The cleanup would wait half a second for the background threads of MongoDB connections.
    """
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    os._exit(code)


def _discard(stream: TextIO) -> None:
    """Discard what a stream still holds; the interpreter flushes it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class _WithoutPandas:
    """A finder of modules to which pandas is not installed.

    pyarrow imports pandas to see whether it is given one of its objects; no command has one. The
    import takes three tenths of a short command's time.
    """

    @staticmethod
    def find_spec(fullname: str, *_: object) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError("No command needs pandas.", name=fullname)
