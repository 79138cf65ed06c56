"""Lets the stores of the tests have their index on a MongoDB that a URI names."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymongo import MongoClient

from hybridlog.index import consent
from hybridlog_storage.settings import EMBEDDED, StoreSettings

PREFIX = "hltest_"
"""Of the names of the databases."""


@contextmanager
def stores_at(uri: str) -> Iterator[None]:
    """Give each store that names no MongoDB a database of its own, and drop it at the end.

    Args:
        uri: Connection string, without a database.
    """
    used: set[str] = set()
    base, _, options = uri.partition("?")
    trusted_uri = consent.trusted_uri

    def chosen(settings: StoreSettings, store: Path, named: str | None = None) -> str:
        found = trusted_uri(settings, store, named)
        if found != EMBEDDED or named is not None:
            return found
        # As with the embedded MongoDB, a copy of a store has an index of its own.
        place = f"{settings.store_id} {os.path.realpath(store)}"
        name = PREFIX + hashlib.sha256(place.encode()).hexdigest()[:24]
        used.add(name)
        return f"{base.rstrip('/')}/{name}" + (f"?{options}" if options else "")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(consent, "trusted_uri", chosen)
        yield
    with MongoClient[dict[str, object]](uri) as client:
        for name in used:
            client.drop_database(name)
