"""All backends by name, in the order of the tables. Drivers are imported when one is used."""

from __future__ import annotations

from benchmarks.backends.base import Backend
from benchmarks.backends.files import BagFile, McapFile, Nothing
from benchmarks.backends.hybridlog_store import Hybridlog, HybridlogUncompressed
from benchmarks.backends.mongo import Mongo, MongoIndexed
from benchmarks.backends.postgres import Postgres, PostgresIndexed
from benchmarks.backends.sql import Sqlite, SqliteIndexed

BACKENDS: dict[str, type[Backend]] = {
    backend.name: backend
    for backend in (
        Hybridlog,
        HybridlogUncompressed,
        Mongo,
        MongoIndexed,
        Postgres,
        PostgresIndexed,
        Sqlite,
        SqliteIndexed,
        BagFile,
        McapFile,
        Nothing,
    )
}
