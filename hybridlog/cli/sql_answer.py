"""Prints or writes the answer of a query in SQL, and what it may lack."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from hybridlog.cli.output import notes
from hybridlog.cli.table_output import TableChoices, write_tables

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.sql.engine import SqlAnswer


def write_answer(answer: SqlAnswer, choices: TableChoices) -> None:
    """Print or write an answer; nothing for statements that return nothing."""
    if answer.columns:
        write_tables(_tables(answer), lambda: None, choices)


def _tables(answer: SqlAnswer) -> Iterator[pa.Table]:
    import pyarrow as pa

    for batch in answer.to_batches():
        yield pa.Table.from_batches([batch])


def print_remarks(answer: SqlAnswer) -> None:
    """Print what an answer may lack."""
    notes(answer.told())
