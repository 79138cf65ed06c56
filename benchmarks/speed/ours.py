"""hybridlog's sides of the comparisons. Each function runs in a process of its own."""

from __future__ import annotations

import hashlib
import time
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import hybridlog as hl
from benchmarks.memory import mongod_peak
from benchmarks.side import Values

if TYPE_CHECKING:
    from hybridlog.store import Store


def record(bag: str, store: str) -> Values:
    """Record a bag into a fresh store, until its index is complete.

    The mongod runs and the modules are loaded before the clock starts, as on the other sides.
    """
    import hybridlog.recorder
    import hybridlog.sources.detect  # noqa: F401

    with hl.open(store, create=True, require_database=True) as opened:
        started = time.perf_counter()
        report = opened.record(bag)
        elapsed = time.perf_counter() - started
        if report.failure is not None or report.indexed != report.entry.messages:
            raise AssertionError(f"only {report.indexed} of {report.entry.messages} indexed")
        return {
            "seconds": elapsed,
            "messages": report.entry.messages,
            "stored_bytes": report.entry.stored_bytes,
            "mongod_peak_rss": mongod_peak(opened.directory.mongod / "data"),
        }


def slices(store: str, topic: str, starts: list[int], length_ns: int) -> Values:
    """Read the payloads of one topic in several time ranges, each for the first time."""
    before = time.perf_counter()
    with hl.open(store) as opened:
        open_s = time.perf_counter() - before
        seconds, counters, found = [], [], []
        for start in starts:
            began = time.perf_counter()
            query = opened.topic(topic).between(start, start + length_ns)
            payloads = [message.raw for message in query]
            seconds.append(time.perf_counter() - began)
            counters.append(query.counters.bytes_read)
            found.append(payloads)
        return {
            "open_s": open_s,
            "seconds": seconds,
            "bytes_read": counters,
            "compressed": [_compressed(opened, topic, s, s + length_ns) for s in starts],
            "answers": [digest(payloads) for payloads in found],
        }


def frame(store: str, topic: str) -> Values:
    """One topic as a pandas frame, all columns; pandas is loaded before, as on the other sides."""
    import pandas as pd  # noqa: F401

    with hl.open(store) as opened:
        started = time.perf_counter()
        made = opened.topic(topic).to_pandas()
        elapsed = time.perf_counter() - started
        return {
            "seconds": elapsed,
            "rows": len(made),
            "sum": float(made["angular_velocity.x"].sum()),
            "last_covariance": [float(v) for v in made["orientation_covariance"].iloc[-1]],
        }


def digest(payloads: list[bytes]) -> str:
    """Number and content of payloads, to compare answers by."""
    whole = hashlib.sha256()
    for payload in payloads:
        whole.update(len(payload).to_bytes(8, "little") + payload)
    return f"{len(payloads)}:{whole.hexdigest()[:32]}"


def _compressed(store: Store, topic: str, start: int, end: int) -> float:
    """Compressed bytes of the messages in a time range: of each its share of its chunk.

    Found without hybridlog's reader: references from MongoDB, chunks from the summary
    that the `mcap` package reads.
    """
    import pymongo.database
    from mcap.reader import make_reader

    from hybridlog_storage.collection_names import collection_of

    database = store.database_for("the benchmark")._database  # noqa: SLF001
    assert isinstance(database, pymongo.database.Database)
    lengths: defaultdict[tuple[str, int, int], int] = defaultdict(int)
    found = database[collection_of(topic)].find(
        {"_meta.t": {"$gte": start, "$lt": end}}, {"_meta.rec": 1, "_meta.ref": 1}
    )
    for document in found:
        meta = document["_meta"]
        ref = meta["ref"]
        lengths[meta["rec"], ref["seg"], ref["chunk"]] += ref["len"]
    total = 0.0
    labels = {entry.key: entry.label for entry in store.recordings()}
    for recording, segment in {key[:2] for key in lengths}:
        path = Path(store.directory.recording(labels[recording]), f"{segment:06d}.mcap")
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        chunks = sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
        for number, chunk in enumerate(chunks):
            size = lengths.get((recording, segment, number), 0)
            total += size / chunk.uncompressed_size * chunk.compressed_size
    return total
