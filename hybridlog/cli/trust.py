"""`hybridlog trust`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options, output


@click.command()
@options.store
@click.option("--forget", is_flag=True, help="Do not trust this store's server any more.")
def trust_command(*, store: Path | None, forget: bool) -> None:
    """Trust the MongoDB server that another user's store names.

    Until then, commands do not connect to it: a user's own stores only are trusted. The store
    does not contain the password: see HYBRIDLOG_MONGO_PASSWORD.
    """
    from hybridlog.index import consent
    from hybridlog.store import store_path
    from hybridlog_storage.settings import is_uri, read_settings

    settings = read_settings(store_path(store))
    if forget:
        found = consent.forget(settings.store_id)
        output.say("forgotten" if found else "nothing was trusted")
    elif not is_uri(settings.mongo):
        output.say("the store names no MongoDB: there is nothing to trust")
    else:
        consent.remember(settings.store_id, settings.mongo)
        output.say(f"trusted {settings.mongo}")
