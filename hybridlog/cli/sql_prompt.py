"""The prompt of `hybridlog sql`, with history and completion of views, columns and fields."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.cli.answers import Destination, answer_sql
from hybridlog.cli.output import note, notes, say
from hybridlog.index.consent import state_directory
from hybridlog.sql.completion import DELIMITERS, candidates
from hybridlog.sql.memory_limit import limited_memory
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.sql.engine import SqlConnection

_PROMPT: Final = "sql> "
_MORE: Final = "...> "
_ENDS: Final = frozenset({"exit", "quit", ".exit", ".quit", "\\q"})
_HISTORY: Final = "sql_history"
_MAX_HISTORY: Final = 1000


def run_prompt(
    connection: SqlConnection,
    to: Destination,
    timeout: float | None,
    check: Callable[[str], None],
) -> None:
    """Read statements, which end with a semicolon, and print their answers.

    Ctrl-C stops a query, or clears what was typed; Ctrl-D ends the prompt.

    Args:
        connection: Runs the statements.
        to: Format and place of the answers.
        timeout: Seconds that one may take; None for no limit.
        check: Refuses a statement whose answer would not be complete.
    """
    say("Statements end with a semicolon; `show tables;` lists views, Ctrl-D ends.")
    completer = Completer(connection)
    with _keys(), _line_editing(completer):
        while (text := _statement(completer)) is not None:
            if not text.strip():
                continue
            try:
                with at_safe_points(), limited_memory(connection.memory):
                    check(text)
                    answer = connection.query(text, timeout=timeout)
                    answer_sql(answer, to)
                    sys.stdout.flush()
                    notes(answer.told())
            except HybridlogError as error:
                for line in str(error).splitlines():
                    note(line)
            except KeyboardInterrupt:
                with suppress(KeyboardInterrupt):  # pressed again
                    note("The query was stopped.")


def _statement(completer: Completer) -> str | None:
    """The next statement; None at the end."""
    lines: list[str] = []
    while True:
        completer.before = "\n".join(lines)
        try:
            line = input(_MORE if lines else _PROMPT)
        except KeyboardInterrupt:
            say()
            lines.clear()
            continue
        except EOFError:
            say()
            return None
        if not lines and line.strip().rstrip(";").lower() in _ENDS:
            return None
        lines.append(line)
        if line.rstrip().endswith(";") or not any(map(str.strip, lines)):
            return "\n".join(lines)


class Completer:
    """Candidates for the word before the cursor.

    Args:
        connection: Knows views and columns.

    Attributes:
        before: Lines of the statement before the current one.
    """

    def __init__(self, connection: SqlConnection) -> None:
        self._connection = connection
        self._found: list[str] = []
        self.before = ""

    def __call__(self, text: str, state: int) -> str | None:
        """A candidate, as `readline` asks for it."""
        if state == 0:
            import readline

            self._found = []
            with suppress(HybridlogError):
                line = f"{self.before}\n{readline.get_line_buffer()}"
                self._found = candidates(self._connection, line, text)
        return self._found[state] if state < len(self._found) else None


@contextmanager
def _keys() -> Iterator[None]:
    """Ctrl-C stops a query, not the command."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _line_editing(completer: Completer) -> Iterator[None]:
    """Line editing with history, where Python has it."""
    try:
        import readline
    except ImportError:
        yield
        return
    path: Path | None = None
    with suppress(HybridlogError, OSError):
        path = state_directory() / _HISTORY
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.exists():
            readline.read_history_file(path)
    readline.set_history_length(_MAX_HISTORY)
    readline.set_completer_delims(DELIMITERS)
    readline.set_completer(completer)
    readline.parse_and_bind("tab: complete")
    try:
        yield
    finally:
        if path is not None:
            with suppress(OSError):
                readline.write_history_file(path)
