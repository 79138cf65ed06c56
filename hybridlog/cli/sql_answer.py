"""Prints or writes the answer of a query in SQL, and what it may lack."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from hybridlog.cli.coverage import gaps
from hybridlog.cli.output import counted, note, unfit
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
    remarks = answer.remarks
    for topic, reason in remarks.undefined.items():
        note(f"{topic} has no columns of fields: {reason}.")
    for topic, count in remarks.unreadable.items():
        note(f"{topic}: {unfit(count)}; the fields are null, and error says why.")
    for topic, count in remarks.reduced.items():
        have = "has" if count == 1 else "have"
        note(f"{topic}: {counted(count, 'message')} {have} no fields: reduced under pressure.")
    for line in gaps(list(remarks.recordings.values()), remarks.topics, None):
        note(line)
