"""`hybridlog sql`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from hybridlog.cli import options
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.output import parse_size
from hybridlog.cli.signals import if_stopped
from hybridlog.cli.sql_answer import print_remarks, write_answer
from hybridlog.cli.table_output import TableChoices, table_options


@click.command()
@click.argument(
    "query",
    metavar="[QUERY]",
    required=False,
    help="A query; without, a prompt on a terminal, else standard input.",
)
@options.store
@click.option(
    "--memory",
    metavar="SIZE",
    help="Memory that the query may use, such as 4GiB; without, 1 GiB. hybridlog takes at "
    "most 512 MiB more for itself.",
)
@click.option("--timeout", metavar="DURATION", help="Stop a query that takes longer.")
@table_options
def command(
    *,
    query: str | None,
    store: Path | None,
    memory: str | None,
    timeout: str | None,
    form: str | None,
    output: Path | None,
    force: bool,
    limit: int | None,
    strict: bool,
    mongo: str | None,
    quiet: bool,
) -> None:
    """Ask in SQL: a view a topic, with nested fields as structs.

    Views are named as in `select view, short from topics`: base__scan, or scan where that is
    unambiguous. Tables: recordings, topics, losses, marks. Needs no MongoDB.
    """
    from hybridlog.query.times import parse_duration
    from hybridlog.sql.memory_limit import limited_memory

    choices = TableChoices(
        form=form, output=output, force=force, limit=limit, quiet=quiet
    ).checked()
    most = None if memory is None else parse_size(memory)
    seconds = None if timeout is None else parse_duration(timeout) / 1e9
    is_prompt = query is None and sys.stdin.isatty()
    if query is None and not is_prompt:
        query = sys.stdin.read()
    opening = opened_store(store, mongo, quiet=quiet, is_lasting=is_prompt)
    with opening as opened:
        connection = opened.sql_engine.connect(most)

        def check(text: str) -> None:
            known = set(opened.topics())
            topics = [topic for topic in connection.topics(text) if topic in known]
            if strict and topics:
                opened.query(topics).check_complete()

        if is_prompt:
            from hybridlog.cli.sql_prompt import run_prompt

            run_prompt(connection, choices, seconds, check)
            return
        with if_stopped("The query was stopped."), limited_memory(connection.memory):
            check(query or "")
            answer = connection.query(query or "", timeout=seconds)
            write_answer(answer, choices)
        sys.stdout.flush()
        if not quiet:
            print_remarks(answer)
