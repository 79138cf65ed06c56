"""The MongoDB of the tests: none, but for tests that ask for one.

A test that is marked `mongo` has a database of its own: HYBRIDLOG_MONGO_URI names it, for its store
and for the commands that it starts. The server is the one of `--mongo-uri`, or one of this process.
With `mongo("embedded")` the variable is not set: each store has the MongoDB of its settings, or the
one that comes with hybridlog.
"""

from __future__ import annotations

import os
import secrets
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from pymongo import MongoClient

from hybridlog_storage.mongo.mongod import EmbeddedMongod
from hybridlog_storage.settings import EMBEDDED, NONE

VARIABLE = "HYBRIDLOG_MONGO_URI"
PREFIX = "hltest_"
"""Of the names of the databases."""


def is_embedded(item: pytest.Item) -> bool:
    """True if a test is about the MongoDB that comes with hybridlog."""
    return any(mark.args == (EMBEDDED,) for mark in item.iter_markers("mongo"))


class Databases:
    """Databases on one server, which is started for the first of them.

    Args:
        uri: Connection string of a server that runs, without a database.
    """

    def __init__(self, uri: str | None) -> None:
        self._uri = uri
        self._used: list[str] = []
        self._server = ExitStack()

    def choose(self, item: pytest.Item) -> None:
        """Set the variable for a test."""
        if is_embedded(item):
            os.environ.pop(VARIABLE, None)
        else:
            is_asked = item.get_closest_marker("mongo") is not None
            os.environ[VARIABLE] = self.new() if is_asked else NONE

    def new(self) -> str:
        """The URI of a new database."""
        if self._uri is None:
            # Its keeper ends it when the directory is gone.
            place = TemporaryDirectory(prefix="hl-mongod-", ignore_cleanup_errors=True)
            directory = Path(self._server.enter_context(place), "mongod")
            self._uri = self._server.enter_context(EmbeddedMongod(directory, linger_s=0)).start()
        name = f"{PREFIX}{secrets.token_hex(8)}"
        self._used.append(name)
        base, _, options = self._uri.partition("?")
        return f"{base.rstrip('/')}/{name}" + (f"?{options}" if options else "")

    def close(self) -> None:
        """Drop them all."""
        if self._uri is not None:
            with MongoClient[dict[str, object]](self._uri) as client:
                for name in self._used:
                    client.drop_database(name)
        self._server.close()
