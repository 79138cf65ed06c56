"""Access to MongoDB: raw BSON in and out, and driver errors mapped to hybridlog errors.

The only module that uses pymongo. Documents made by hybridlog are transferred as bytes in
both directions, thousands at a time, and are never decoded. pymongo is imported
on first use, since its import takes longer than most commands.

Every command may be repeated: documents are inserted under their own `_id`, and other
changes have the same result twice. So a command is sent again when its connection breaks.
Writes are acknowledged by a majority of a replica set's members, and reads see only what such
a majority has, whatever the URI says: what was read outlives the loss of the primary.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Self, TypeVar

from hybridlog_storage.errors import (
    ConnectionLostError,
    DatabaseError,
    DiskFullError,
    HybridlogError,
    UsageError,
    WhereError,
)
from hybridlog_storage.settings import LOGIN_CURE

if TYPE_CHECKING:
    from bson.raw_bson import RawBSONDocument
    from pymongo import MongoClient
    from pymongo.database import Database as PymongoDatabase


Document = dict[str, Any]
"""A decoded document with values of the `bson` package."""
_T = TypeVar("_T")

BATCH_DOCUMENTS = 5000
"""Most documents in one insert command; more make the server slower, not faster."""

_MAX_QUESTIONS_PER_COMMAND = 100
_MAX_COMMAND_BYTES = 4 << 20
_GONE_S = 1.0  # seconds without an answer after which the server counts as ended
_TRIES = 3  # for a command whose connection breaks
_ELECTION_S = 20.0  # seconds for a replica set to elect a primary; it takes about 12
_REPLICATION_S = 60.0  # seconds for a majority of its members to take over a write
_DUPLICATE_KEY = 11000
_NAMESPACE_EXISTS = 48
_DISK_FULL = 14031
_NO_ROLE = 13
_NOT_ALLOWED = frozenset({_NO_ROLE, 18})  # unauthorized, or no login
_RESERVED_NAMES = frozenset({"admin", "local", "config"})


class Database:
    """One MongoDB database, opened by `connect`. A context manager; thread safe.

    Every method raises `DatabaseError` if the server does not answer or refuses. Methods with a
    `filter` or a pipeline raise `WhereError` if that is invalid. `is_lost` is True after a method
    found no connection; make a new `Database` then. `address` is the URI without user, password
    and options, for messages.
    """

    def __init__(self, client: MongoClient[Document], name: str, address: str) -> None:
        self.is_lost = False
        self._client = client
        self._database: PymongoDatabase[Document] = client[name]
        self.name, self.address = name, address

    @classmethod
    def connect(cls, uri: str, *, timeout_s: float = 5.0) -> Self:
        """Connect and check that the server answers.

        `timeout_s` is the wait for the server, now and in every later operation; 20 seconds more
        for a replica set, which may elect a primary. The URI may name the database, and a
        `serverSelectionTimeoutMS` in it wins. One that is not allowed raises `UsageError`.
        """
        from pymongo import MongoClient
        from pymongo.errors import InvalidURI, PyMongoError
        from pymongo.uri_parser import parse_uri

        address = without_secrets(uri)
        try:
            parsed = parse_uri(uri, warn=False)
            name = ".".join(filter(None, (parsed["database"] or "hybridlog", parsed["collection"])))
            if name in _RESERVED_NAMES or not re.fullmatch(r"[A-Za-z0-9_-]{1,38}", name):
                raise UsageError(
                    f"{name!r} cannot be the name of hybridlog's database: use up to 38 letters, "
                    f"digits, - and _, and none of {', '.join(sorted(_RESERVED_NAMES))}."
                )
            with _mapped(address):
                client: MongoClient[Document] = MongoClient(uri, **_options(parsed, timeout_s))  # type: ignore[arg-type]
        except (InvalidURI, ValueError, TypeError) as error:
            # Without the original text: pymongo quotes options, which may be secret.
            raise UsageError(
                f"{address} is not a MongoDB connection string ({type(error).__name__}). Write "
                f"mongodb://host:port/, and percent-encode user name, password and socket path."
            ) from None
        except OSError as error:  # of a file with certificates
            raise UsageError(
                f"{error.filename}, which the URI of {address} names, cannot be used: "
                f"{error.strerror}."
            ) from error
        except PyMongoError as error:  # an SRV record that cannot be resolved
            raise DatabaseError(f"MongoDB at {address} cannot be found: {error}") from error
        self = cls(client, name, address)
        try:
            self.run(lambda _: client.server_info())
        except BaseException:
            client.close()
            raise
        return self

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

    def run(
        self, command: Callable[[PymongoDatabase[Document]], _T], *, question: bool = False
    ) -> _T:
        """Run a command on the database as pymongo has it, again if its connection breaks."""
        from pymongo.errors import AutoReconnect, CursorNotFound, ServerSelectionTimeoutError

        left = _TRIES
        try:
            with _mapped(self.address, question=question):
                while True:
                    try:
                        return command(self._database)
                    except (AutoReconnect, CursorNotFound) as error:
                        left -= 1
                        if not left or isinstance(error, ServerSelectionTimeoutError):
                            raise
        except ConnectionLostError:
            self.is_lost = True
            raise

    def ensure_collection(self, name: str) -> None:
        """Create a clustered collection (`_id` is its only key) unless it exists."""
        from pymongo.errors import OperationFailure

        def create(database: PymongoDatabase[Document]) -> None:
            try:
                database.create_collection(
                    name,
                    check_exists=False,
                    clusteredIndex={"key": {"_id": 1}, "unique": True},
                )
            except OperationFailure as error:
                if error.code != _NAMESPACE_EXISTS:
                    raise

        self.run(create)

    def insert_raw(self, collection: str, documents: Sequence[bytes]) -> None:
        """Insert BSON documents as they are.

        An existing `_id` is skipped: documents are a pure function of the segment, so the document
        is the same. After an error any part may have been inserted, and inserting all again is
        safe. `ensure_collection` has made the collection.
        """
        from bson.raw_bson import RawBSONDocument

        for first in range(0, len(documents), BATCH_DOCUMENTS):
            parts = [*map(RawBSONDocument, documents[first : first + BATCH_DOCUMENTS])]
            self.run(partial(self._insert_batch, collection, parts))

    def _insert_batch(
        self, name: str, documents: Sequence[RawBSONDocument], database: PymongoDatabase[Document]
    ) -> None:
        from pymongo.errors import BulkWriteError

        try:
            database[name].insert_many(documents, ordered=False)
        except BulkWriteError as error:
            found = error.details or {}
            for one in (*found.get("writeErrors", ()), *found.get("writeConcernErrors", ())):
                if one.get("code") != _DUPLICATE_KEY:
                    words = str(one.get("errmsg", ""))
                    raise _refused(self.address, one.get("code", 0), words) from None

    def each(
        self,
        questions: Sequence[tuple[str, Mapping[str, object]]],
        stage: Callable[[int], Mapping[str, object]],
    ) -> Iterator[bytes]:
        """Concatenated BSON documents that many questions find, in few round trips.

        Their pipelines are joined, since MongoDB reads a whole clustered collection for `$or` of
        ranges.

        A question is a collection and a filter with a range of `_id`; what about a hundred of them
        find must fit into memory. `stage` returns the last stage of a pipeline, by the number of
        the question.
        """
        from bson import encode

        with _mapped(self.address, question=True):
            size = max((len(encode(query)) for _, query in questions), default=1)
        step = max(1, min(_MAX_QUESTIONS_PER_COMMAND, _MAX_COMMAND_BYTES // size))
        for first in range(0, len(questions), step):
            (collection, pipeline), *others = [
                # With the order, MongoDB considers the range of `_id` beside another index.
                (where, [{"$match": dict(query)}, {"$sort": {"_id": 1}}, stage(place)])
                for place, (where, query) in enumerate(questions[first : first + step], first)
            ]
            for where, stages in others:
                pipeline.append({"$unionWith": {"coll": where, "pipeline": stages}})

            def ask(database: Any, name: str = collection, pipeline: Any = pipeline) -> bytes:
                # As many as fit 16 MiB; by default the server's first batch has 101 documents.
                options = {"batchSize": 1 << 30, "allowDiskUse": True}
                return b"".join(database[name].aggregate_raw_batches(pipeline, **options))

            yield self.run(ask, question=True)

    def find(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002 - MongoDB's word
        projection: Mapping[str, object] | None = None,
        *,
        limit: int = 0,
    ) -> list[Document]:
        """Find documents, for small answers; none in a missing collection. `limit` 0 is all."""
        shape = None if projection is None else dict(projection)
        return self.run(
            lambda db: list(db[collection].find(dict(filter or {}), shape, limit=limit)),
            question=True,
        )

    def count(
        self,
        collection: str,
        filter: Mapping[str, object] | None = None,  # noqa: A002
    ) -> int:
        """Number of documents that match; 0 in a collection that does not exist.

        Without a filter this is the collection's own count. It costs nothing, but is an estimate
        after a server was killed.
        """
        if not filter:
            return self.run(lambda db: db[collection].estimated_document_count())
        return self.run(lambda db: db[collection].count_documents(dict(filter)), question=True)

    def count_each(self, questions: Sequence[tuple[str, Mapping[str, object]]]) -> list[int]:
        """Number of documents that each question finds."""
        from bson import decode_all

        def count(place: int) -> Document:
            return {"$group": {"_id": {"$literal": place}, "n": {"$sum": 1}}}

        numbers = [0] * len(questions)
        for raw in self.each(questions, count):
            for found in decode_all(raw):
                numbers[found["_id"]] = found["n"]
        return numbers

    def update(
        self,
        collection: str,
        filter: Mapping[str, object],  # noqa: A002
        change: Mapping[str, object],
        *,
        upsert: bool = False,
    ) -> None:
        """Apply update operators, which may be applied twice, to every matching document.

        With `upsert` a document is made if none matches.
        """
        values = dict(filter), dict(change)
        self.run(lambda db: db[collection].update_many(*values, upsert=upsert))

    def delete(self, collection: str, filter: Mapping[str, object]) -> None:  # noqa: A002
        """Delete every matching document; `{}` deletes all."""
        self.run(lambda db: db[collection].delete_many(dict(filter)))

    def list_collections(self) -> list[str]:
        """Names of all collections, sorted, without MongoDB's own."""
        names = self.run(lambda db: db.list_collection_names())
        return sorted(name for name in names if not name.startswith("system."))

    def indexes(self, collection: str) -> list[tuple[tuple[str, int], ...]]:
        """Fields of all indexes but the one on `_id`, each with 1 or -1, sorted."""
        found = [
            tuple((str(field), int(order)) for field, order in about["key"].items())
            for about in self.run(lambda db: list(db[collection].list_indexes()))
        ]
        return sorted(keys for keys in found if [field for field, _ in keys] != ["_id"])


