"""Cells: small values in an SQLite file that is a cache.

Nothing that happens to the file does more than cost time. A damaged file is removed and made
again. While it is locked, read-only or on a full disk, its content is used in memory, and what
was to be written is kept and tried again. The file may come from elsewhere: each cell has a
checksum, no symlink is followed, and no journal is read or written, so a process that is
killed may leave a damaged file.
"""

from __future__ import annotations

import os
import sqlite3
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from threading import RLock
from typing import Any, Final, TypeVar
from urllib.parse import quote

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError

Statement = tuple[str, tuple[object, ...]]
"""An SQL statement and its values."""
_VERSION: Final = 1
_TABLE: Final = (
    "CREATE TABLE cells(kind TEXT, key TEXT, number INTEGER, body BLOB, crc INTEGER, "
    "PRIMARY KEY(kind, key, number)) WITHOUT ROWID"
)
_SELECT: Final = "SELECT kind, key, number, body, crc FROM cells WHERE kind = ? AND "
_BESIDE: Final = (
    "SELECT one.kind, one.key, one.number, one.body, one.crc FROM cells other CROSS JOIN cells one "
    "WHERE one.kind = ? AND other.kind = ? AND one.key = other.key AND one.number = 0"
)
_ASIDE: Final = ("-journal", "-wal", "-shm")  # what SQLite would read or write, too
_READ_S: Final = 0.1
_AGAIN_S: Final = 5.0  # until a file that could not be used is tried again
_MAX_LATE: Final = 10_000  # statements that wait for the file
_MAX_BYTES: Final = 1 << 28  # of a cell
_MAX_COPIED: Final = 1 << 30  # bytes of a file that is read into memory
_TRIES: Final = 4
_ERRORS: Final = (sqlite3.DatabaseError, UnicodeDecodeError)
"""Those of SQLite; the other one is of a message that has damaged text."""
_TROUBLES: Final = (
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_PROTOCOL,
)
"""What is wrong with a disk or with other processes, not with the file."""
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
    """Cells by kind, key and number. Thread safe.

    Args:
        path: The file; None for memory.
        owner: The store; the file of another one is made again.
        writes: False to leave the file as it is, and use a copy in memory.
        before_late: Called before what was kept is written at last.

    Attributes:
        lock: Held while cells are read or changed.

    Raises:
        StoreError: A symlink lies in the place of the file; so do all methods.
    """

    def __init__(
        self,
        path: Path | None,
        owner: str,
        *,
        writes: bool = True,
        before_late: Callable[[], None] = lambda: None,
    ) -> None:
        self._path = path
        self._owner = crc32(f"{_VERSION} {owner}".encode()) >> 1
        self._writes = writes and path is not None
        self._before_late = before_late
        self.lock = RLock()
        self._db: sqlite3.Connection | None = None
        self._file: tuple[int, int] | None = None  # that is open; None in memory
        self._again_at = 0.0
        self._late: list[Statement] = []
        self._times_opened = 0
        self._use()

    def close(self, wait_s: float) -> None:
        """Write what was kept, if that is possible now, and close the file."""
        with self.lock:
            if self._late:
                self._open(wait_s)
                self._late.clear()
            self._close()

    def _close(self) -> None:
        if self._db is not None:
            self._db.close()
        self._db = self._file = None
        self._again_at = 0.0
        self._times_opened += 1

    # The file.

    def _use(self) -> sqlite3.Connection:
        """The database to ask now."""
        if self._file is not None and self._path is not None:
            with suppress(OSError):
                about = files.status(self._path)
                if (about.st_dev, about.st_ino) == self._file and self._db is not None:
                    return self._db
            self._close()  # somebody has removed or replaced it
        if self._db is None or time.monotonic() >= self._again_at:
            self._open(_READ_S)
        assert self._db is not None
        return self._db

    def _open(self, wait_s: float) -> None:
        """Open the file and write what was kept, or go on in memory."""
        for _ in range(2 if self._writes else 0):
            try:
                opened, file = self._opened(wait_s)
            except OSError:
                break
            except _ERRORS as error:
                if not self._is_damage(error):
                    break
                self._remove()
            else:
                self._close()
                self._db, self._file = opened, file
                return
        if self._db is None:
            self._go_on_in_memory()
        self._again_at = time.monotonic() + _AGAIN_S if self._writes else float("inf")

    def _go_on_in_memory(self) -> None:
        is_damaged = self._db is not None and self._file is None
        self._close()
        self._db = self._in_memory(None if is_damaged else self._path)
        self._again_at = time.monotonic() + _AGAIN_S

    def _opened(self, wait_s: float) -> tuple[sqlite3.Connection, tuple[int, int]]:
        """The file, made if it does not exist, with what was kept."""
        assert self._path is not None
        self._check_kinds(self._path)
        with suppress(FileExistsError):
            os.close(files.open_file(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL))
        about = files.status(self._path)
        opened = _connected(_address(self._path, "rw"), wait_s)
        try:
            if not self._is_ours(opened):
                with _transaction(opened, wait_s):
                    if not opened.execute("SELECT 1 FROM sqlite_master").fetchall():  # it is new
                        self._fill(opened)
            if not self._is_ours(opened):
                raise sqlite3.DatabaseError("it is of another store or version")
            if self._late:
                with _transaction(opened, wait_s):
                    self._before_late()
                    for statement in self._late:
                        opened.execute(*statement)
                self._late.clear()
        except BaseException:
            opened.close()
            raise
        return opened, (about.st_dev, about.st_ino)

    def _check_kinds(self, path: Path) -> None:
        """Make sure that an ordinary file lies there, or none, and nothing beside it."""
        for suffix in ("", *_ASIDE):
            place = path.with_name(path.name + suffix)
            with suppress(FileNotFoundError):
                kind = files.status(place).st_mode
                if stat.S_ISREG(kind) and not suffix:
                    continue
                if stat.S_ISLNK(kind):
                    raise StoreError(f"{place} is a symlink. Delete it: the catalog is made again.")
                files.remove_tree(place)

    def _is_ours(self, opened: sqlite3.Connection) -> bool:
        (version,) = opened.execute("PRAGMA user_version").fetchone()
        found = opened.execute("SELECT sql FROM sqlite_master").fetchall()
        return version == self._owner and found == [(_TABLE.encode(),)]

    def _fill(self, made: sqlite3.Connection) -> None:
        made.execute(_TABLE)
        made.execute(f"PRAGMA user_version = {self._owner}")

    def _in_memory(self, path: Path | None, content: bytes = b"") -> sqlite3.Connection:
        """What a file or a content has, in memory; empty if that cannot be read."""
        made, is_ours = _connected(), False
        with suppress(*_ERRORS, OSError):
            if content:
                made.deserialize(content)
            elif path is not None and _is_copied(files.status(path)):
                with closing(_connected(_address(path, "ro&immutable=1"))) as source:
                    source.backup(made)
            is_ours = self._is_ours(made)
        if not is_ours:
            made.close()
            made = _connected()
            self._fill(made)
        for statement in self._late:
            made.execute(*statement)
        return made

    def _remove(self) -> None:
        """Remove a damaged file."""
        self._close()
        if self._path is not None:
            with suppress(OSError):
                files.remove_tree(self._path)

    def _run(self, work: Callable[[sqlite3.Connection], _T]) -> _T:
        """Do something with the file, or else in memory."""
        with self.lock:
            for _ in range(_TRIES):
                try:
                    return work(self._use())
                except _ERRORS as error:
                    if self._file is not None and self._is_damage(error):
                        self._remove()
                    else:
                        self._go_on_in_memory()
            return work(self._use())

    def _is_damage(self, error: Exception) -> bool:
        """False if the file may be as it should be: locked, read-only, on a full disk."""
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        if code == sqlite3.SQLITE_READONLY:
            return os.access(self._path or "", os.W_OK)  # its first bytes say so
        return code not in _TROUBLES

    # Cells.

    def read(self, kind: str, key: str, number: int = 0) -> bytes | None:
        """A cell; None if it is missing or damaged."""
        found = self._found(f"{_SELECT} key = ? AND number = ?", kind, key, number)
        return next(iter(found.values()), None)

    def each(self, kind: str, containing: bytes = b"") -> dict[str, bytes]:
        """All cells of a kind by key, or those with some bytes in them; without damaged ones."""
        return self._found(f"{_SELECT} instr(body, ?)", kind, containing)

    def beside(self, kind: str, other: str) -> dict[str, bytes]:
        """The cells of a kind, number 0, whose key has a cell of another kind.

        Each is looked for like a single one: of damaged cells, both find the same.
        """
        return self._found(_BESIDE, kind, other)

    def _found(self, query: str, *values: object) -> dict[str, bytes]:
        rows = self._run(lambda opened: opened.execute(query, values).fetchall())
        return {row[1].decode(errors="replace"): row[3] for row in rows if _is_whole(*row)}

    def write(self, make: Callable[[], Iterable[Statement]], wait_s: float) -> None:
        """Change cells; what cannot be written now is kept.

        Args:
            make: Returns the statements, while no other process changes cells.
            wait_s: Seconds to wait for another process.
        """

        def work(opened: sqlite3.Connection) -> None:
            with _transaction(opened, wait_s):
                statements = [*make()]
                for statement in statements:
                    opened.execute(*statement)
            if self._file is None and self._writes:
                self._late = [*self._late, *statements][-_MAX_LATE:]

        self._run(work)

    @contextmanager
    def alone(self, wait_s: float) -> Iterator[bool]:
        """Keep other processes from changing cells. False if the file cannot be used."""
        with self.lock:
            opened = self._use()
            try:
                _begin(opened, wait_s)
            except _ERRORS:
                yield False
                return
            try:
                yield self._file is not None
            finally:
                with suppress(sqlite3.Error):
                    opened.rollback()

    def state(self) -> tuple[int, ...]:
        """A value that changes with the cells."""

        def work(opened: sqlite3.Connection) -> tuple[int, ...]:
            (version,) = opened.execute("PRAGMA data_version").fetchone()
            return self._times_opened, version, opened.total_changes

        return self._run(work)

    def to_bytes(self) -> bytes:
        """All cells, as a database."""
        return self._run(lambda opened: opened.serialize())


