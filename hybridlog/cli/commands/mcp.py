"""`hybridlog mcp`."""

from __future__ import annotations

from hybridlog.cli.binder import command
from hybridlog.cli.options import Place
from hybridlog_storage.errors import MissingDependencyError


@command(Place)
def mcp_command(given: Place) -> None:
    """Answer the questions of an assistant, which starts it.

    It speaks the Model Context Protocol over standard input and output. The store is only read;
    answers are bounded and say what they lack.
    """
    try:
        from hybridlog.view.tool_server import serve
    except ModuleNotFoundError as error:
        raise MissingDependencyError("mcp needs: pip install 'hybridlog[mcp]'") from error
    from hybridlog.store import open_store

    with open_store(given.store, read_only=True) as opened:
        serve(opened)
