"""Access to MongoDB: raw BSON in and out, and driver errors mapped to hybridlog errors.

The only module that uses pymongo. Documents made by hybridlog are transferred as bytes in
both directions, thousands at a time, and never become Python objects. pymongo is imported
on first use, since its import takes longer than most commands.
"""

from __future__ import annotations

import contextlib
import functools
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hybridlog_storage.errors import DatabaseError, DiskFullError, UsageError, WhereError
from hybridlog_storage.settings import LOGIN_CURE

if TYPE_CHECKING:
    from types import TracebackType

    from numpy.typing import NDArray
    from pymongo import MongoClient
    from pymongo.collection import Collection
    from pymongo.database import Database as PymongoDatabase

    from hybridlog_storage.messages import Buffer

Document = dict[str, Any]
"""A decoded document with values of the `bson` package."""
Sort = Sequence[tuple[str, int]]
"""Field paths with 1 (ascending) or -1 (descending)."""

BATCH_BYTES = 16 << 20
"""Most bytes of documents in one insert command; a single document may have as many."""
BATCH_DOCUMENTS = 5000
"""Most documents in one insert command; more make the server slower, not faster."""
OLDEST_SERVER = (5, 3)
"""The first MongoDB with clustered collections."""

_MOST_TOGETHER = 100
"""Most questions in one command."""
_BYTES_TOGETHER = 4 << 20

_GONE_S = 1.0  # seconds without an answer after which the server counts as ended
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
_WRITING_STAGES = frozenset({"$out", "$merge"})
_LOGIN_FAILED = 18
_RESERVED_NAMES = frozenset({"admin", "local", "config"})


@dataclass(frozen=True, slots=True)
class CollectionStats:
    """Size of a collection; all zero if it does not exist.

    Attributes:
        documents: Number of documents.
        document_bytes: Their BSON size in bytes, uncompressed.
        storage_bytes: Bytes on disk.
        index_bytes: Bytes of the indexes on disk; a clustered collection needs none.
    """

    documents: int
    document_bytes: int
    storage_bytes: int
    index_bytes: int


