"""Which class asks which backend. To ask one more, write its class and name it here."""

from __future__ import annotations

from typing import Final

ASKERS: Final = {
    "hybridlog": "benchmarks.questions.api:HybridlogAsker",
    "mongo_indexed": "benchmarks.questions.mongo:MongoAsker",
    "postgres_indexed": "benchmarks.questions.postgres:PostgresAsker",
    "sqlite_indexed": "benchmarks.questions.sqlite:SqliteAsker",
    "bagfile": "benchmarks.questions.files:BagAsker",
}
"""Classes (`module:class`) by the name of the backend, in the order of their turns."""

READERS: Final = {
    "hybridlog": "benchmarks.questions.api:HybridlogReading",
    "mongo_indexed": "benchmarks.questions.mongo:MongoReading",
    "postgres_indexed": "benchmarks.questions.postgres:PostgresReading",
    "sqlite_indexed": "benchmarks.questions.sqlite:SqliteReading",
    "bagfile": "benchmarks.questions.files:BagReading",
    "mcap": "benchmarks.questions.files:McapReading",
}
