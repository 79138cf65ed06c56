"""`hybridlog sql`: a query, or a prompt."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from hybridlog.cli import output
from hybridlog.cli.answers import SCREEN, Tabular
from hybridlog.cli.binder import SECONDS, SIZE, argument, command, option
from hybridlog.cli.options import Ranged, Strict
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.stopping import at_safe_points

_HINT: Final = "Statements end with a semicolon; `show tables;` lists views, Ctrl-D or `quit` ends."


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
            _run_prompt(run)
        else:
            run(query or "")


def _run_prompt(run: Callable[[str], None]) -> None:
    """Read statements, which end with a semicolon, and run them, until Ctrl-D.

    Ctrl-C stops a query, or clears what was typed.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with suppress(ImportError):
        import_module("readline")  # `input` then edits lines and keeps them
    output.note(_HINT)
    text = ""
    while True:
        try:
            text += input("...> " if text else "sql> ")
            if text.strip().rstrip(";") in {"exit", "quit"}:
                return
            if text.strip() and not text.rstrip().endswith(";"):
                text += "\n"
                continue
            if text.strip():
                with at_safe_points():
                    run(text)
        except EOFError:
            output.note("")
            return
        except HybridlogError as error:
            output.notes(str(error).splitlines())
        except KeyboardInterrupt:
            output.note("stopped")
        text = ""
