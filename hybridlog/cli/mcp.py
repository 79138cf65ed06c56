"""`hybridlog mcp`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options
from hybridlog_storage.errors import MissingDependencyError


@click.command()
@options.store
def mcp_command(*, store: Path | None) -> None:
    """Answer the questions of an assistant, which starts this program.

    It speaks the Model Context Protocol over standard input and output. The store is only read;
    answers are bounded and say what they lack.
    """
    try:
        from hybridlog.view.tool_server import serve
    except ModuleNotFoundError as error:
        raise MissingDependencyError("mcp needs: pip install 'hybridlog[mcp]'") from error
    from hybridlog.store import open_store

    with open_store(store, read_only=True) as opened:
        serve(opened)