class Database:
    """One MongoDB database, opened by `connect`. A context manager; thread safe.

    Every method raises `DatabaseError` if the server does not answer or refuses. Methods
    with a `filter` or a pipeline raise `WhereError` if that is invalid. `max_time_ms`
    limits the time of a read on the server.
    """

    def __init__(self, client: MongoClient[Document], name: str, address: str) -> None:
        self._client = client
        self._database: PymongoDatabase[Document] = client[name]
        self._address = address

    @classmethod
    def connect(cls, uri: str, name: str = "hybridlog", *, timeout_s: float = 5.0) -> Self:
        """Connect and check that the server answers and is new enough.

        Args:
            uri: MongoDB connection string. A database named in it wins over `name`, a
                `serverSelectionTimeoutMS` in it over `timeout_s`.
            name: Database to use; it need not exist.
            timeout_s: Seconds to wait for the server, now and in every later operation.

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
        options: dict[str, object] = {"appname": "hybridlog"}
        if "serverselectiontimeoutms" not in given:
            options["serverSelectionTimeoutMS"] = int(timeout_s * 1000)
        if "connecttimeoutms" not in given:
            options["connectTimeoutMS"] = int(timeout_s * 1000)
        with _mapped(address):
            client: MongoClient[Document] = MongoClient(uri, **options)  # type: ignore[arg-type]
        try:
            if not client.write_concern.acknowledged:
                raise UsageError(f"{address}: w=0 would lose errors; leave it out.")
            with _mapped(address):
                version = client.server_info()
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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

    def ensure_collection(self, name: str) -> None:
        """Create a clustered collection (`_id` is its only key) unless it exists."""
        from pymongo.errors import OperationFailure

        with _mapped(self._address):
            try:
                self._database.create_collection(
                    name,
                    check_exists=False,
                    clusteredIndex={"key": {"_id": 1}, "unique": True},
                )
            except OperationFailure as error:
                if error.code != _NAMESPACE_EXISTS:
                    raise

    def insert_raw(
        self,
        collection: str,
        documents: Buffer,
        count: int,
        *,
        lengths: NDArray[np.int64] | None = None,
        journal: bool = False,
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
            journal: Return only when the documents are in the journal on disk (and, in a
                replica set, with the majority).

        Returns:
            Number of new documents.

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
            inserted += self._insert_batch(collection, bytes(part), journal=journal)
        return inserted

    def _insert_batch(self, collection: str, documents: bytes, *, journal: bool) -> int:
        if not collection or "$" in collection or "\0" in collection:
            raise DatabaseError(f"{collection!r} cannot be the name of a collection.")
        command: Document = {
            "insert": collection,
            "documents": [_pass_through(documents)],
            "ordered": False,
        }
        if journal:
            command["writeConcern"] = {"w": "majority", "j": True}
        elif not self._client.write_concern.is_server_default:
            command["writeConcern"] = self._client.write_concern.document
        with _mapped(self._address):
            reply = self._database.command(command)
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
        limit: int = 0,
        batch_size: int = 0,
        max_time_ms: int | None = None,
    ) -> Iterator[bytes]:
        """Find documents as bytes: each item is several concatenated BSON documents.

        Args:
            collection: The collection; one that does not exist is empty.
            filter: MongoDB's filter document.
            projection: MongoDB's projection document.
            sort: Order; None for the order of the collection, which is that of `_id`.
            limit: Most documents; 0 for all.
            batch_size: Documents in one item; 0 for as many as fit 16 MiB.
            max_time_ms: Most milliseconds on the server.
        """
        with _mapped(self._address, question=True):
            cursor = self._collection(collection).find_raw_batches(
                dict(filter or {}),
                None if projection is None else dict(projection),
                sort=sort or None,
                limit=limit,
                # By default the server's first batch has 101 documents.
                batch_size=batch_size or (1 << 30),
                max_time_ms=max_time_ms,
            )
            with cursor:
                yield from cursor

    def find(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002
        projection: Mapping[str, object] | None = None,
        *,
        sort: Sort | None = None,
        limit: int = 0,
        batch_size: int = 0,
        max_time_ms: int | None = None,
    ) -> Iterator[Document]:
        """Find documents one by one; for small answers. Arguments as in `find_raw`."""
        with _mapped(self._address, question=True):
            cursor = self._collection(collection).find(
                dict(filter or {}),
                None if projection is None else dict(projection),
                sort=sort or None,
                limit=limit,
                batch_size=batch_size,
                max_time_ms=max_time_ms,
            )
            with cursor:
                yield from cursor

    def find_one(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002
        projection: Mapping[str, object] | None = None,
        *,
        sort: Sort | None = None,
        max_time_ms: int | None = None,
    ) -> Document | None:
        """Find the first document, None if no document matches. Arguments as in `find_raw`."""
        found = self.find(
            collection, filter, projection, sort=sort, limit=1, max_time_ms=max_time_ms
        )
        return next(found, None)

    def count(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002
        *,
        by_key: bool = False,
        max_time_ms: int | None = None,
    ) -> int:
        """Number of documents that match.

        Without a filter this is the collection's own count. It costs nothing, but is an
        estimate after a server was killed.

        Args:
            collection: The collection; one that does not exist is empty.
            filter: MongoDB's filter document.
            by_key: Find documents by `_id`, whatever other indexes exist. The collection
            must exist.
            max_time_ms: Most milliseconds on the server.
        """
        with _mapped(self._address, question=True):
            where = self._collection(collection)
            options: dict[str, Any] = {} if max_time_ms is None else {"maxTimeMS": max_time_ms}
            if not filter:
                return where.estimated_document_count(**options)
            if by_key:
                options["hint"] = {"_id": 1}
            return self._count(where, dict(filter), options)

    def _count(self, where: Collection[Document], query: Document, options: Document) -> int:
        """Count with the command `count` where that is exact: it costs less than a pipeline."""
        from pymongo.errors import AutoReconnect, ServerSelectionTimeoutError

        # A sharded cluster would count documents twice while it moves them.
        if not self._client.is_mongos:
            try:
                reply = self._database.command(
                    "count",
                    where.name,
                    query=query,
                    read_preference=where.read_preference,
                    **options,
                )
                return int(reply["n"])
            except ServerSelectionTimeoutError:
                raise
            except AutoReconnect:
                pass  # the driver retries pipelines, but not commands
        return where.count_documents(query, **options)

    def count_each(
        self, questions: Sequence[tuple[str, Mapping[str, object]]], *, most: int = 0
    ) -> list[int]:
        """Count the documents that match each of many questions, in few round trips.

        Meant for questions with a range of `_id`: MongoDB tries for each whether that range
        or another index is faster.

        Args:
            questions: Collection and filter of each.
            most: Count at most this many; 0 for no limit.
        """
        numbers = [0] * len(questions)
        for first, part in _together(questions):
            pipelines = []
            for place, (collection, query) in enumerate(part, first):
                count: Document = {"$group": {"_id": {"$literal": place}, "n": {"$sum": 1}}}
                limit: list[Document] = [{"$limit": most}] if most else []
                pipelines.append((collection, [{"$match": dict(query)}, _IN_ORDER, *limit, count]))
            collection, pipeline = _union(pipelines)
            for found in self.aggregate(collection, pipeline):
                numbers[found["_id"]] = int(found["n"])
        return numbers

    def find_each(
        self,
        collection: str,
        filters: Sequence[Mapping[str, object]],
        projection: Mapping[str, object] | None = None,
        *,
        order: int = 1,
        batch_size: int = 0,
    ) -> Iterator[bytes]:
        """Find the documents of many questions, one after the other, as in `find_raw`.

        Args:
            collection: The collection.
            filters: The questions, each with a range of `_id`.
            projection: MongoDB's projection document; names the fields to return.
            order: Order of `_id` within each answer: 1, or -1 for descending.
            batch_size: Documents in one item; 0 for as many as fit 16 MiB.
        """
        shape: list[Document] = [] if projection is None else [{"$project": dict(projection)}]
        sort: Document = {"$sort": {"_id": order}}
        for _, part in _together([(collection, query) for query in filters]):
            parts = [(where, [{"$match": dict(query)}, sort, *shape]) for where, query in part]
            with _mapped(self._address, question=True):
                cursor = self._collection(collection).aggregate_raw_batches(
                    _union(parts)[1], batchSize=batch_size or (1 << 30), allowDiskUse=True
                )
                with cursor:
                    yield from cursor

    def aggregate(
        self,
        collection: str,
        pipeline: Sequence[Mapping[str, object]],
        *,
        max_time_ms: int | None = None,
    ) -> Iterator[Document]:
        """Run an aggregation pipeline that only reads."""
        for stage in pipeline:
            if not _WRITING_STAGES.isdisjoint(stage):
                raise WhereError(f"A pipeline may only read: {', '.join(stage)} is not allowed.")
        with _mapped(self._address, question=True):
            options: dict[str, Any] = {"allowDiskUse": True}
            if max_time_ms is not None:
                options["maxTimeMS"] = max_time_ms
            stages = [dict(stage) for stage in pipeline]
            with self._collection(collection).aggregate(stages, **options) as cursor:
                yield from cursor

    def replace(
        self,
        collection: str,
        filter: Mapping[str, object],  # noqa: A002
        document: Mapping[str, object],
        *,
        upsert: bool = True,
    ) -> None:
        """Replace the first matching document, or insert it if none matches."""
        with _mapped(self._address):
            self._collection(collection).replace_one(dict(filter), dict(document), upsert=upsert)

    def replace_all(self, collection: str, documents: Sequence[Mapping[str, object]]) -> None:
        """Replace or insert each document by its `_id`."""
        from pymongo import ReplaceOne

        if documents:
            with _mapped(self._address):
                self._collection(collection).bulk_write(
                    [ReplaceOne({"_id": d["_id"]}, dict(d), upsert=True) for d in documents],
                    ordered=False,
                )

    def update(
        self,
        collection: str,
        filter: Mapping[str, object],  # noqa: A002
        change: Mapping[str, object],
        *,
        upsert: bool = False,
    ) -> int:
        """Apply update operators to every matching document; return their number."""
        with _mapped(self._address):
            result = self._collection(collection).update_many(
                dict(filter), dict(change), upsert=upsert
            )
            return result.matched_count

    def delete(self, collection: str, filter: Mapping[str, object]) -> int:  # noqa: A002
        """Delete every matching document; return their number. `{}` deletes all."""
        with _mapped(self._address):
            return self._collection(collection).delete_many(dict(filter)).deleted_count

    def drop(self, collection: str) -> None:
        """Remove a collection if it exists."""
        with _mapped(self._address):
            self._collection(collection).drop()

    def drop_all(self) -> None:
        """Remove the whole database."""
        with _mapped(self._address):
            self._client.drop_database(self._database.name)

    def list_collections(self) -> list[str]:
        """Names of all collections, sorted, without MongoDB's own."""
        with _mapped(self._address):
            names = self._database.list_collection_names()
        return sorted(name for name in names if not name.startswith("system."))

    def create_index(
        self,
        collection: str,
        keys: Sort,
        *,
        unique: bool = False,
        sparse: bool = False,
    ) -> str:
        """Create an index unless it exists; return its name."""
        with _mapped(self._address):
            options: dict[str, Any] = {"sparse": True} if sparse else {}
            return self._collection(collection).create_index(list(keys), unique=unique, **options)

    def indexes(self, collection: str) -> list[list[tuple[str, int]]]:
        """The keys of all indexes but the one on `_id`, sorted."""
        with _mapped(self._address):
            found = [about["key"].items() for about in self._collection(collection).list_indexes()]
        keys = [[(str(field), int(order)) for field, order in key] for key in found]
        return sorted(key for key in keys if [field for field, _ in key] != ["_id"])

    def drop_index(self, collection: str, keys: Sort) -> bool:
        """Drop the index with these keys; return whether it existed."""
        if list(keys) not in self.indexes(collection):
            return False
        with _mapped(self._address):
            self._collection(collection).drop_index(list(keys))
        return True

    def stats(self, collection: str) -> CollectionStats:
        """Size of a collection."""
        from pymongo.errors import OperationFailure

        pipeline: list[Document] = [{"$collStats": {"storageStats": {}}}]
        with _mapped(self._address):
            try:
                found = next(iter(self._collection(collection).aggregate(pipeline)), {})
            except OperationFailure as error:
                if error.code != 26:  # NamespaceNotFound
                    raise
                found = {}
        about = found.get("storageStats", {})
        return CollectionStats(
            documents=int(about.get("count", 0)),
            document_bytes=int(about.get("size", 0)),
            storage_bytes=int(about.get("storageSize", 0)),
            index_bytes=int(about.get("totalIndexSize", 0)),
        )

    def _collection(self, name: str) -> Collection[Document]:
        return self._database[name]


