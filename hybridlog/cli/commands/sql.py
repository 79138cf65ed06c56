"""`hybridlog sql`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.answers import SCREEN, Tabular
from hybridlog.cli.options import (
    SECONDS,
    SIZE,
    Ranged,
    Strict,
    argument,
    command,
    option,
)

if TYPE_CHECKING:
    pass


class _Sql(Strict, Ranged, Tabular):
    query: str | None = argument("A query; without, what comes on standard input.", "[QUERY]")
    memory: int | None = option(
        "Memory that the query may use, such as 4GiB; without, 1 GiB. hybridlog takes at "
        "most 512 MiB more for itself.",
        "SIZE",
        type=SIZE,
    )
    timeout: float | None = option("Stop a query that takes longer.", "DURATION", type=SECONDS)


@command(_Sql)
def sql_command(given: _Sql) -> None:
    """Ask in SQL: a view a topic, with nested fields as structs.

    Views are named as in `select view, short from topics`: base__scan, or scan where that is
    unambiguous. Tables: recordings, topics, losses, marks. All show the chosen recordings alone,
    and views and marks only the time of --between or --last. Needs no MongoDB.
    """
    from hybridlog.sql.engine import MEMORY, limited_memory

    text = sys.stdin.read() if given.query is None else given.query
    with given.opened(snapshot=True) as store:
        with limited_memory(given.memory or MEMORY):
            answer = store.sql(
                text,
                recordings=None if given.choice.is_everything else given.choice,
                between=given.span,
                memory=given.memory,
                timeout=given.timeout,
            )
            if answer.columns:
                from pyarrow import Table

                if given.to_form != SCREEN:
                    answer.check_names()
                tables = (Table.from_batches([one]) for one in answer.to_batches())
                completeness = answer.completeness if given.strict else None
                given.answer(tables, completeness, is_fixed=True)
        sys.stdout.flush()
        output.remarks(answer.sentences())
