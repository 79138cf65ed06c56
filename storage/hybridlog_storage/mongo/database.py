"""Access to MongoDB: raw BSON in and out, and driver errors mapped to hybridlog errors.

The only module that uses pymongo. Documents made by hybridlog are transferred as bytes in
both directions, thousands at a time, and never become Python objects. pymongo is imported
on first use, since its import takes longer than most commands.

Every command may be repeated: documents are inserted under their own `_id`, and other
changes have the same result twice. So a command is sent again when its connection breaks,
and a long answer goes on behind the last document received. In a replica set, writes are
acknowledged by a majority of the members, whatever the URI says: an acknowledged write then
outlives the loss of the primary. Reads go to the primary.
"""

from __future__ import annotations

import contextlib
import functools
import operator
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import numpy as np

from hybridlog_storage.errors import (
    ConnectionBrokenError,
    ConnectionLostError,
    DatabaseError,
    DiskFullError,
    UsageError,
    WhereError,
)
from hybridlog_storage.settings import LOGIN_CURE

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pymongo import MongoClient
    from pymongo.collection import Collection
    from pymongo.database import Database as PymongoDatabase
    from pymongo.write_concern import WriteConcern

    from hybridlog_storage.messages import Buffer

Document = dict[str, Any]
"""A decoded document with values of the `bson` package."""
Sort = Sequence[tuple[str, int]]
"""Field paths with 1 (ascending) or -1 (descending)."""
ReadConcern = Literal["local", "majority"]
"""What a read of a replica set may see: everything that the primary has, or only what cannot be
rolled back. A single server knows no difference."""
_T = TypeVar("_T")

BATCH_BYTES = 16 << 20
"""Most bytes of documents in one insert command; a single document may have as many."""
BATCH_DOCUMENTS = 5000
"""Most documents in one insert command; more make the server slower, not faster."""
OLDEST_SERVER = (5, 3)
"""The first MongoDB with clustered collections."""

_MAX_QUESTIONS_PER_COMMAND = 100
"""Most questions in one command."""
_MAX_COMMAND_BYTES = 4 << 20

_GONE_S = 1.0  # seconds without an answer after which the server counts as ended
_TRIES = 3  # for a command whose connection breaks
_ELECTION_S = 20.0  # seconds for a replica set to elect a primary; it takes about 12
_REPLICATION_S = 60.0  # seconds for a majority of its members to take over a write
_NO_LONGER_PRIMARY = frozenset({91, 189, 10107, 11600, 11602, 13435, 13436})
"""Server error codes of a member that stops being the primary."""
_DUPLICATE_KEY = 11000
_NAMESPACE_EXISTS = 48
_DISK_FULL = frozenset({14031})
_WRONG_QUESTION = frozenset(
    {
        2,  # BadValue: unknown operators, $where without scripting
        9,  # FailedToParse
        14,  # TypeMismatch
        15,  # Overflow: nested too deep
        27,  # IndexNotFound: $text, $near
        31,  # PathNotViable
        52,  # DollarPrefixedFieldName
        56,  # EmptyFieldName
        57,  # DottedFieldName
        72,  # InvalidOptions
        139,  # JSInterpreterFailure
        168,  # InvalidPipelineOperator
        241,  # ConversionFailure
    }
)
"""Server error codes that mean an invalid predicate."""
_UNNAMED_CODE = "Location"
"""Prefix of the server's unnamed error codes: thousands of checks on the arguments of
operators and expressions. Failures of the server itself have names."""
_WRITES = frozenset({"insert", "remove", "update"})
_UNAUTHORIZED = 13
_LOGIN_FAILED = 18
_RESERVED_NAMES = frozenset({"admin", "local", "config"})


@dataclass(frozen=True, slots=True)
class CollectionStats:
    """Size of a collection; all zero if it does not exist.

    Attributes:
        documents: Number of documents.
        storage_bytes: Bytes on disk.
        index_bytes: Bytes of the indexes on disk; a clustered collection needs none.
    """

    documents: int
    storage_bytes: int
    index_bytes: int


