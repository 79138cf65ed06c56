"""MongoDB, a document a message, inserted in batches."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from benchmarks.backends.base import (
    ARM,
    GRIPPER,
    HALF_NS,
    VIEWPOINT,
    BackendMissingError,
    failing,
    sums,
)
from benchmarks.backends.conversion import INSERTED_AT, DatabaseBackend, date_of
from benchmarks.backends.server import Server
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    import pandas as pd
    from bson.raw_bson import RawBSONDocument
    from numpy.typing import NDArray
    from pymongo import MongoClient
    from pymongo.collection import Collection
    from pymongo.database import Database

    from benchmarks.backends.conversion import Document
    from hybridlog_storage.messages import Channel

DATABASE = "roslog"
BATCH_S = 2.0
"""Seconds of a topic's messages in one insert."""
BATCH_BYTES = 1 << 18
"""BSON after which an insert is not put off any longer."""
_FIND_MS = 2000
"""ms until a server that is gone counts as gone."""
_ANSWER_MS = 120_000
"""ms until an operation counts as hanging."""
_PING_MS = 250


@dataclass(slots=True)
class _Batch:
    """What one channel has not sent yet."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    documents: list[RawBSONDocument] = field(default_factory=list)
    size: int = 0
    since: float = 0.0


class Mongo(DatabaseBackend):
    """A mongod of its own with its default settings, and many messages an insert.

    Documents are encoded as they come: a driver that is given a batch of dictionaries
    encodes them all while every other thread waits. Inserts are unordered. Larger batches
    lose more messages while one is sent, smaller ones take more of the processor.

    The WiredTiger cache has its default size (half of the memory less 1 GiB), the journal
    is on, the write concern is the default one. One client is shared by all threads.
    """

    name, title = "mongo", "MongoDB"

    _is_indexed = False

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._server = Server("mongod", directory)
        self._client: MongoClient[Document] | None = None
        self._collections: list[Collection[Document]] = []
        self._batches: list[_Batch] = []

    @classmethod
    def check(cls) -> None:
        _program()

    @property
    def _database(self) -> Database[Document]:
        """The database with the collections, through pymongo; between `open` and `close`."""
        assert self._client is not None
        return self._client[DATABASE]

    def open(self, channels: Sequence[Channel]) -> None:
        self.check()
        from pymongo import MongoClient
        from pymongo.errors import PyMongoError

        self._take_channels(channels)
        data = self.directory / "mongod"
        self._server.prepare(data)
        socket = self._server.sockets / "mongod.sock"
        uri = f"mongodb://{quote(str(socket), safe='')}/?directConnection=true"
        command = [
            _program(),
            *("--dbpath", str(data.absolute())),
            # A path as address, and no socket of its own making: no TCP port is opened.
            *("--bind_ip", str(socket)),
            "--nounixsocket",
            *("--filePermissions", "0700"),
        ]
        self._server.start(command, signal.SIGTERM, lambda: _answers(uri))
        self._client = MongoClient(
            uri,
            serverSelectionTimeoutMS=_FIND_MS,
            connectTimeoutMS=_FIND_MS,
            socketTimeoutMS=_ANSWER_MS,
        )
        with failing("MongoDB", PyMongoError):
            self._make_collections()
        self._batches = [_Batch() for _ in channels]

    def _make_collections(self) -> None:
        there = set(self._database.list_collection_names())
        for topic, groups in self._topics().items():
            name = collection_of(topic)
            if name not in there:
                self._database.create_collection(name)
            if self._is_indexed:
                for keys in (_keys(group) for group in [*groups, (INSERTED_AT,)]):
                    self._database[name].create_index(keys)
        self._collections = [self._database[collection_of(c.topic)] for c in self._channels]

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        from bson import ObjectId, encode
        from bson.raw_bson import RawBSONDocument

        document = self._converters[channel].document(log_time, payload)
        encoded = encode({"_id": ObjectId(), **document})
        batch = self._batches[channel]
        with batch.lock:
            if not batch.documents:
                batch.since = time.monotonic()
            batch.documents.append(RawBSONDocument(encoded))
            batch.size += len(encoded)
            if batch.size >= BATCH_BYTES or time.monotonic() - batch.since >= BATCH_S:
                self._send(channel, batch)

    def finish(self) -> None:
        from pymongo import WriteConcern
        from pymongo.errors import PyMongoError

        for channel, batch in enumerate(self._batches):
            with batch.lock:
                self._send(channel, batch)
        assert self._client is not None
        # All that was written before this one is in the journal when this one is.
        journaled = self._client["harness"].get_collection(
            "finish", write_concern=WriteConcern(w=1, j=True)
        )
        with failing("MongoDB", PyMongoError):
            journaled.replace_one({"_id": 0}, {}, upsert=True)

    def counts(self) -> Mapping[str, int]:
        from pymongo.errors import PyMongoError

        with failing("MongoDB", PyMongoError):
            return {
                topic: self._database[collection_of(topic)].count_documents({})
                for topic in self._topics()
            }

    def close(self) -> None:
        client, self._client = self._client, None
        try:
            if client is not None:
                client.close()
        finally:
            self._server.stop()

    def processes(self) -> Sequence[int]:
        return self._server.processes()

    def _send(self, channel: int, batch: _Batch) -> None:
        from pymongo.errors import PyMongoError

        if not batch.documents:
            return
        with failing("MongoDB", PyMongoError):
            self._collections[channel].insert_many(batch.documents, ordered=False)
        batch.documents, batch.size = [], 0


class MongoIndexed(Mongo):
    """The same with the indexes of the paper's appendix A, made before the first message.

    They are made where a topic's type has the fields; every collection has one on
    `_meta.inserted_at`.
    """

    name, records, answers, reads = "mongo_indexed", False, True, True
    _is_indexed = True

    def closings(self) -> int:
        return self._of(GRIPPER).count_documents({"position": 0.0})

    def behind(self) -> int:
        return self._of(VIEWPOINT).count_documents({"position.x": {"$lte": 0}})

    def positions(self) -> list[float]:
        found = self._of(VIEWPOINT).find({"position.x": {"$lte": 0}}, {"_id": 0, "position": 1})
        return sums([tuple(row["position"][axis] for axis in "xyz") for row in found])

    def in_region(self) -> int:
        return self._of(ARM).count_documents(
            {
                "pose.position.z": {"$gt": 1},
                "pose.position.y": {"$gt": -0.5, "$lt": 0.5},
                "pose.position.x": {"$gt": 0.5, "$lt": 1},
            }
        )

    def grasps(self) -> int:
        """As in the appendix, which counts a closing without a viewpoint, too."""
        half = timedelta(microseconds=HALF_NS // 1000)
        viewpoints = self._of(VIEWPOINT)
        found = 0
        for closing in self._of(GRIPPER).find({"position": 0.0}):
            time = closing["_meta"]["inserted_at"]
            within = {"$lt": time + half, "$gt": time - half}
            row = viewpoints.find_one({"position.x": {"$gte": 0}, INSERTED_AT: within})
            found += row is not None
        return found

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        within = {"$gte": date_of(begin), "$lt": date_of(end)}
        order, fields = [(INSERTED_AT, 1)], {"_id": 0, "ranges": 1}
        rows = self._of(topic).find({INSERTED_AT: within}, fields, sort=order)
        return np.array([row["ranges"] for row in rows], np.float32)

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        until, fields = {INSERTED_AT: {"$lte": date_of(time)}}, {"_id": 0, "ranges": 1}
        row = self._of(topic).find_one(until, fields, sort=[(INSERTED_AT, -1)])
        assert row is not None
        return np.array(row["ranges"], np.float32)

    def table(self, topic: str) -> pd.DataFrame:
        import pandas as pd

        frame = pd.json_normalize(list(self._of(topic).find({}, {"_id": 0})))
        return frame.sort_values("_meta.t", kind="stable")

    def _of(self, topic: str) -> Collection[Document]:
        return self._database[collection_of(topic)]


def _keys(group: tuple[str, ...]) -> list[tuple[str, int]]:
    keys = [(path, 1) for path in group]
    return [*keys, (INSERTED_AT, 1)] if group == ("position.x",) else keys


def _program() -> str:
    from hybridlog_storage.errors import MissingDependencyError
    from hybridlog_storage.mongo.mongod import find_mongod

    try:
        return str(find_mongod())
    except MissingDependencyError as error:
        raise BackendMissingError(str(error)) from error


def _answers(uri: str) -> bool:
    from pymongo import MongoClient
    from pymongo.errors import PyMongoError

    client: MongoClient[dict[str, Any]] = MongoClient(uri, serverSelectionTimeoutMS=_PING_MS)
    with client:
        try:
            client.admin.command("ping")
        except PyMongoError:
            return False
    return True
