"""The prompt of `hybridlog sql`, with history and completion of views, columns and fields."""

from __future__ import annotations

import signal
import sys
from code import InteractiveConsole
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.cli.output import note, notes, say
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.sql.engine import SqlConnection

_ENDS: Final = frozenset({"exit", "quit", ".exit", ".quit", "\\q"})
_HELP: Final = frozenset({"help", ".help", "?", "\\?"})
_HINT: Final = "Statements end with a semicolon; `show tables;` lists views, Ctrl-D or `quit` ends."
_HISTORY: Final = "sql_history"
_MAX_HISTORY: Final = 1000


class _Prompt(InteractiveConsole):
    """Reads statements, which end with a semicolon, and completes their words.

    Ctrl-C stops a query, or clears what was typed; Ctrl-D ends the prompt.
    """

    def __init__(self, connection: SqlConnection, run: Callable[[str], None]) -> None:
        super().__init__()
        self._connection = connection
        self._run = run
        self._found: list[str] = []

    def raw_input(self, prompt: str = "") -> str:
        line = input(prompt)
        if not self.buffer and line.strip().rstrip(";").lower() in _ENDS:
            raise EOFError
        return line

    def runsource(self, source: str, *_: object) -> bool:
        """Answer a statement; True if more of it is to come."""
        text = source.strip()
        if text.rstrip(";").lower() in _HELP:
            say(_HINT)
        elif text and not text.endswith(";"):
            return True
        elif text:
            try:
                with at_safe_points():
                    self._run(source)
            except HybridlogError as error:
                notes(str(error).splitlines())
            except KeyboardInterrupt:
                note("The query was stopped.")
        return False

    def complete(self, text: str, state: int) -> str | None:
        """A candidate for the word before the cursor, as `readline` asks for it."""
        if state == 0:
            import readline

            from hybridlog.sql.names import candidates

            self._found = []
            with suppress(HybridlogError):
                line = "\n".join([*self.buffer, readline.get_line_buffer()])
                self._found = candidates(
                    self._connection.names(), self._connection.schema, line, text
                )
        return self._found[state] if state < len(self._found) else None


def run_prompt(connection: SqlConnection, run: Callable[[str], None]) -> None:
    """Read statements and run them, until Ctrl-D."""
    prompt = _Prompt(connection, run)
    sys.ps1, sys.ps2 = "sql> ", "...> "
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with _line_editing(prompt):
        hint = _HINT
        while True:
            try:
                prompt.interact(hint, "")
                return
            except KeyboardInterrupt:  # while it handled another one
                prompt.resetbuffer()
                hint = ""


@contextmanager
def _line_editing(prompt: _Prompt) -> Iterator[None]:
    """Line editing with history, where Python has it."""
    try:
        import readline
    except ImportError:
        yield
        return
    from hybridlog.index.consent import state_directory
    from hybridlog.sql.names import DELIMITERS

    path: Path | None = None
    with suppress(HybridlogError, OSError):
        path = state_directory() / _HISTORY
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.exists():
            readline.read_history_file(path)
    readline.set_history_length(_MAX_HISTORY)
    readline.set_completer_delims(DELIMITERS)
    readline.set_completer(prompt.complete)
    readline.parse_and_bind("tab: complete")
    try:
        yield
    finally:
        if path is not None:
            with suppress(OSError):
                readline.write_history_file(path)
