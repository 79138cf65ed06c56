"""The other ways into MongoDB: dictionaries, and raw documents that are there already."""

from __future__ import annotations

import json
import mmap
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import chain, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import hybridlog as hl
from benchmarks.backends.conversion import Plan, message_plan
from benchmarks.memory import mongod_peak
from benchmarks.side import Values
from hybridlog_storage.bson_columns import split
from hybridlog_storage.database import Database
from hybridlog_storage.mongod import EmbeddedMongod

if TYPE_CHECKING:
    from numpy.typing import NDArray

_DOCUMENTS = 1000
"""Documents in one `insert_many`."""
_BLOCK = 5000
_THREADS = 2


def dictionaries(bag: str, directory: str) -> Values:
    """Decode every message with rosbags, make it a dictionary, `insert_many` of 1 000."""
    import pymongo
    from rosbags.highlevel import AnyReader

    with EmbeddedMongod(Path(directory)) as mongod:
        client: pymongo.MongoClient[dict[str, Any]] = pymongo.MongoClient(mongod.start())
        with client, AnyReader([Path(bag)]) as reader:
            database = client["plain"]
            client.admin.command("ping")
            started = time.perf_counter()
            waiting: dict[str, list[dict[str, Any]]] = {}
            plans: dict[str, Plan] = {}
            messages = 0
            for connection, log_time, payload in reader.messages():
                kind = connection.msgtype
                plan = plans.get(kind)
                if plan is None:
                    plan = plans[kind] = message_plan(reader.typestore, kind)
                document = plan(reader.deserialize(payload, kind))
                document["log_time"] = log_time
                rows = waiting.setdefault(connection.topic, [])
                rows.append(document)
                messages += 1
                if len(rows) == _DOCUMENTS:
                    database[_name(connection.topic)].insert_many(rows)
                    rows.clear()
            for topic, rows in waiting.items():
                if rows:
                    database[_name(topic)].insert_many(rows)
            elapsed = time.perf_counter() - started
        return {
            "seconds": elapsed,
            "messages": messages,
            "mongod_peak_rss": mongod_peak(mongod.data),
        }


def dump(store: str, directory: str) -> Values:
    """Write all index documents of a store to files, for `raw_documents`."""
    where = Path(directory)
    where.mkdir(exist_ok=True)
    names: list[str] = []
    with hl.open(store) as opened:
        database = opened.database_for("the benchmark")
        for name in database.list_collections():
            if name.startswith("hybridlog."):
                continue
            lengths = []
            with (where / f"{len(names)}.bson").open("wb") as stream:
                for raw in database.find_raw(name):
                    stream.write(raw)
                    lengths.append(np.diff([*split(raw).tolist(), len(raw)]))
            np.save(where / f"{len(names)}.npy", np.concatenate(lengths).astype(np.int64))
            names.append(name)
    (where / "names.json").write_text(json.dumps(names))
    return {"bytes": sum(file.stat().st_size for file in where.glob("*.bson"))}


def raw_documents(documents: str, directory: str) -> Values:
    """Insert documents that were made before: what mongod alone takes."""
    where = Path(documents)
    names: list[str] = json.loads((where / "names.json").read_text())
    with (
        EmbeddedMongod(Path(directory)) as mongod,
        Database.connect(mongod.start()) as database,
        ThreadPoolExecutor(_THREADS) as pool,
    ):
        blocks = []
        for number, name in enumerate(names):
            database.ensure_collection(name)
            blocks.append(_blocks(name, where / f"{number}.bson", where / f"{number}.npy"))
        mixed = [block for block in chain(*zip_longest(*blocks)) if block is not None]

        def insert(block: tuple[str, memoryview, NDArray[np.int64]]) -> int:
            name, content, lengths = block
            return database.insert_raw(name, content, len(lengths), lengths=lengths)

        started = time.perf_counter()
        inserted = sum(pool.map(insert, mixed))
        elapsed = time.perf_counter() - started
        return {
            "seconds": elapsed,
            "messages": inserted,
            "mongod_peak_rss": mongod_peak(mongod.data),
        }


def _blocks(
    name: str, content: Path, lengths: Path
) -> list[tuple[str, memoryview, NDArray[np.int64]]]:
    """Documents of one collection, some thousand at a time, straight from the file cache."""
    sizes: NDArray[np.int64] = np.load(lengths)
    with content.open("rb") as stream:
        whole = memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    ends = np.concatenate([[0], np.cumsum(sizes)])
    return [
        (name, whole[int(ends[first]) : int(ends[last])], sizes[first:last])
        for first in range(0, len(sizes), _BLOCK)
        for last in (min(first + _BLOCK, len(sizes)),)
    ]


def _name(topic: str) -> str:
    return topic.strip("/").replace("/", "__")
