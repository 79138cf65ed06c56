"""`hybridlog sql`, and its prompt with history and completion of views, columns and fields."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn, Self

from hybridlog.cli.answers import Tabular, answer_sql
from hybridlog.cli.binder import SECONDS, SIZE, argument, command, option
from hybridlog.cli.options import Ranged, Strict
from hybridlog.cli.output import note, notes, say
from hybridlog.cli.signals import if_stopped
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.stopping import at_safe_points, postpone

if TYPE_CHECKING:
    from hybridlog.sql.engine import SqlConnection


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

    to, query = given.to, given.query
    is_prompt = query is None and sys.stdin.isatty()
    if query is None and not is_prompt:
        query = sys.stdin.read()
    with given.opened(is_lasting=is_prompt, snapshot=not is_prompt) as store:
        ids = None if given.choice.is_everything else given.recordings_in(store).ids
        connection = store.sql_engine.connect(given.memory, scope=Question((), ids, given.span))

        def run(text: str) -> None:
            with limited_memory(connection.memory):
                if given.strict:
                    connection.check(text)
                answer = connection.query(text, timeout=given.timeout)
                answer_sql(answer, to)
            sys.stdout.flush()
            if not given.quiet:
                notes(answer.sentences())

        if is_prompt:
            run_prompt(connection, run)
            return
        with if_stopped("The query was stopped."):
            run(query or "")


_PROMPT: Final = "sql> "
_MORE: Final = "...> "
_ENDS: Final = frozenset({"exit", "quit", ".exit", ".quit", "\\q"})
_HELP: Final = frozenset({"help", ".help", "?", "\\?"})
_HINT: Final = "Statements end with a semicolon; `show tables;` lists views, Ctrl-D or `quit` ends."
_HISTORY: Final = "sql_history"
_MAX_HISTORY: Final = 1000


def run_prompt(connection: SqlConnection, run: Callable[[str], None]) -> None:
    """Read statements, which end with a semicolon, and print their answers.

    Ctrl-C stops a query, or clears what was typed; Ctrl-D ends the prompt.
    """
    say(_HINT)
    completer = Completer(connection)
    with _Keys() as keys, _line_editing(completer):
        while (text := _statement(completer, keys)) is not None:
            if not text.strip():
                continue
            try:
                with keys.heard(), at_safe_points():
                    run(text)
            except HybridlogError as error:
                for line in str(error).splitlines():
                    note(line)
            except KeyboardInterrupt:
                note("The query was stopped.")


def _statement(completer: Completer, keys: _Keys) -> str | None:
    """The next statement; None at the end."""
    lines: list[str] = []
    while True:
        completer.before = "\n".join(lines)
        try:
            with keys.heard():
                line = input(_MORE if lines else _PROMPT)
        except (KeyboardInterrupt, SystemError):  # CPython's, for one that follows at once
            say()
            lines.clear()
            continue
        except EOFError:
            say()
            return None
        word = line.strip().rstrip(";").lower()
        if not lines and word in _ENDS:
            return None
        if not lines and word in _HELP:
            say(_HINT)
            continue
        lines.append(line)
        if line.rstrip().endswith(";") or not any(map(str.strip, lines)):
            return "\n".join(lines)


class Completer:
    """Candidates for the word before the cursor.

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

            from hybridlog.sql.completion import candidates

            self._found = []
            with suppress(HybridlogError):
                line = f"{self.before}\n{readline.get_line_buffer()}"
                self._found = candidates(self._connection, line, text)
        return self._found[state] if state < len(self._found) else None


class _Keys:
    """Ctrl-C stops a query or clears what was typed, and never ends the command.

    It is heard in a block, and once: pressed again, or between two blocks, it does nothing.
    """

    def __init__(self) -> None:
        self._is_heard = False
        self._before: Any = None

    def __enter__(self) -> Self:
        """Listen."""
        self._before = signal.signal(signal.SIGINT, self._pressed)
        return self

    def __exit__(self, *_: object) -> None:
        """Listen no longer."""
        signal.signal(signal.SIGINT, self._before)

    def _pressed(self, *_: object) -> None:
        if self._is_heard:
            self._is_heard = False
            if not postpone(_interrupt):
                raise KeyboardInterrupt

    @contextmanager
    def heard(self) -> Iterator[None]:
        """A block in which Ctrl-C raises `KeyboardInterrupt`."""
        try:
            self._is_heard = True
            yield
        finally:
            self._is_heard = False


def _interrupt() -> NoReturn:
    raise KeyboardInterrupt


@contextmanager
def _line_editing(completer: Completer) -> Iterator[None]:
    """Line editing with history, where Python has it."""
    try:
        import readline
    except ImportError:
        yield
        return
    from hybridlog.index.consent import state_directory
    from hybridlog.sql.completion import DELIMITERS

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
