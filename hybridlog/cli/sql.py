"""`hybridlog sql`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from hybridlog.cli import options
from hybridlog.cli.answers import Destination, answer_sql, table_options
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.output import notes, parse_size
from hybridlog.cli.signals import if_stopped


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
def sql_command(
    *,
    query: str | None,
    store: Path | None,
    memory: str | None,
    timeout: str | None,
    to: Destination,
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
                opened.query(topics).completeness().check()

        if is_prompt:
            from hybridlog.cli.sql_prompt import run_prompt

            run_prompt(connection, to, seconds, check)
            return
        with if_stopped("The query was stopped."), limited_memory(connection.memory):
            check(query or "")
            answer = connection.query(query or "", timeout=seconds)
            answer_sql(answer, to)
        sys.stdout.flush()
        if not quiet:
            notes(answer.told())
