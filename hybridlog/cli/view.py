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
from hybridlog_storage.errors import MissingDependencyError, UsageError

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
@click.option(
    "--mcap", is_flag=True, help="Also serve selections as MCAP, to Foxglove and Lichtblick."
)
@click.option(
    "--allow-origin",
    "origins",
    multiple=True,
    metavar="URL",
    help="With --mcap: let web pages of this origin read them, such as http://localhost:8080; "
    "those of Foxglove may. Repeatable.",
)
@options.mongo
@options.as_json
def view_command(
    *,
    recording: str | None,
    store: Path | None,
    port: int,
    opens: bool,
    mcap: bool,
    origins: tuple[str, ...],
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

    try:
        from hybridlog.view.server import ViewServer
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "The view needs starlette and uvicorn: pip install 'hybridlog[view]'"
        ) from error
    if store is None and not os.environ.get("HYBRIDLOG_STORE"):
        store = _only_store_near()
    if origins and not mcap:
        raise UsageError("--allow-origin is about --mcap: add that.")
    with opened_store(store, mongo, quiet=as_json, is_lasting=True) as opened:
        server = ViewServer(opened, port, viewers=mcap, origins=origins)
        url = server.url
        label = ""
        if recording is not None:
            (entry,) = opened.select([recording])
            label = quote(entry.label, safe="")
            url += f"#recording={label}"
        if as_json:
            shown = {"url": url, "port": server.port}
            output.print_json(shown | ({"mcap": f"{server.url}mcap/"} if mcap else {}))
        else:
            click.echo(url)
            output.note("Open this address in a browser. Ctrl-C ends the server.")
            if mcap:
                _print_mcap(f"{server.url}mcap/", label)
        sys.stdout.flush()
        if opens:
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
        server.run()


def _print_mcap(url: str, label: str) -> None:
    """Print where other viewers find selections.

    Args:
        url: Address of all selections.
        label: Label of a recording for the examples, as in a URL; empty without one.
    """
    from urllib.parse import quote

    file = f"{url}slice.mcap?recording={label or 'RECORDING'}"
    foxglove = f"https://app.foxglove.dev/?ds=remote-file&ds.url={quote(file, safe='')}"
    output.note(f"MCAP file: {file}")
    output.note(f"In Foxglove: {foxglove}")
    output.note(f"For a remote data loader: {url}manifest")


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