def _options(parsed: Mapping[str, Any], timeout_s: float) -> dict[str, object]:
    """The options of a connection, beside those in its parsed URI."""
    given = {option.lower(): value for option, value in parsed["options"].items()}
    is_set = len(parsed["nodelist"]) > 1 or "replicaset" in given or parsed["fqdn"]
    defaults = {
        "wtimeoutMS": int(_REPLICATION_S * 1000),
        "serverSelectionTimeoutMS": int((timeout_s + (_ELECTION_S if is_set else 0)) * 1000),
        "connectTimeoutMS": int(timeout_s * 1000),
    }
    return {
        "appname": "hybridlog",
        # Members other than the primary may lack documents that the index is said to have.
        "readPreference": "primary",
        "readConcernLevel": "majority",
        "w": "majority",
        **{name: value for name, value in defaults.items() if name.lower() not in given},
    }


def without_secrets(uri: str) -> str:
    """A connection string without secrets: scheme, hosts and database only."""
    scheme, found, rest = uri.partition("://")
    if not found:
        return "the given URI"
    # From the last @, since an unencoded password may contain any character.
    return f"{scheme}://{rest.rpartition('@')[2].partition('?')[0]}"


@contextlib.contextmanager
def _mapped(address: str, *, question: bool = False) -> Iterator[None]:
    """Map errors of pymongo and bson; with a `question` of the caller most mean a wrong filter."""
    from bson.errors import BSONError
    from pymongo.errors import (
        ConnectionFailure,
        DocumentTooLarge,
        InvalidOperation,
        OperationFailure,
        PyMongoError,
    )

    try:
        yield
    except OperationFailure as error:
        code = error.code or 0
        text = str((error.details or {}).get("errmsg", "")) or str(error)
        refused = _refused(address, code, text)
        if question and code not in _NOT_ALLOWED and not isinstance(refused, DiskFullError):
            refused = WhereError(f"MongoDB does not understand the predicate: {text}")
        raise refused from error
    except (ConnectionFailure, InvalidOperation) as error:  # another thread may close the client
        raise ConnectionLostError(
            f"MongoDB at {address} does not answer: {_first_words(error)}. Check that it runs and "
            "can be reached."
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


def _refused(address: str, code: int, text: str) -> HybridlogError:
    if code == _DISK_FULL or "No space left on device" in text:
        return DiskFullError(f"MongoDB at {address} has no space left: {text}")
    text = text.partition(" to execute command")[0]  # which may be long
    cure = ". Grant its user the role readWrite on this database" if code == _NO_ROLE else ""
    if "uthentication" in text:
        cure = f". {LOGIN_CURE}"
    return DatabaseError(f"MongoDB at {address} refuses (error {code}): {text}{cure}")


def _first_words(error: BaseException) -> str:
    """The driver's message without the description of the topology that it appends."""
    return re.split(r", Timeout: | \(configured timeouts| \(_ssl", str(error))[0]