class Database:
    """One MongoDB database, opened by `connect`. A context manager; thread safe.

    Every method raises `DatabaseError` if the server does not answer or refuses. Methods
    with a `filter` or a pipeline raise `WhereError` if that is invalid.

    Attributes:
        is_lost: True after a method found no connection; make a new `Database` then.
    """

    def __init__(self, client: MongoClient[Document], name: str, address: str) -> None:
        self.is_lost = False
        self._client = client
        self._is_replicated = _is_replicated(client)
        self._write_concern = _write_concern(client, is_replicated=self._is_replicated)
        self._database: PymongoDatabase[Document] = client.get_database(
            name, write_concern=self._write_concern
        )
        self._address = address

    @classmethod
    def connect(cls, uri: str, name: str = "hybridlog", *, timeout_s: float = 5.0) -> Self:
        """Connect and check that the server answers and is new enough.

        Args:
            uri: MongoDB connection string. A database named in it wins over `name`, a
                `serverSelectionTimeoutMS` in it over `timeout_s`.
            name: Database to use; it need not exist.
            timeout_s: Seconds to wait for the server, now and in every later operation. If
                the URI is that of a replica set, 20 seconds more: it may elect a primary.

        Raises:
            UsageError: The URI or the database's name is malformed or not allowed.
            DatabaseError: No server answers, the login is refused, or the server is too old.
        """
        from pymongo import MongoClient
        from pymongo.errors import InvalidURI, PyMongoError
        from pymongo.uri_parser import parse_uri

        address = without_secrets(uri)
        try:
            parsed = parse_uri(uri, warn=False)
        except (InvalidURI, ValueError, TypeError) as error:
            # Without the original text: pymongo quotes options, which may be secret.
            raise UsageError(
                f"{address} is not a MongoDB connection string ({type(error).__name__}). Write "
                f"mongodb://host:port/, and percent-encode user name, password and socket path."
            ) from None
        except OSError as error:
            raise _unusable_file(address, error) from error
        except PyMongoError as error:  # an SRV record that cannot be resolved
            raise DatabaseError(f"MongoDB at {address} cannot be found: {error}") from error
        name = parsed["database"] or name
        if parsed["collection"]:
            name = f"{name}.{parsed['collection']}"
        if name in _RESERVED_NAMES or not re.fullmatch(r"[A-Za-z0-9_-]{1,38}", name):
            raise UsageError(
                f"{name!r} cannot be the name of hybridlog's database: use up to 38 letters, "
                f"digits, - and _, and none of {', '.join(sorted(_RESERVED_NAMES))}."
            )
        given = {option.lower() for option in parsed["options"]}
        # Members other than the primary may lack documents that the index is said to have.
        options: dict[str, object] = {"appname": "hybridlog", "readPreference": "primary"}
        if "serverselectiontimeoutms" not in given:
            is_set = len(parsed["nodelist"]) > 1 or "replicaset" in given or parsed["fqdn"]
            wait_s = timeout_s + (_ELECTION_S if is_set else 0)
            options["serverSelectionTimeoutMS"] = int(wait_s * 1000)
        if "connecttimeoutms" not in given:
            options["connectTimeoutMS"] = int(timeout_s * 1000)
        try:
            with _mapped(address):
                client: MongoClient[Document] = MongoClient(uri, **options)  # type: ignore[arg-type]
        except OSError as error:
            raise _unusable_file(address, error) from error
        try:
            if not client.write_concern.acknowledged:
                raise UsageError(f"{address}: w=0 would lose errors; leave it out.")
            version = _retried(client, address, client.server_info)
            if tuple(version["versionArray"][:2]) < OLDEST_SERVER:
                raise DatabaseError(
                    f"MongoDB at {address} has version {version['version']}; hybridlog needs "
                    f"{'.'.join(map(str, OLDEST_SERVER))} or newer (clustered collections)."
                )
        except BaseException:
            client.close()
            raise
        return cls(client, name, address)

    @property
    def name(self) -> str:
        """Name of the database."""
        return self._database.name

    @property
    def address(self) -> str:
        """The URI without user, password and options, for messages."""
        return self._address

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections. The object is unusable afterwards."""
        from pymongo import timeout

        # Closing reports finished sessions to the server, and would wait for an ended server.
        with timeout(_GONE_S):
            self._client.close()

    def ping(self) -> bool:
        """True if the server answers within a second, whatever the other timeouts are."""
        from pymongo import timeout

        try:
            with _mapped(self._address), timeout(_GONE_S):
                self._client.admin.command("ping")
        except DatabaseError:
            return False
        return True

    def _again(self, command: Callable[[], _T], *, question: bool = False) -> _T:
        """Run a command, again if its connection breaks."""
        with self._noting():
            return _retried(self._client, self._address, command, question=question)

    @contextlib.contextmanager
    def _noting(self) -> Iterator[None]:
        """Note a lost connection."""
        try:
            yield
        except ConnectionLostError:
            self.is_lost = True
            raise

    def may_write(self) -> bool:
        """False if the user of this connection may not change the database."""
        from pymongo.errors import OperationFailure

        def ask() -> Document:
            try:
                return self._client.admin.command("connectionStatus", showPrivileges=True)
            except OperationFailure:  # not MongoDB's own server
                return {}

        user = self._again(ask).get("authInfo", {})
        if not user.get("authenticatedUsers"):
            return True
        allowed: set[str] = set()
        for privilege in user.get("authenticatedUserPrivileges", ()):
            resource = privilege["resource"]
            names = resource.get("db"), resource.get("collection")
            if resource.get("anyResource") or names in {("", ""), (self.name, "")}:
                allowed.update(privilege["actions"])
        return allowed >= _WRITES

    def ensure_collection(self, name: str) -> None:
        """Create a clustered collection (`_id` is its only key) unless it exists."""
        from pymongo.errors import OperationFailure

        def create() -> None:
            try:
                self._database.create_collection(
                    name,
                    check_exists=False,
                    clusteredIndex={"key": {"_id": 1}, "unique": True},
                )
            except OperationFailure as error:
                if error.code != _NAMESPACE_EXISTS:
                    raise

        self._again(create)

    def insert_raw(
        self,
        collection: str,
        documents: Buffer,
        count: int,
        *,
        lengths: NDArray[np.int64] | None = None,
    ) -> int:
        """Insert documents as they are.

        An existing `_id` is skipped: documents are a pure function of the segment, so the
        document is the same. After an error any part may have been inserted, and inserting
        all again is safe.

        Args:
            collection: The target, created by `ensure_collection`.
            documents: `count` BSON documents, one after the other.
            count: Their number.
            lengths: int64[count], bytes of each document; avoids walking over them.

        Returns:
            Number of new documents; fewer after a repeated command.

        Raises:
            ValueError: `documents` does not hold `count` documents of the given lengths.
            DiskFullError: The server has no space left.
            DatabaseError: It refuses a document, or does not answer.
        """
        whole = memoryview(documents).cast("B")
        ends = _document_ends(whole, count, lengths)
        inserted = 0
        for first, last in _batches(ends):
            start, end = int(ends[first]), int(ends[last])
            # All documents are passed without a copy; pymongo before 4.18 takes bytes only.
            is_whole = isinstance(documents, bytes) and end - start == len(documents)
            part = documents if is_whole else whole[start:end]
            inserted += self._insert_batch(collection, bytes(part))
        return inserted

    def _insert_batch(self, collection: str, documents: bytes) -> int:
        if not collection or "$" in collection or "\0" in collection:
            raise DatabaseError(f"{collection!r} cannot be the name of a collection.")
        command: Document = {
            "insert": collection,
            "documents": [_pass_through(documents)],
            "ordered": False,
        }
        if not self._write_concern.is_server_default:
            command["writeConcern"] = self._write_concern.document

        def insert() -> Document:
            from pymongo.errors import NotPrimaryError

            reply = self._database.command(command)
            failed = reply.get("writeConcernError") or {}
            if failed.get("code") in _NO_LONGER_PRIMARY:
                raise NotPrimaryError(str(failed.get("errmsg", "")), failed)
            return reply

        reply = self._again(insert)
        for error in reply.get("writeErrors", ()):
            if error["code"] != _DUPLICATE_KEY:
                raise _refused(self._address, error["code"], str(error.get("errmsg", "")))
        failed = reply.get("writeConcernError")
        if failed:
            raise _refused(self._address, failed.get("code", 0), str(failed.get("errmsg", "")))
        return int(reply["n"])

    def find_raw(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002 - MongoDB's word
        projection: Mapping[str, object] | None = None,
        *,
        sort: Sort | None = None,
    ) -> Iterator[bytes]:
        """Find documents as bytes: each item is several concatenated BSON documents.

        Args:
            collection: The collection; one that does not exist is empty.
            filter: MongoDB's filter document.
            projection: MongoDB's projection document.
            sort: Order; None for the order of the collection, which is that of `_id`.
        """
        of, shape = self._collection(collection), None if projection is None else dict(projection)

        def ask(query: Document) -> Any:
            return of.find_raw_batches(
                query,
                shape,
                sort=sort or None,
                # As many as fit 16 MiB; by default the server's first batch has 101 documents.
                batch_size=1 << 30,
            )

        is_keyed = projection is None or projection.get("_id", 1)
        order = _key_order(sort) if is_keyed else 0
        return self._found(ask, dict(filter or {}), order, _last_key)

    def find(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002
        projection: Mapping[str, object] | None = None,
        *,
        sort: Sort | None = None,
        limit: int = 0,
        batch_size: int = 0,
        read: ReadConcern = "local",
    ) -> Iterator[Document]:
        """Find documents one by one; for small answers.

        The arguments are those of `find_raw`, and `read` for what the answer may hold; `limit`
        0 is for all documents.
        """
        of = self._collection(collection, read)

        def ask(query: Document) -> Any:
            return of.find(
                query,
                None if projection is None else dict(projection),
                sort=sort or None,
                limit=limit,
                batch_size=batch_size,
            )

        is_keyed = not limit and (projection is None or projection.get("_id", 1))
        order = _key_order(sort) if is_keyed else 0
        return self._found(ask, dict(filter or {}), order, operator.itemgetter("_id"))

    def _found(
        self,
        ask: Callable[[Document], Any],
        query: Document,
        order: int,
        key: Callable[[Any], object],
    ) -> Iterator[Any]:
        """Items of a cursor; goes on behind the last one if the connection breaks.

        Args:
            ask: Makes the cursor for a filter.
            query: The filter.
            order: 1 or -1 if the items are in the order of `_id`; 0 to go on only while there
                is no item yet.
            key: The last `_id` of an item.
        """
        last: Any = None
        tries = _TRIES
        with self._noting(), _mapped(self._address, question=True):
            while True:
                rest = query
                if last is not None:
                    rest = {"$and": [query, {"_id": {"$gt" if order > 0 else "$lt": key(last)}}]}
                try:
                    with _closing(ask(rest)) as cursor:
                        for item in cursor:
                            yield item
                            last, tries = item, _TRIES
                            if order and self._has_moved(cursor.address):
                                break
                        else:
                            return
                except _broken() as error:
                    tries -= 1
                    if not tries or (last is not None and not order):
                        raise
                    _wait(self._client, error)

    def _has_moved(self, address: tuple[str, int] | None) -> bool:
        """True if a member of a replica set is no longer its primary.

        A cursor there would wait for it, as long as for another primary.
        """
        is_set = self._client.topology_description.topology_type_name.startswith("ReplicaSet")
        return is_set and self._client.primary != address

    def find_one(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002
        projection: Mapping[str, object] | None = None,
        *,
        sort: Sort | None = None,
        read: ReadConcern = "local",
    ) -> Document | None:
        """Find the first document, None if no document matches. Arguments as in `find`."""
        found = self.find(collection, filter, projection, sort=sort, limit=1, read=read)
        return next(found, None)

    def count(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002
    ) -> int:
        """Number of documents that match.

        Without a filter this is the collection's own count. It costs nothing, but is an
        estimate after a server was killed.

        Args:
            collection: The collection; one that does not exist is empty.
            filter: MongoDB's filter document.
        """
        of = self._collection(collection)

        def ask() -> int:
            if not filter:
                return of.estimated_document_count()
            # A sharded cluster would count documents twice while it moves them.
            if self._client.is_mongos:
                return of.count_documents(dict(filter))
            # Costs less than a pipeline, as which the driver would send it.
            reply = self._database.command("count", of.name, query=dict(filter))
            return int(reply["n"])

        return self._again(ask, question=True)

    def count_each(self, questions: Sequence[tuple[str, Mapping[str, object]]]) -> list[int]:
        """Count the documents that match each of many questions, in few round trips.

        Meant for questions with a range of `_id`: MongoDB tries for each whether that range
        or another index is faster.
        """
        numbers = [0] * len(questions)
        for place, number in self._grouped(questions, lambda place: {"$literal": place}):
            numbers[place] = number
        return numbers

    def count_by(self, collections: Sequence[str], field: str) -> list[list[tuple[Any, int]]]:
        """The values of a field in each of some collections, and how many documents have each."""
        numbers: list[list[tuple[Any, int]]] = [[] for _ in collections]
        questions: list[tuple[str, Document]] = [(name, {}) for name in collections]
        for key, number in self._grouped(
            questions, lambda place: {"place": {"$literal": place}, "value": f"${field}"}
        ):
            numbers[key["place"]].append((key.get("value"), number))
        return numbers

    def _grouped(
        self,
        questions: Sequence[tuple[str, Mapping[str, object]]],
        key: Callable[[int], object],
    ) -> Iterator[tuple[Any, int]]:
        """Numbers of documents by a key, which may differ between questions."""
        for first, part in _batched(questions):
            pipelines = []
            for place, (collection, query) in enumerate(part, first):
                count: Document = {"$group": {"_id": key(place), "n": {"$sum": 1}}}
                pipelines.append((collection, [{"$match": dict(query)}, _IN_ORDER, count]))
            collection, pipeline = _union(pipelines)
            for found in self.aggregate(collection, pipeline):
                yield found["_id"], int(found["n"])

    def find_each(
        self,
        questions: Sequence[tuple[str, Mapping[str, object]]],
        projection: Mapping[str, object] | None = None,
    ) -> Iterator[bytes]:
        """Find the documents of many questions, one after the other, as in `find_raw`.

        Args:
            questions: Collection and filter of each, the latter with a range of `_id`. The
                documents that about a hundred of them find must fit into memory.
            projection: MongoDB's projection document; names the fields to return.
        """
        shape = [] if projection is None else [{"$project": dict(projection)}]
        for _, part in _batched(questions):
            if len(part) == 1:  # one command; a pipeline takes two
                yield from self.find_raw(*part[0], projection, sort=[("_id", 1)])
                continue
            parts = [(where, [{"$match": dict(query)}, _IN_ORDER, *shape]) for where, query in part]
            collection, pipeline = _union(parts)
            of = self._collection(collection)

            def ask(of: Any = of, pipeline: list[Document] = pipeline) -> list[bytes]:
                found = of.aggregate_raw_batches(pipeline, batchSize=1 << 30, allowDiskUse=True)
                with _closing(found) as cursor:
                    return [*cursor]

            yield from self._again(ask, question=True)

    def aggregate(
        self,
        collection: str,
        pipeline: Sequence[Mapping[str, object]],
    ) -> Iterator[Document]:
        """Run an aggregation pipeline that only reads.

        Args:
            collection: The collection; one that does not exist is empty.
            pipeline: The stages.
        """
        of = self._collection(collection)
        stages = [dict(stage) for stage in pipeline]
        yield from self._found(lambda _: of.aggregate(stages, allowDiskUse=True), {}, 0, dict)

    def replace(
        self,
        collection: str,
        filter: Mapping[str, object],  # noqa: A002
        document: Mapping[str, object],
        *,
        upsert: bool = True,
    ) -> None:
        """Replace the first matching document, or insert it if none matches."""
        of = self._collection(collection)
        self._again(lambda: of.replace_one(dict(filter), dict(document), upsert=upsert))

    def update(
        self,
        collection: str,
        filter: Mapping[str, object],  # noqa: A002
        change: Mapping[str, object],
        *,
        upsert: bool = False,
    ) -> int:
        """Apply update operators to every matching document; return their number.

        Args:
            collection: The collection.
            filter: MongoDB's filter document.
            change: The operators. They may be applied twice, so what they count is only a sign
                that something has changed.
            upsert: Whether to insert a document if none matches.
        """
        of = self._collection(collection)
        result = self._again(lambda: of.update_many(dict(filter), dict(change), upsert=upsert))
        return result.matched_count

    def delete(self, collection: str, filter: Mapping[str, object]) -> int:  # noqa: A002
        """Delete every matching document; return their number. `{}` deletes all."""
        of = self._collection(collection)
        return self._again(lambda: of.delete_many(dict(filter))).deleted_count

    def checkpoint(self) -> None:
        """Have the server write what is only in its journal, which it then shortens.

        A server that refuses it, such as a shared one with users, does it by itself in time.
        """
        from pymongo.errors import OperationFailure

        def ask() -> None:
            with contextlib.suppress(OperationFailure):
                self._client.admin.command("fsync")

        self._again(ask)

    def drop(self, collection: str) -> None:
        """Remove a collection if it exists."""
        self._again(self._collection(collection).drop)

    def drop_all(self) -> None:
        """Remove the whole database."""
        self._again(lambda: self._client.drop_database(self._database.name))

    def list_collections(self) -> list[str]:
        """Names of all collections, sorted, without MongoDB's own."""
        names = self._again(self._database.list_collection_names)
        return sorted(name for name in names if not name.startswith("system."))

    def create_index(self, collection: str, keys: Sort) -> None:
        """Create an index on fields unless it exists."""
        of = self._collection(collection)
        self._again(lambda: of.create_index(list(keys)))

    def indexes(self, collection: str) -> list[tuple[tuple[str, int], ...]]:
        """Fields of all indexes but the one on `_id`, each with 1 or -1, sorted."""
        of = self._collection(collection)
        found = [
            tuple((str(field), int(order)) for field, order in about["key"].items())
            for about in self._again(lambda: list(of.list_indexes()))
        ]
        return sorted(keys for keys in found if [field for field, _ in keys] != ["_id"])

    def drop_index(self, collection: str, keys: Sort) -> bool:
        """Drop the index with these keys; return whether it existed."""
        if tuple(keys) not in self.indexes(collection):
            return False
        of = self._collection(collection)
        self._again(lambda: of.drop_index(list(keys)))
        return True

    def stats(self, collection: str) -> CollectionStats:
        """Size of a collection."""
        from pymongo.errors import OperationFailure

        pipeline: list[Document] = [{"$collStats": {"storageStats": {}}}]
        of = self._collection(collection)

        def ask() -> Document:
            try:
                return next(iter(of.aggregate(pipeline)), {})
            except OperationFailure as error:
                if error.code != 26:  # NamespaceNotFound
                    raise
                return {}

        found = self._again(ask)
        about = found.get("storageStats", {})
        return CollectionStats(
            documents=int(about.get("count", 0)),
            storage_bytes=int(about.get("storageSize", 0)),
            index_bytes=int(about.get("totalIndexSize", 0)),
        )

    def _collection(self, name: str, read: ReadConcern = "local") -> Collection[Document]:
        from pymongo.read_concern import ReadConcern as PymongoReadConcern

        if read == "local" or not self._is_replicated:
            return self._database[name]
        return self._database.get_collection(name, read_concern=PymongoReadConcern(read))


