"""`hybridlog sql`."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from hybridlog.cli.answers import Tabular, answer_sql
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.options import InStore, Quiet, Strict
from hybridlog.cli.output import notes, parse_size
from hybridlog.cli.signals import if_stopped


@dataclass(frozen=True, kw_only=True)
class _Given(InStore, Tabular, Strict, Quiet):
    query: str | None = argument(
        "A query; without, a prompt on a terminal, else standard input.", "[QUERY]"
    )
    memory: str | None = option(
        "Memory that the query may use, such as 4GiB; without, 1 GiB. hybridlog takes at "
        "most 512 MiB more for itself.",
        "SIZE",
    )
    timeout: str | None = option("Stop a query that takes longer.", "DURATION")


@command(_Given)
def sql_command(given: _Given) -> None:
    """Ask in SQL: a view a topic, with nested fields as structs.

    Views are named as in `select view, short from topics`: base__scan, or scan where that is
    unambiguous. Tables: recordings, topics, losses, marks. Needs no MongoDB.
    """
    from hybridlog.query.times import parse_duration
    from hybridlog.sql.duck import limited_memory

    to, query = given.to, given.query
    most = None if given.memory is None else parse_size(given.memory)
    seconds = None if given.timeout is None else parse_duration(given.timeout) / 1e9
    is_prompt = query is None and sys.stdin.isatty()
    if query is None and not is_prompt:
        query = sys.stdin.read()
    with given.opened(is_lasting=is_prompt) as store:
        connection = store.sql_engine.connect(most)

        def check(text: str) -> None:
            known = set(store.topics())
            topics = [topic for topic in connection.topics(text) if topic in known]
            if given.strict and topics:
                store.query(topics).completeness().check()

        if is_prompt:
            from hybridlog.cli.sql_prompt import run_prompt

            run_prompt(connection, to, seconds, check)
            return
        with if_stopped("The query was stopped."), limited_memory(connection.memory):
            check(query or "")
            answer = connection.query(query or "", timeout=seconds)
            answer_sql(answer, to)
        sys.stdout.flush()
        if not given.quiet:
            notes(answer.sentences())