_IN_ORDER: Document = {"$sort": {"_id": 1}}
"""Lets MongoDB consider a range of `_id` for a pipeline: with another matching index, it does
so only if that saves sorting."""


def _together(
    questions: Sequence[tuple[str, Mapping[str, object]]],
) -> Iterator[tuple[int, Sequence[tuple[str, Mapping[str, object]]]]]:
    """Groups of questions that fit into one command, with the number of the first."""
    from bson import encode

    if not questions:
        return
    with _mapped("MongoDB", question=True):
        size = max(len(encode(query)) for _, query in questions)
    step = max(1, min(_MOST_TOGETHER, _BYTES_TOGETHER // size))
    for first in range(0, len(questions), step):
        yield first, questions[first : first + step]


def _union(parts: Sequence[tuple[str, list[Document]]]) -> tuple[str, list[Document]]:
    """One pipeline with the results of several, one after the other."""
    collection, pipeline = parts[0]
    others = [{"$unionWith": {"coll": where, "pipeline": stages}} for where, stages in parts[1:]]
    return collection, [*pipeline, *others]


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
        OperationFailure,
        PyMongoError,
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
    except ConnectionFailure as error:
        raise DatabaseError(
            f"MongoDB at {address} does not answer: {_first_words(error)}. Check that it runs and "
            f"can be reached."
        ) from error
    except (DocumentTooLarge, BSONError, OverflowError, RecursionError, UnicodeError) as error:
        if question:
            raise WhereError(f"The predicate cannot be sent to MongoDB: {error}") from error
        raise DatabaseError(
            f"A document cannot be sent to or read from MongoDB: {error}"
        ) from error
    except PyMongoError as error:
        cure = f". {LOGIN_CURE}" if "password is required" in str(error) else ""
        raise DatabaseError(f"MongoDB at {address}: {_first_words(error)}{cure}") from error


def _refused(address: str, code: int, text: str) -> DatabaseError | DiskFullError:
    if code in _DISK_FULL or "No space left on device" in text:
        return DiskFullError(f"MongoDB at {address} has no space left: {text}")
    cure = f" {LOGIN_CURE}" if code == _LOGIN_FAILED else ""
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
