"""`hybridlog sql`: a query, or a prompt with history and completion."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.cli import output
from hybridlog.cli.answers import SCREEN, Tabular
from hybridlog.cli.binder import SECONDS, SIZE, argument, command, option
from hybridlog.cli.options import Ranged, Strict
from hybridlog.cli.signals import if_stopped
from hybridlog_storage.disk.files import user_directory
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.sql.engine import SqlConnection

_ENDS: Final = frozenset({"exit", "quit", ".exit", ".quit", "\\q"})
_HELP: Final = frozenset({"help", ".help", "?", "\\?"})
_HINT: Final = "Statements end with a semicolon; `show tables;` lists views, Ctrl-D or `quit` ends."
_HISTORY: Final = "sql_history"
_MAX_HISTORY: Final = 1000


@dataclass(frozen=True, kw_only=True)
class _Given(Strict, Ranged, Tabular):
    query: str | None = argument(
        "A query; without, a prompt on a terminal, else standard input.", "[QUERY]"
    )
    memory: int | None = option(
        "Memory that the query may use, such as 4GiB; without, 1 GiB. hybridlog takes at "
        "most 512 MiB more for itself.",
        "SIZE",
        type=SIZE,
    )
    timeout: float | None = option("Stop a query that takes longer.", "DURATION", type=SECONDS)


@command(_Given)
def sql_command(given: _Given) -> None:
    """Ask in SQL: a view a topic, with nested fields as structs.

    Views are named as in `select view, short from topics`: base__scan, or scan where that is
    unambiguous. Tables: recordings, topics, losses, marks. All show the chosen recordings alone,
    and views and marks only the time of --between or --last. Needs no MongoDB.
    """
    from hybridlog.query.question import Question
    from hybridlog.sql.duck import limited_memory

    query = given.query
    is_prompt = query is None and sys.stdin.isatty()
    if query is None and not is_prompt:
        query = sys.stdin.read()
    with given.opened(snapshot=not is_prompt) as store:
        ids = None if given.choice.is_everything else given.recordings_in(store).ids
        connection = store.sql_engine.connect(given.memory, scope=Question((), ids, given.span))

        def run(text: str) -> None:
            with limited_memory(connection.memory):
                answer = connection.query(text, timeout=given.timeout)
                if answer.columns:
                    from pyarrow import Table

                    if given.to_form != SCREEN:
                        answer.check_names()
                    tables = (Table.from_batches([one]) for one in answer.to_batches())
                    completeness = answer.completeness if given.strict else None
                    given.answer(tables, completeness=completeness)
            sys.stdout.flush()
            output.remarks(answer.sentences())

        if is_prompt:
            _run_prompt(connection, run)
            return
        with if_stopped("The query was stopped."):
            run(query or "")


def _run_prompt(connection: SqlConnection, run: Callable[[str], None]) -> None:
    """Read statements, which end with a semicolon, and run them, until Ctrl-D.

    Ctrl-C stops a query, or clears what was typed.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    output.note(_HINT)
    lines: list[str] = []
    with _line_editing(connection, lines):
        while True:
            try:
                lines.append(input("...> " if lines else "sql> "))
                text = "\n".join(lines).strip()
                word = text.rstrip(";").lower()
                if word in _ENDS:
                    return
                if word in _HELP:
                    output.say(_HINT)
                elif text.endswith(";"):
                    try:
                        with at_safe_points():
                            run(text)
                    except KeyboardInterrupt:
                        output.note("The query was stopped.")
                elif text:
                    continue
            except EOFError:
                output.note("")
                return
            except HybridlogError as error:
                output.notes(str(error).splitlines())
            except KeyboardInterrupt:
                output.note("")
            lines.clear()


@contextmanager
def _line_editing(connection: SqlConnection, lines: Sequence[str]) -> Iterator[None]:
    """Line editing with history and completion, where Python has it."""
    try:
        import readline
    except ImportError:
        yield
        return
    from hybridlog.sql.names import DELIMITERS, candidates

    found: list[str] = []

    def complete(text: str, state: int) -> str | None:
        if state == 0:
            found.clear()
            with suppress(HybridlogError):
                line = "\n".join([*lines, readline.get_line_buffer()])
                found[:] = candidates(connection.names(), connection.schema, line, text)
        return found[state] if state < len(found) else None

    path: Path | None = None
    with suppress(HybridlogError, OSError):
        path = user_directory("XDG_STATE_HOME", ".local/state", "the history") / _HISTORY
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.exists():
            readline.read_history_file(path)
    readline.set_history_length(_MAX_HISTORY)
    readline.set_completer_delims(DELIMITERS)
    readline.set_completer(complete)
    readline.parse_and_bind("tab: complete")
    try:
        yield
    finally:
        if path is not None:
            with suppress(OSError):
                readline.write_history_file(path)