_IN_ORDER: Document = {"$sort": {"_id": 1}}
"""Lets MongoDB consider a range of `_id` for a pipeline: with another matching index, it does
so only if that saves sorting."""


def _batched(
    questions: Sequence[tuple[str, Mapping[str, object]]],
) -> Iterator[tuple[int, Sequence[tuple[str, Mapping[str, object]]]]]:
    """Groups of questions that fit into one command, with the number of the first.

    Pipelines are joined, since MongoDB reads a whole clustered collection for `$or` of ranges.
    """
    from bson import encode

    if not questions:
        return
    with _mapped("MongoDB", question=True):
        size = max(len(encode(query)) for _, query in questions)
    step = max(1, min(_MAX_QUESTIONS_PER_COMMAND, _MAX_COMMAND_BYTES // size))
    for first in range(0, len(questions), step):
        yield first, questions[first : first + step]


def _union(parts: Sequence[tuple[str, list[Document]]]) -> tuple[str, list[Document]]:
    """One pipeline with the results of several, one after the other."""
    collection, pipeline = parts[0]
    others = [{"$unionWith": {"coll": where, "pipeline": stages}} for where, stages in parts[1:]]
    return collection, [*pipeline, *others]


def _is_replicated(client: MongoClient[Document]) -> bool:
    """True for a replica set, a member of one, and a sharded cluster, once it has answered."""
    about = client.topology_description
    members = about.server_descriptions().values()
    return about.topology_type_name == "Sharded" or any(m.replica_set_name for m in members)


def _write_concern(client: MongoClient[Document], *, is_replicated: bool) -> WriteConcern:
    """The URI's, but with a majority of a replica set's members, and not waiting for ever."""
    from pymongo.write_concern import WriteConcern

    given: Document = client.write_concern.document
    if not is_replicated:
        return WriteConcern(**given)
    number = given.get("w", 1)
    wanted = "majority" if isinstance(number, int) else number  # a name is one of the server's
    return WriteConcern(**{"wtimeout": int(_REPLICATION_S * 1000), **given, "w": wanted})


def _broken() -> tuple[type[Exception], ...]:
    """Errors after which a command is sent again: the connection or the cursor is gone."""
    from pymongo.errors import AutoReconnect, CursorNotFound

    return AutoReconnect, CursorNotFound


def _retried(
    client: MongoClient[Document],
    address: str,
    command: Callable[[], _T],
    *,
    question: bool = False,
) -> _T:
    """Run a command that may be repeated, again if its connection breaks."""
    with _mapped(address, question=question):
        for _ in range(_TRIES - 1):
            try:
                return command()
            except _broken() as error:
                _wait(client, error)
        return command()


def _wait(client: MongoClient[Document], error: Exception) -> None:
    """Wait until the server answers again after an error.

    Raises:
        PyMongoError: It does not: the error. A replica set is given the time of an election, by
            the next command.
    """
    from pymongo import timeout
    from pymongo.errors import PyMongoError, ServerSelectionTimeoutError

    if isinstance(error, ServerSelectionTimeoutError):
        raise error  # after all the time that there is
    if client.topology_description.topology_type_name.startswith("ReplicaSet"):
        return
    try:
        with timeout(_GONE_S):
            client.admin.command("ping")
    except PyMongoError:
        raise error from None


@contextlib.contextmanager
def _closing(cursor: Any) -> Iterator[Any]:
    """Close a cursor; its server may have ended, which closing would wait for."""
    from pymongo import timeout

    try:
        yield cursor
    finally:
        with timeout(_GONE_S):
            cursor.close()


def _key_order(sort: Sort | None) -> int:
    """1 or -1 if documents come in the order of `_id`, or the other way round; else 0."""
    (first, order), *more = sort or [("_id", 1)]
    return order if first == "_id" and not more else 0


def _last_key(documents: bytes) -> object:
    """The `_id` of the last of several documents."""
    from bson import decode

    position, length = 0, 0
    while position < len(documents):
        (length,) = struct.unpack_from("<i", documents, position)
        position += length
    return decode(documents[position - length :])["_id"]


def without_secrets(uri: str) -> str:
    """A connection string without secrets: scheme, hosts and database only."""
    scheme, found, rest = uri.partition("://")
    if not found:
        return "the given URI"
    # From the last @, since an unencoded password may contain any character.
    return f"{scheme}://{rest.rpartition('@')[2].partition('?')[0]}"


def shut_down(uri: str) -> None:
    """Ask the server to end; ignore errors."""
    from pymongo import MongoClient
    from pymongo.errors import PyMongoError

    with contextlib.suppress(PyMongoError):
        client: MongoClient[Document] = MongoClient(uri, serverSelectionTimeoutMS=2000)
        with client:
            client.admin.command("shutdown")


def _document_ends(
    documents: memoryview, count: int, lengths: NDArray[np.int64] | None
) -> NDArray[np.int64]:
    """Start and end of each document: int64[count + 1], byte offsets.

    Raises:
        ValueError: The lengths do not add up, or differ from those in the documents.
    """
    ends = np.zeros(count + 1, dtype=np.int64)
    if lengths is None:
        _walk(documents, ends)
    else:
        if len(lengths) != count:
            raise ValueError(f"{len(lengths)} lengths were given for {count} documents")
        np.cumsum(lengths, out=ends[1:])
    if ends[-1] != len(documents) or ends.max() > len(documents):
        raise ValueError(f"{count} documents end at byte {ends[-1]} of {len(documents)}")
    if count and np.diff(ends).min() < 5:
        raise ValueError("a document has a length below 5 bytes")
    content = np.frombuffer(documents, dtype=np.uint8)
    if lengths is not None:
        stated = content[ends[:-1, None] + np.arange(4)].view("<i4")[:, 0]
        if not np.array_equal(stated, lengths):
            raise ValueError("the lengths given are not those in the documents")
    if content[ends[1:] - 1].any():
        raise ValueError("a document does not end with a zero byte")
    if count and np.diff(ends).max() > BATCH_BYTES:
        raise DatabaseError(
            f"A document of {np.diff(ends).max()} bytes is larger than MongoDB allows "
            f"({BATCH_BYTES} bytes)."
        )
    return ends


def _walk(documents: memoryview, ends: NDArray[np.int64]) -> None:
    length = struct.Struct("<i").unpack_from
    size = len(documents)
    position = 0
    for row in range(1, len(ends)):
        if position + 5 > size:
            raise ValueError(f"{len(ends) - 1} documents are stated, {row - 1} are there")
        step = length(documents, position)[0]
        if not 5 <= step <= size - position:
            raise ValueError(f"document {row - 1} has an impossible length, {step} bytes")
        position += step
        ends[row] = position


def _batches(ends: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Half-open ranges of documents, each within the limits of one command."""
    first, count = 0, len(ends) - 1
    while first < count:
        fit = int(np.searchsorted(ends, ends[first] + BATCH_BYTES, side="right")) - 1
        last = min(fit, first + BATCH_DOCUMENTS)
        yield first, last
        first = last


def _pass_through(documents: bytes) -> Mapping[str, Any]:
    return _pass_through_type()(documents)


@functools.cache
def _pass_through_type() -> Callable[[bytes], Mapping[str, Any]]:
    """A type of "document" that pymongo copies into the message as it is.

    An insert sends documents in an OP_MSG document sequence, without separators and
    without a count. So any number of documents can be passed as one.
    """
    from bson.raw_bson import RawBSONDocument

    class Documents(RawBSONDocument):
        __slots__ = ("_documents",)

        def __init__(self, documents: bytes) -> None:
            # Not super().__init__, which requires exactly one document.
            self._documents = documents

        @property
        def raw(self) -> bytes:
            return self._documents

        # The driver's logs and monitors read commands as mappings. They see an empty
        # document here.
        def __getitem__(self, key: str) -> Any:
            raise KeyError(key)

        def __iter__(self) -> Iterator[str]:
            return iter(())

        def __len__(self) -> int:
            return 0

        def items(self) -> Any:
            return {}.items()

        def __repr__(self) -> str:
            return f"<{len(self._documents)} bytes of documents>"

    return Documents


@contextlib.contextmanager
def _mapped(address: str, *, question: bool = False) -> Iterator[None]:
    """Map errors of pymongo and bson.

    Args:
        address: The server, for the message.
        question: The command contains the caller's filter, so some errors mean that the
        filter is invalid.
    """
    from bson.errors import BSONError
    from pymongo.errors import (
        ConnectionFailure,
        DocumentTooLarge,
        ExecutionTimeout,
        InvalidOperation,
        OperationFailure,
        PyMongoError,
        ServerSelectionTimeoutError,
    )

    try:
        yield
    except ExecutionTimeout as error:
        raise DatabaseError(
            f"MongoDB at {address} exceeded the time allowed for the question; allow more time, "
            f"or ask for less."
        ) from error
    except OperationFailure as error:
        code = error.code or 0
        text = _server_words(error.details) or str(error)
        if question and _is_wrong_question(code, error.details):
            raise WhereError(f"MongoDB does not understand the predicate: {text}") from error
        raise _refused(address, code, text) from error
    except InvalidOperation as error:  # another thread has closed the client
        raise ConnectionLostError(f"MongoDB at {address}: {_first_words(error)}") from error
    except ConnectionFailure as error:
        is_down = isinstance(error, ServerSelectionTimeoutError)
        kind = ConnectionLostError if is_down else ConnectionBrokenError
        raise kind(_unreachable(address, _first_words(error))) from error
    except (DocumentTooLarge, BSONError, OverflowError, RecursionError, UnicodeError) as error:
        if question:
            raise WhereError(f"The predicate cannot be sent to MongoDB: {error}") from error
        raise DatabaseError(
            f"A document cannot be sent to or read from MongoDB: {error}"
        ) from error
    except PyMongoError as error:
        cure = f". {LOGIN_CURE}" if "password is required" in str(error) else ""
        raise DatabaseError(f"MongoDB at {address}: {_first_words(error)}{cure}") from error


def _unusable_file(address: str, error: OSError) -> UsageError:
    named = error.filename or "A file with certificates"
    return UsageError(
        f"{named}, which the URI of {address} names, cannot be used: {error.strerror}."
    )


def _unreachable(address: str, text: str) -> str:
    """The reason why no connection can be made or kept, with its cure."""
    if "CERTIFICATE_VERIFY_FAILED" in text:
        reason = text.rpartition("certificate verify failed: ")[2].partition(" (_ssl")[0]
        return (
            f"MongoDB at {address} cannot be trusted: {reason}. Name the certificate of the "
            "authority that signed its own in the URI: tlsCAFile=FILE."
        )
    if "SSL handshake failed" in text or "[SSL" in text:
        return (
            f"MongoDB at {address} does not answer with TLS. If it has none, leave tls=true out "
            "of the URI."
        )
    is_closed = "connection closed" in text or "reset by peer" in text
    tls = "; if it wants TLS, write tls=true into the URI" if is_closed else ""
    return (
        f"MongoDB at {address} does not answer: {text}. Check that it runs and can be reached{tls}."
    )


def _refused(address: str, code: int, text: str) -> DatabaseError | DiskFullError:
    if code in _DISK_FULL or "No space left on device" in text:
        return DiskFullError(f"MongoDB at {address} has no space left: {text}")
    cure = f" {LOGIN_CURE}" if code == _LOGIN_FAILED else ""
    if code == _UNAUTHORIZED and "requires authentication" in text:
        cure = f": name a user in the URI, mongodb://USER@host/NAME. {LOGIN_CURE}"
    elif code == _UNAUTHORIZED:
        text = text.partition(" to execute command")[0]
        cure = ": the user needs the role readWrite on this database, or read to ask only."
    return DatabaseError(f"MongoDB at {address} refuses (error {code}): {text}{cure}")


def _is_wrong_question(code: int, details: Mapping[str, Any] | None) -> bool:
    name = str((details or {}).get("codeName", ""))
    return code in _WRONG_QUESTION or name.startswith(_UNNAMED_CODE)


def _server_words(details: Mapping[str, Any] | None) -> str:
    """The server's message; pymongo's own adds the whole reply."""
    return str(details.get("errmsg", "")) if details else ""


def _first_words(error: BaseException) -> str:
    """The driver's message without the description of the topology that it appends."""
    return str(error).partition(", Timeout: ")[0].partition(" (configured timeouts")[0]
