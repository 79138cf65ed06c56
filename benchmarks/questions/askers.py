"""Which class asks which backend. To ask one more, write its class and name it here."""

from __future__ import annotations

from typing import Final

SAME: Final = {"hybridlog_recorder": "hybridlog", "mongo_json_batched": "mongo_json"}
"""Backends that keep just what another one keeps, which is asked in their place."""

# By name of the backend: rows of the tables and the classes (`module:class`) that fill
# them. hybridlog has four: the paper's own queries and its own, and both once more with
# the paper's indexes, which the third makes and the fourth finds.
ASKERS: Final[dict[str, dict[str, str]]] = {
    "mcap": {"mcap": "benchmarks.questions.files:McapAsker"},
    "bagfile": {"bagfile": "benchmarks.questions.files:BagAsker"},
    "mongo_json": {"mongo_json": "benchmarks.questions.mongo:MongoAsker"},
    "mongo_json_indexed": {"mongo_json_indexed": "benchmarks.questions.mongo:MongoAsker"},
    "postgres_autocommit": {"postgres_autocommit": "benchmarks.questions.postgres:PostgresAsker"},
    "postgres_tuned": {"postgres_tuned": "benchmarks.questions.postgres:PostgresAsker"},
    "postgres_tuned_indexed": {
        "postgres_tuned_indexed": "benchmarks.questions.postgres:PostgresIndexedAsker"
    },
    "sqlite_udf": {"sqlite_udf": "benchmarks.questions.sqlite:SqliteUdfAsker"},
    "sqlite_json1": {"sqlite_json1": "benchmarks.questions.sqlite:SqliteJsonAsker"},
    "hybridlog": {
        "hybridlog": "benchmarks.questions.mongo:HybridlogAppendixAsker",
        "hybridlog_api": "benchmarks.questions.api:ApiAsker",
        "hybridlog_indexed": "benchmarks.questions.mongo:HybridlogIndexedAsker",
        "hybridlog_api_indexed": "benchmarks.questions.api:IndexedApiAsker",
    },
}

READERS: Final[dict[str, dict[str, str]]] = {
    "mcap": {"mcap": "benchmarks.questions.files:McapReading"},
    "bagfile": {"bagfile": "benchmarks.questions.files:BagReading"},
    "mongo_json": {"mongo_json": "benchmarks.questions.mongo:MongoReading"},
    "mongo_json_indexed": {"mongo_json_indexed": "benchmarks.questions.mongo:MongoReading"},
    "postgres_autocommit": {"postgres_autocommit": "benchmarks.questions.postgres:PostgresReading"},
    "postgres_tuned": {"postgres_tuned": "benchmarks.questions.postgres:PostgresReading"},
    "postgres_tuned_indexed": {
        "postgres_tuned_indexed": "benchmarks.questions.postgres:PostgresReading"
    },
    "sqlite_udf": {"sqlite_udf": "benchmarks.questions.sqlite:SqliteUdfReading"},
    "sqlite_json1": {"sqlite_json1": "benchmarks.questions.sqlite:SqliteJsonReading"},
    "hybridlog": {"hybridlog": "benchmarks.questions.api:HybridlogReading"},
}
