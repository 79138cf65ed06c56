"""All backends by name, in the order of the tables. Drivers are imported when one is used."""

from __future__ import annotations

from benchmarks.backends.bagfile import BagFile
from benchmarks.backends.base import Backend
from benchmarks.backends.hybridlog_store import Hybridlog, HybridlogRecorder
from benchmarks.backends.mcap_file import McapFile
from benchmarks.backends.mongo_json import MongoJson, MongoJsonBatched, MongoJsonIndexed
from benchmarks.backends.nothing import Nothing
from benchmarks.backends.postgres import PostgresAutocommit, PostgresTuned, PostgresTunedIndexed
from benchmarks.backends.sqlite import SqliteJson1, SqliteUdf

BACKENDS: dict[str, type[Backend]] = {
    backend.name: backend
    for backend in (
        Nothing,
        McapFile,
        BagFile,
        MongoJson,
        MongoJsonIndexed,
        MongoJsonBatched,
        PostgresAutocommit,
        PostgresTuned,
        PostgresTunedIndexed,
        SqliteUdf,
        SqliteJson1,
        Hybridlog,
        HybridlogRecorder,
    )
}
