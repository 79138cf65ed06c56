"""`hybridlog trust`."""

from __future__ import annotations

from pathlib import Path

from hybridlog.cli import output


def run(store: Path | None, *, forget: bool) -> None:
    """Agree, or agree no more, to the MongoDB that a store names."""
    from hybridlog import consent
    from hybridlog.store import store_path
    from hybridlog_storage.settings import read_settings

    path = store_path(store)
    settings = read_settings(path)
    if forget:
        found = consent.forget(settings.store_id)
        output.say("forgotten" if found else "nothing was trusted")
    elif settings.mongo is None:
        output.say("the store names no MongoDB: there is nothing to trust")
    else:
        consent.remember(settings.store_id, settings.mongo)
        output.say(f"trusted {settings.mongo}")
