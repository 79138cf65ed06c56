"""Cells: small values in an SQLite file that is a cache.

Nothing that happens to the file does more than cost time. A damaged file is removed and made
again. If it is locked, on a full disk, or cannot be written, memory takes its place from then on.
The file may come from elsewhere: each cell has a checksum, no symlink is followed, and no journal
is read or written, so a process that is killed may leave a damaged file.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import stat
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from threading import RLock
from typing import Any, Final, TypeVar
from urllib.parse import quote

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError

CATALOG: Final = "catalog.sqlite"
"""Name of the file in the directory of a store."""
Statement = tuple[str, tuple[object, ...]]
"""An SQL statement and its values."""
_VERSION: Final = 3
_TABLE: Final = (
    "CREATE TABLE cells(kind TEXT, key TEXT, number INTEGER, body BLOB, crc INTEGER, "
    "PRIMARY KEY(kind, key, number)) WITHOUT ROWID"
)
_SELECT: Final = "SELECT kind, key, number, body, crc FROM cells WHERE kind = ? AND"
_AMONG: Final = "key IN (SELECT value FROM json_each(?))"
_WAIT_S: Final = 0.1  # for other processes, once: then memory takes the place of the file
_MAX_BYTES: Final = 1 << 28  # of a cell
_ERRORS: Final = (sqlite3.DatabaseError, UnicodeDecodeError, OSError)
"""Those of SQLite, of a message that has damaged text, and of the file's place."""
_T = TypeVar("_T")


def put(kind: str, key: str, body: bytes, number: int = 0) -> Statement:
    """A statement that inserts or replaces a cell."""
    crc = _checksum(kind.encode(), key.encode(), number, body)
    return "INSERT OR REPLACE INTO cells VALUES(?, ?, ?, ?, ?)", (kind, key, number, body, crc)


def drop(kind: str, key: str) -> Statement:
    """A statement that removes the cells of a kind and key, whatever their number."""
    return "DELETE FROM cells WHERE kind = ? AND key = ?", (kind, key)


def _checksum(kind: bytes, key: bytes, number: int, body: bytes) -> int:
    return crc32(body, crc32(b"%b %b %d" % (kind, key, number)))


def _is_whole(kind: Any, key: Any, number: Any, body: Any, crc: Any) -> bool:
    types = [*map(type, (kind, key, number, body))]
    return types == [bytes, bytes, int, bytes] and _checksum(kind, key, number, body) == crc


class Cells:
    """Cells by kind, key and number; in memory without a path. Thread safe.

    The file of another `owner`, a store, is made again.
    """

    def __init__(self, path: Path | None, owner: str) -> None:
        self._path = path
        self._owner = crc32(f"{_VERSION} {owner}".encode()) >> 1
        self._lock = RLock()
        self._db: sqlite3.Connection | None = None

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            if self._db is not None:
                self._db.close()
            self._db = None

    # The file.

    def _use(self) -> sqlite3.Connection:
        """The database to ask: the file, made if it does not exist, or memory in its place."""
        if self._db is not None:
            return self._db
        opened = _connected(":memory:" if self._path is None else _cleared(self._path))
        if not self._is_ours(opened):
            with opened:
                opened.execute("BEGIN IMMEDIATE")
                if not opened.execute("SELECT 1 FROM sqlite_master").fetchall():  # it is new
                    opened.execute(_TABLE)
                    opened.execute(f"PRAGMA user_version = {self._owner}")
        if not self._is_ours(opened):
            raise sqlite3.DatabaseError("it is of another store or version")
        self._db = opened
        return opened

    def _is_ours(self, opened: sqlite3.Connection) -> bool:
        (version,) = opened.execute("PRAGMA user_version").fetchone()
        found = opened.execute("SELECT sql FROM sqlite_master").fetchall()
        return version == self._owner and found == [(_TABLE.encode(),)]

    def _run(self, work: Callable[[sqlite3.Connection], _T]) -> _T:
        """Do something with the file, or else in memory."""
        with self._lock:
            for _ in range(2):
                try:
                    return work(self._use())
                except _ERRORS as error:
                    self.close()
                    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR)
                    is_busy = (
                        isinstance(error, sqlite3.OperationalError) and code != sqlite3.SQLITE_ERROR
                    )
                    if self._path is None or is_busy or isinstance(error, OSError):
                        break  # by the disk or other processes: the file may be whole
                    with suppress(OSError):
                        files.remove_tree(self._path)
            self._path = None
            return work(self._use())

    # Cells.

    def read(self, kind: str, key: str) -> bytes | None:
        """The cell of a kind and key; None if it is missing."""
        return next(iter(self.of(kind, key)), None)

    def of(self, kind: str, key: str) -> list[bytes]:
        """All cells of a kind and key."""
        return [body for _, body in self._rows("key = ?", kind, key)]

    def each(self, kind: str, keys: Collection[str] | None = None) -> dict[str, bytes]:
        """Cells of a kind by key; all without keys."""
        if keys is None:
            return dict(self._rows("TRUE", kind))
        return dict(self._rows(_AMONG, kind, json.dumps([*keys])))

    def _rows(self, condition: str, *values: object) -> list[tuple[str, bytes]]:
        def work(opened: sqlite3.Connection) -> list[tuple[str, bytes]]:
            rows = opened.execute(f"{_SELECT} {condition}", values).fetchall()
            if not all(_is_whole(*row) for row in rows):
                raise sqlite3.DatabaseError("a cell is damaged")
            return [(row[1].decode(), row[3]) for row in rows]

        return self._run(work)

    def write(self, statements: Collection[Statement]) -> None:
        """Change cells; meanwhile no other process changes any."""

        def work(opened: sqlite3.Connection) -> None:
            with opened:
                opened.execute("BEGIN IMMEDIATE")
                for statement in statements:
                    opened.execute(*statement)

        self._run(work)


def _cleared(path: Path) -> str:
    """Make sure of an ordinary file without journals beside it; returns its URI for SQLite."""
    for suffix in ("", "-journal", "-wal", "-shm"):
        place = path.with_name(path.name + suffix)
        with suppress(FileNotFoundError):
            if suffix or not stat.S_ISREG(files.status(place).st_mode):
                files.remove_tree(place)
    with suppress(FileExistsError):
        os.close(files.open_file(path, os.O_RDWR | os.O_CREAT | os.O_EXCL))
    return f"file:{quote(os.fsencode(path.absolute()))}?mode=rw"


def _connected(address: str) -> sqlite3.Connection:
    made = sqlite3.connect(
        address, uri=True, timeout=_WAIT_S, isolation_level=None, check_same_thread=False
    )
    made.text_factory = bytes  # damaged text is no error
    made.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_BYTES)
    for setting in (
        "trusted_schema = OFF",
        "cell_size_check = ON",
        "synchronous = OFF",
        "journal_mode = MEMORY",
    ):
        made.execute(f"PRAGMA {setting}")
    return made


def cells_of_user(address: str, owner: str) -> Cells:
    """Cells in the user's cache, for a store at an address that cannot be written itself."""
    with suppress(OSError, StoreError):  # then memory takes the place of the file
        folder = files.user_cache()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return Cells(folder / f"{hashlib.sha256(address.encode()).hexdigest()[:40]}.sqlite", owner)
    return Cells(None, owner)
