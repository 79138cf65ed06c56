"""Entry point: runs the application, turns errors into messages and exit codes."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from typing import NoReturn, TextIO

from hybridlog.cli import stopping
from hybridlog.cli.exit_codes import EXIT_CODES, INTERNAL, of_os_error
from hybridlog.cli.spared import spare
from hybridlog_storage.errors import HybridlogError

__all__ = ["EXIT_CODES", "main"]


def main() -> NoReturn:
    """Run the command line and exit with one of `EXIT_CODES`."""
    stopping.install()
    spare()
    for stream in (sys.stdout, sys.stderr):
        # A name that the terminal's encoding lacks is shown as an escape.
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        code = _run()
    except stopping.Stopped as stopped:
        _remove_unfinished()
        _complain(f"interrupted. {stopped.consequence}".rstrip())
        code = stopped.exit_code
    _leave(_flushed(code))


def _remove_unfinished() -> None:
    """Remove the files that a command was writing when it was stopped."""
    unfinished = sys.modules.get("hybridlog.export.unfinished")
    if unfinished is not None:
        unfinished.remove_unfinished()


def _run() -> int:
    from hybridlog.cli.app import app

    try:
        app(prog_name="hybridlog")
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    except HybridlogError as error:
        _complain(str(error))
        return error.exit_code
    except BrokenPipeError:
        _let_go(sys.stdout)
    except OSError as error:
        # What the library maps carries a cure; this is the rest, such as a failing disk.
        _complain(str(error))
        return of_os_error(error)
    except MemoryError:
        _complain("there is not enough memory for this. Ask for less at a time.")
        return HybridlogError.exit_code
    except Exception:
        traceback.print_exc()
        _complain("this is a mistake in hybridlog; please report it with the lines above.")
        return INTERNAL
    return 0


def _complain(text: str) -> None:
    from hybridlog.cli.output import printable

    lines = "\n".join(printable(line) for line in text.split("\n"))
    try:
        print(f"hybridlog: {lines}", file=sys.stderr, flush=True)  # noqa: T201
    except OSError:
        _let_go(sys.stderr)


def _flushed(code: int) -> int:
    """The exit code, after the last bytes are out: that is where a full disk shows."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output has gone, as `head` does: nothing is wrong.
        _let_go(sys.stdout)
    except OSError as error:
        _let_go(sys.stdout)
        _complain(f"standard output cannot be written: {error.strerror}")
        return code or of_os_error(error)
    return code


def _leave(code: int) -> NoReturn:
    """End the process at once, when everything is closed and flushed.

    At an ordinary end, the connections' background threads are waited for: half a second
    of sleep for each command that has used MongoDB.
    """
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    os._exit(code)


def _let_go(stream: TextIO) -> None:
    """What a stream still holds goes nowhere; the interpreter flushes it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