def _begin(opened: sqlite3.Connection, wait_s: float) -> None:
    opened.execute(f"PRAGMA busy_timeout = {int(wait_s * 1000)}")
    opened.execute("BEGIN IMMEDIATE")


@contextmanager
def _transaction(opened: sqlite3.Connection, wait_s: float) -> Iterator[None]:
    try:
        _begin(opened, wait_s)
        yield
        opened.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            opened.rollback()
        raise
    finally:
        with suppress(sqlite3.Error):
            opened.execute(f"PRAGMA busy_timeout = {int(_READ_S * 1000)}")


def _is_copied(about: os.stat_result) -> bool:
    return stat.S_ISREG(about.st_mode) and about.st_size <= _MAX_COPIED


def _address(path: Path, mode: str) -> str:
    return f"file:{quote(os.fsencode(path.absolute()))}?mode={mode}"


def _connected(address: str = ":memory:", wait_s: float = 0) -> sqlite3.Connection:
    made = sqlite3.connect(
        address, uri=True, timeout=wait_s, isolation_level=None, check_same_thread=False
    )
    try:
        made.text_factory = bytes  # damaged text is no error
        made.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_BYTES)
        for setting in (
            "trusted_schema = OFF",
            "cell_size_check = ON",
            "synchronous = OFF",
            "journal_mode = MEMORY",
        ):
            made.execute(f"PRAGMA {setting}")
    except BaseException:
        made.close()
        raise
    return made
