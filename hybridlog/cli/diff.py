"""`hybridlog diff`."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path

import click

from hybridlog.cli import options, output
from hybridlog.cli.app import DIFFERENT
from hybridlog.cli.completion import complete_recording
from hybridlog.cli.open_store import opened_store


@click.command()
@click.argument(
    "a",
    metavar="A",
    shell_complete=complete_recording,
    help="A recording, as for --recording, or a glob for several together.",
)
@click.argument("b", metavar="B", shell_complete=complete_recording, help="The same.")
@click.option(
    "--tolerance",
    default="0",
    metavar="SHARE",
    help="Numbers are equal that differ by at most this, such as 5%.",
)
@click.option(
    "--contract",
    type=options.PATH,
    metavar="FILE",
    help="Also compare which rules in this file are broken.",
)
@options.store
@options.mongo
@options.as_json
@options.quiet
def diff_command(
    *,
    a: str,
    b: str,
    tolerance: str,
    contract: Path | None,
    store: Path | None,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Show what differs between two recordings.

    Topics, types, messages, rates, gaps, losses, and statistics of fields. Exit code 12 if
    anything does.
    """
    from hybridlog.contract.contract import Contract, parse_share

    rules = None if contract is None else Contract.read(contract)
    share = parse_share(tolerance)
    with opened_store(store, mongo, quiet=quiet or as_json) as opened:
        found = opened.diff(a, b, tolerance=share, contract=rules)
    if as_json:
        output.print_json([asdict(one) for one in found])
    elif found:
        columns: list[output.Column] = [(name, "left") for name in ("topic", "what", "a", "b")]
        output.print_table(columns, [[one.topic, one.what, one.a, one.b] for one in found])
    sys.stdout.flush()
    if not (quiet or as_json):
        output.note(output.counted(len(found), "difference") + "." if found else "No difference.")
    if found:
        raise click.exceptions.Exit(DIFFERENT)
