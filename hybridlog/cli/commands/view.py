"""`hybridlog view`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.options import (
    AsJson,
    InStore,
    Served,
    command,
    one_recording,
    option,
)
from hybridlog.cli.signals import ended_by_signal
from hybridlog_storage.errors import extra

if TYPE_CHECKING:
    pass


class _View(InStore, AsJson, Served):
    recording: str | None = one_recording(
        "Show this one first; without, the list of recordings.", "[RECORDING]"
    )
    token: Path | None = option(
        "Take the token of the address from this file, which is made if it is not there: with "
        "--port, links stay right after a restart.",
        "FILE",
    )


@command(_View)
def view_command(given: _View) -> None:
    """Look at recordings in the browser.

    The page has a timeline, plots, pictures and scans, and takes questions. Only this computer
    can open it, at an address with a secret token. The store is only read. Ctrl-C ends it.
    """
    from urllib.parse import quote

    with extra("view", "The view needs starlette and uvicorn"):
        from hybridlog.view.guard import token_of
        from hybridlog.view.server import ViewServer
    with given.opened() as store:
        token = token_of(given.token) if given.token is not None else ""
        server = ViewServer(store, given.port or 0, token)
        url = server.url
        if given.recording is not None:
            entry = store.entry(given.recording)
            url += f"#recording={quote(entry.name, safe='')}"
        shown: dict[str, object] = {"url": url, "port": server.port}
        output.tell(shown, [url])
        if not given.as_json:
            output.note("Open this address in a browser. Ctrl-C ends the server.")
        sys.stdout.flush()
        with ended_by_signal(server.stop):
            server.run()
