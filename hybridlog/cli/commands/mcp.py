"""`hybridlog mcp`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog.cli.options import (
    Place,
    command,
)
from hybridlog_storage.errors import extra

if TYPE_CHECKING:
    pass


@command(Place)
def mcp_command(given: Place) -> None:
    """Answer the questions of an assistant, which starts it.

    It speaks the Model Context Protocol over standard input and output. The store is only read;
    answers are bounded and say what they lack.
    """
    with extra("mcp", "mcp needs the package of this protocol"):
        from hybridlog.view.tool_server import serve
    from hybridlog.store import open_store

    with open_store(given.store, read_only=True) as opened:
        serve(opened)
