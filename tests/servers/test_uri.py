"""The tests of the store run against any MongoDB: a handful of them, to keep that so."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from pymongo import MongoClient

from tests.servers.mongods import Mongod, eventually

ROOT = Path(__file__).parents[2]
SOME = (
    "tests/test_field_indexes.py",
    "tests/storage/test_mongod.py",  # left out
)


def test_some_store_tests_by_uri(tmp_path: Path) -> None:
    with (
        Mongod(tmp_path / "mongod") as server,
        MongoClient[dict[str, Any]](f"mongodb://{server.address}/") as client,
    ):
        eventually(lambda: client.admin.command("ping"), "no server")
        done = subprocess.run(
            [
                *(sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider"),
                *("--mongo-uri", f"mongodb://{server.address}/", *SOME),
            ],
            check=False,
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout
        assert " deselected" in done.stdout
        counters = client.admin.command("serverStatus")["opcounters"]
        assert counters["insert"] > 1000, "the stores had their index elsewhere"
        assert set(client.list_database_names()) == {"admin", "config", "local"}
