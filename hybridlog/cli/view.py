"""`hybridlog view`."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import click

from hybridlog.cli import output
from hybridlog.cli.binder import command, option
from hybridlog.cli.options import AsJson, InStore, Served, one_recording
from hybridlog_storage.errors import MissingDependencyError, UsageError

_MAX_FOLDERS = 1000


@dataclass(frozen=True, kw_only=True)
class _Given(InStore, AsJson, Served):
    recording: str | None = one_recording(
        "Show this one first; without, the list of recordings.", "[RECORDING]"
    )
    opens: bool = option("Open the page in the browser.", name="--open")
    mcap: bool = option("Also serve selections as MCAP, to Foxglove and Lichtblick.")


@command(_Given)
def view_command(given: _Given) -> None:
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
    if given.store is None and not os.environ.get("HYBRIDLOG_STORE"):
        given = replace(given, store=_only_store_near())
    if given.origins and not given.mcap:
        raise UsageError("--allow-origin is about --mcap: add that.")
    with given.opened(is_lasting=True) as store:
        server = ViewServer(store, given.port or 0, viewers=given.mcap, origins=given.origins)
        url = server.url
        label = ""
        if given.recording is not None:
            (entry,) = store.select([given.recording])
            label = quote(entry.label, safe="")
            url += f"#recording={label}"
        if given.as_json:
            shown = {"url": url, "port": server.port}
            output.print_json(shown | ({"mcap": f"{server.url}mcap/"} if given.mcap else {}))
        else:
            click.echo(url)
            output.note("Open this address in a browser. Ctrl-C ends the server.")
            if given.mcap:
                _print_mcap(f"{server.url}mcap/", label)
        sys.stdout.flush()
        if given.opens:
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
