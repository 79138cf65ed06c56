"""Stores that are prepared once, copied for each case, and looked at from all sides."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import sqlite3
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import bson
from pymongo import MongoClient

import hybridlog as hl
from hybridlog.columns.folders import files_of
from hybridlog.columns.layout import PARTS
from hybridlog.entries import describe_now, state_now, take_inventory, with_said
from hybridlog.record.losses import losses_of
from hybridlog.record.marks import MARKS
from hybridlog_storage.catalog import CATALOG, RecordingEntry
from hybridlog_storage.cells import put
from hybridlog_storage.disk.directory import LOCK, StoreDirectory
from hybridlog_storage.errors import ManifestError
from hybridlog_storage.manifests import MANIFEST_LOCK, MANIFEST_OLD
from hybridlog_storage.mongo.collection_names import CATALOG_PREFIX, collection_of
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_state import STORE, IndexState
from tests import places
from tests.databases import Databases
from tests.faults.logs import Content
from tests.indexed import EVERYTHING

WHERE = 20
"""Messages with `n` of at least this are asked for."""
_ANY_FILE = {LOCK, MANIFEST_LOCK, MANIFEST_OLD, f".{MANIFEST_OLD}"}
_MADE_UP = re.compile(r"\b([0-9]{8}-[a-z0-9-]+-)?[0-9a-f]{16}\b|\b[0-9a-f]{32}\b|\d{19}")


class Server:
    """One MongoDB for many databases.

    Args:
        databases: Makes them.
    """

    def __init__(self, databases: Databases) -> None:
        self.new = databases.new
        self.client: MongoClient[Any] = MongoClient(databases.new())

    def drop(self, uri: str) -> None:
        """Remove a database."""
        self.client.drop_database(_name(uri))

    def documents(self, uri: str) -> dict[str, bytes]:
        """All documents of a database, by collection."""
        database = self.client[_name(uri)]
        return {
            name: b"".join(database[name].find_raw_batches({}))
            for name in database.list_collection_names()
            if not name.startswith("system.")
        }


def _name(uri: str) -> str:
    return uri.partition("?")[0].rpartition("/")[2]


@dataclass(frozen=True)
class Prepared:
    """A store and its database, to be copied.

    Attributes:
        path: The store.
        documents: Of its database, by collection.
    """

    path: Path
    documents: Mapping[str, bytes]

    @classmethod
    def of(cls, server: Server, path: Path, uri: str) -> Prepared:
        """A store as it is now."""
        return cls(path, server.documents(uri))

    def duplicate(self, path: Path) -> None:
        """Copy the files, with a catalog that fits them as well as it did before."""
        shutil.copytree(self.path, path, symlinks=True)
        if not (path / CATALOG).exists():
            return
        old, new = StoreDirectory(self.path), StoreDirectory(path)
        with closing(sqlite3.connect(path / CATALOG)) as catalog, catalog:
            rows = catalog.execute("SELECT key, body FROM cells WHERE kind = 'entry'").fetchall()
            for recording, body in rows:
                looks, entry = json.loads(body)
                with suppress(ManifestError):  # one whose manifest is damaged fits no row
                    if looks == state_now(old, recording):
                        now = json.dumps([state_now(new, recording), entry])
                        catalog.execute(*put("entry", recording, now.encode()))

    @contextmanager
    def copy(self, server: Server, path: Path) -> Iterator[Case]:
        """A copy of its own for a case."""
        self.duplicate(path)
        uri = server.new()
        try:
            with Database.connect(uri) as database:
                for collection, data in self.documents.items():
                    if not collection.startswith(CATALOG_PREFIX):
                        database.ensure_collection(collection)
                    if collection != STORE:
                        database.insert_raw(collection, [*map(bson.encode, bson.decode_all(data))])
                IndexState(database).claim(
                    StoreDirectory(path).settings.store_id,
                    f"{platform.node()}:{os.path.realpath(path)}",
                )
            yield Case(server, path, uri)
        finally:
            server.drop(uri)
            shutil.rmtree(path)


@dataclass(frozen=True)
class Case:
    """A store that something is done to.

    Attributes:
        server: Of its database.
        path: The store.
        uri: Its database.
    """

    server: Server
    path: Path
    uri: str

    def open(self) -> hl.Store:
        """The store, as a new process opens it."""
        return hl.open(self.path, mongo=self.uri)


@dataclass(frozen=True)
class Seen:
    """A recording, as everything that can be asked shows it.

    Attributes:
        entry: Its entry in the catalog, without what is drawn or measured anew each time.
        messages: Log time and payload of its messages, by topic, in order.
        losses: Rows of its loss ledger.
    """

    entry: Mapping[str, Any]
    messages: Mapping[str, tuple[tuple[int, bytes], ...]]
    losses: tuple[Mapping[str, Any], ...]

    @property
    def lost(self) -> int:
        """Messages that its ledger says are missing."""
        return sum(row["count"] or 0 for row in self.losses)

    def holds(self, said: Content) -> bool:
        """Whether it has all messages of a log, and no others."""
        return self.messages == {
            topic: tuple((one.time, one.payload) for one in part) for topic, part in said.items()
        }


@dataclass(frozen=True)
class State:
    """All that a store answers.

    Attributes:
        recordings: By name.
        files: Names of all files, but for those that may be there or not.
        findings: What `verify` says.
        unreadable: What an opening says of recordings that answer nothing.
    """

    recordings: Mapping[str, Seen]
    files: frozenset[str]
    findings: tuple[str, ...] = field(default=())
    unreadable: tuple[str, ...] = field(default=())

    def without(self, label: str) -> State:
        """The same without a recording."""
        return replace(
            self,
            recordings={k: v for k, v in self.recordings.items() if k != label},
            files=frozenset(f for f in self.files if f.partition("/")[0] != label),
        )


class WrongError(AssertionError):
    """A store contradicts itself."""


def look(case: Case) -> State:
    """Open a store as a new process does, ask everything, and hold the answers together.

    Raises:
        WrongError: An answer contradicts another one, or something was left over.
    """
    with case.open() as store:
        without_server = {entry.name: _messages(store, entry) for entry in store.recordings()}
        database = store.connect()
        # What connecting has mended is what counts.
        seen = {entry.name: _look_at(store, entry) for entry in store.recordings()}
        for label, messages in without_server.items():
            _check(seen[label].messages == messages, f"{label} changed while it was asked")
        verification = store.verify()
        findings = tuple(
            sorted(f"{f.recording}: {f.place}: {f.problem}" for f in verification.findings)
        )
        _check(verification.index, "the index was not compared")
        _check_database(store, database)
        _check_catalog(store)
        _check_tables(store)
        unreadable = tuple(sorted(map(_plain, store.repairs.unreadable.values())))
    return State(seen, _files(case.path), tuple(_plain(f) for f in findings), unreadable)


def _check(holds: object, otherwise: str) -> None:
    if not holds:
        raise WrongError(otherwise)


def _messages(store: hl.Store, entry: RecordingEntry) -> dict[str, tuple[tuple[int, bytes], ...]]:
    """Messages by topic, without asking a server."""
    found: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
    topics = sorted({c.topic for c in entry.channels})
    if not topics:
        return {}
    query = store.query(topics, [entry.id])
    for message in query:
        found[message.topic].append((message.log_time_ns, bytes(message.raw)))
    _check(query.count() == sum(map(len, found.values())), "the number of messages differs")
    return {topic: tuple(part) for topic, part in found.items()}


def _look_at(store: hl.Store, entry: RecordingEntry) -> Seen:
    messages = _messages(store, entry)
    for topic, part in messages.items():
        query = store.query([topic], [entry.id])
        numbers = [number_of(topic, payload) for _, payload in part]
        wanted = [n for n in numbers if n is not None and n >= WHERE]
        asked = query.where(f"n >= {WHERE}")
        _check(asked.count() == len(wanted), f"count of {topic} where: {asked.count()}")
        given = [number_of(topic, bytes(m.raw)) for m in asked]
        _check(given == wanted, f"messages of {topic} where: {given} instead of {wanted}")
        if topic != MARKS:  # which MongoDB does not have
            documents = query.where(EVERYTHING).count()
            _check(documents == len(part), f"{documents} documents of {len(part)} {topic}")
        begin, end = part[0][0], part[-1][0] + 1
        middle = (begin + end + 1) // 2
        half = query.between(f"{begin}ns", f"{middle}ns")
        expected = sum(time < middle for time, _ in part)
        _check(half.count() == expected, f"half of {topic}: {half.count()} instead of {expected}")
    told = sum(channel.stats.messages for channel in entry.channels)
    _check(told == sum(map(len, messages.values())), f"{entry.name} says {told} messages")
    return Seen(_comparable(entry), messages, tuple(map(_without_made_up, losses_of(entry))))


def number_of(topic: str, payload: bytes) -> int | None:
    """What stands in the field `n` of a message."""
    if topic in {"/number", "/scan"}:
        return int.from_bytes(payload[:4], "little", signed=True)
    if topic == "/stamped":
        return int.from_bytes(payload[-4:], "little", signed=True)
    value = json.loads(payload).get("n")
    return value if isinstance(value, int) else None


def _comparable(entry: RecordingEntry) -> dict[str, Any]:
    found = asdict(replace(entry, flushed={}))
    # Drawn or taken anew for each recording, and what follows from them.
    for name in ("id", "created", "digests", "stored_bytes"):
        del found[name]
    found["source"].pop("path", None)
    for note in found["notes"]:
        note.pop("at")
    for mark in found["marks"]:
        mark.pop("id")
    found["end"] = _without_made_up(found["end"])
    return found


def _without_made_up(value: Any) -> Any:
    """What is the same each time: without ids and sizes of files."""
    if isinstance(value, Mapping):
        return {k: _without_made_up(v) for k, v in value.items() if k not in {"length", "offset"}}
    if isinstance(value, list | tuple):
        return [_without_made_up(v) for v in value]
    return _plain(value) if isinstance(value, str) else value


def _plain(text: str) -> str:
    return _MADE_UP.sub("*", text)


def _files(path: Path) -> frozenset[str]:
    """Names of files in recordings by name, and whatever else should not be in the store."""
    found = set()
    for folder in places.folders(path):
        name = places.name_of(folder)
        found |= {name, *(f"{name}/{p.relative_to(folder)}" for p in folder.rglob("*"))}
    found |= {f"../{p.name}" for p in path.iterdir()}
    return frozenset(name for name in found if Path(name).name not in _ANY_FILE) - {
        "../catalog.sqlite",
        "../hybridlog.toml",
        "../recordings",
        "../tables",
        "../tables.part",
    }


def _check_tables(store: hl.Store) -> None:
    """None is of a recording that is gone, and nothing is unfinished."""
    ids = {entry.id for entry in store.recordings()} | store.repairs.unreadable.keys()
    path = store.directory.path
    there = {section.id for file in files_of(path) for section in file.about.sections}
    _check(there <= ids, f"there are tables of {there - ids}")
    unfinished = [str(p) for p in (path / PARTS).glob("*/**/*")]
    _check(not unfinished, f"unfinished tables are left: {unfinished}")


def _check_database(store: hl.Store, database: Database) -> None:
    """Nothing is in it that is of no recording, and of each recording there is all."""
    entries = {entry.key: entry for entry in store.recordings() if entry.name}
    hidden = {recording[-16:] for recording in store.repairs.unreadable}  # kept until they answer
    states = IndexState(database).of()
    _check(states.keys() - hidden == entries.keys(), f"indexed are {states.keys()}")
    for key, entry in entries.items():
        is_whole = states[key].is_whole(entry)
        _check(is_whole, f"of {entry.name} other segments are indexed")
    expected: dict[str, Counter[str]] = defaultdict(Counter)
    for key, entry in entries.items():
        for topic in {c.topic for c in entry.channels}:
            if messages := entry.messages_by_topic()[topic]:
                expected[collection_of(topic)][key] += messages
    for collection in IndexState(database).document_collections():
        (counts,) = database.count_each([(collection, {})])
        documents = dict(counts)
        found = {key: number for key, number in documents.items() if key not in hidden}
        _check(found == expected[collection], f"{collection} has {found}")


def _check_catalog(store: hl.Store) -> None:
    """The catalog is what the files say."""
    rows = {one.id: store.catalog.recording(one.id) for one in store.catalog.summaries()}
    hidden = store.repairs.unreadable.keys()
    rows = {recording: row for recording, row in rows.items() if recording not in hidden}
    ids = [recording for recording in store.directory.ids() if recording not in hidden]
    _check(len(rows) == len(ids), f"{ids} are there, {len(rows)} in the catalog")
    for recording in ids:
        described = describe_now(store.directory, store.catalog, recording)
        files, entry = rows[recording]
        known = files, with_said(entry, store.directory.manifests.read(recording))
        _check(
            known == (described.files, described.entry), f"the catalog's row of {recording} differs"
        )
        known = next(one for one in store.catalog.summaries() if one.id == described.entry.id)
        same = known._replace(indexed_by="") == described.summary
        _check(same, f"the catalog's summary of {recording} differs")
        for number, summary in take_inventory(store.directory, recording).summaries.items():
            found, wanted = store.catalog.table(described.entry, number), summary.table
            _check(
                found.to_bytes() == wanted.to_bytes(), f"the chunks of {recording} {number} differ"
            )
