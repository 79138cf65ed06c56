"""Entry point: runs the application, turns errors into messages and exit codes."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from pathlib import Path
from typing import NoReturn, TextIO

import click

from hybridlog.cli import signals
from hybridlog.cli.app import EXIT_CODES, INTERNAL, app, of_os_error
from hybridlog_storage.errors import HybridlogError

__all__ = ["EXIT_CODES", "main"]

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
        signals.undo_unfinished()
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
    from hybridlog.cli.output import printable

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
