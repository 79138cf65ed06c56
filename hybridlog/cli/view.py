"""`hybridlog view`."""

from __future__ import annotations

import os
import sys
from itertools import chain, islice
from pathlib import Path

import click

from hybridlog.cli import options, output
from hybridlog.cli.completion import complete_recording
from hybridlog.cli.open_store import opened_store

_MAX_FOLDERS = 1000


@click.command()
@click.argument(
    "recording",
    required=False,
    metavar="[RECORDING]",
    shell_complete=complete_recording,
    help="Show this one first; without, the list of recordings.",
)
@options.store
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default="any free one",
    help="Port of 127.0.0.1 to serve on.",
)
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
@options.mongo
@options.as_json
def command(
    *,
    recording: str | None,
    store: Path | None,
    port: int,
    opens: bool,
    mongo: str | None,
    as_json: bool,
) -> None:
    """Look at recordings in the browser.

    The page has a timeline, plots, pictures and scans, and takes questions. Only this computer
    can open it, at an address with a secret token. The store is only read. Ctrl-C ends it.
    """
    import threading
    import webbrowser
    from urllib.parse import quote

    from hybridlog.view.server import ViewServer

    if store is None and not os.environ.get("HYBRIDLOG_STORE"):
        store = _only_store_near()
    with opened_store(store, mongo, quiet=as_json) as opened:
        server = ViewServer(opened, port)
        url = server.url
        if recording is not None:
            (entry,) = opened.select([recording])
            url += f"#recording={quote(entry.label, safe='')}"
        if as_json:
            output.print_json({"url": url, "port": server.port})
        else:
            click.echo(url)
            output.note("Open this address in a browser. Ctrl-C ends the server.")
        sys.stdout.flush()
        if opens:
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
        server.run()


def _only_store_near() -> Path | None:
    """The only store in the folders here and in theirs, where no other one is meant."""
    from hybridlog.store import store_path
    from hybridlog_storage.settings import NAME

    if store_path().exists():
        return None
    folders = chain.from_iterable(
        islice(Path().glob(depth), _MAX_FOLDERS) for depth in ("*", "*/*")
    )
    found = [folder for folder in folders if (folder / NAME).is_file()]
    if len(found) != 1:
        return None
    output.note(f"Showing {found[0]}, the only store below this folder.")
    return found[0]
