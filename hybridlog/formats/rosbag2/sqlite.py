"""Reads a `.db3` file of a ROS 2 bag.

Rows are read in the order of row ids, in a damaged database up to the damage.
"""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from hybridlog.formats.reading import (
    BATCH_BYTES,
    BATCH_MESSAGES,
    Damage,
    Source,
    cannot_open,
    copy_start,
)
from hybridlog.schema.definition_text import interface_of
from hybridlog.wording import listed
from hybridlog_storage.errors import SourceError
from hybridlog_storage.messages import MAX_PAYLOAD, Batch, Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_MIN_ROWID = -(2**63)


_Row = tuple[int, int, int, int, bytes]
"""Row id, topic id, log time, publish time and payload of a message."""


class SqliteSource(Source):
    """A `.db3` file of rosbag2."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, kind="ROS 2 bag (sqlite3)", profile="ros2", files=[path])
        self._channel_of: dict[int, int] = {}
        self._undefined: Counter[int | None] = Counter()
        self._early = 0
        self._select = ""
        self._got = 0
        self._problem: str | None = None
        page, pages = _read_header(path)
        self._missing = pages * page - self.size_bytes
        try:
            self._db = _connect(path, page, self.size_bytes)
            self._open()
        except (sqlite3.Error, OverflowError, ValueError) as error:
            raise SourceError(
                f"{path}: SQLite cannot read it ({error}); copy it, with its -wal file if there is "
                "one, to where you may write, or repair a copy with "
                "`sqlite3 FILE .recover | sqlite3 NEW`"
            ) from error

    def close(self) -> None:
        """Close the database."""
        self._db.close()

    # Opening.

    def _open(self) -> None:
        tables = self._tables()
        messages = self._columns("messages") if "messages" in tables else set()
        topics = self._columns("topics") if "topics" in tables else set()
        if not {"topic_id", "data"} <= messages or not {"id", "name", "type"} <= topics:
            raise SourceError(
                f"{self.path}: an SQLite database, but no ROS 2 bag (it has no messages and "
                "topics tables as rosbag2 writes them); give the .db3 file of a bag"
            )
        log_time = next((name for name in _LOG_TIMES if name in messages), None)
        if log_time is None:
            raise SourceError(f"{self.path}: its messages have no time; record it again")
        has_publish_time = "send_timestamp" in messages
        # SQLite has types for each value only, so all are cast; names come from here.
        sent = f"ifnull(CAST(send_timestamp AS INTEGER), {log_time})"
        chosen = (
            f"rowid, CAST(topic_id AS INTEGER), ifnull(CAST({log_time} AS INTEGER), 0), "
            f"{sent if has_publish_time else 0}, ifnull(CAST(data AS BLOB), x'')"
        )
        self._select = f"SELECT {chosen} FROM messages WHERE rowid >= ? ORDER BY rowid"  # noqa: S608
        self._db.execute(f"{self._select} LIMIT 0", (0,)).fetchall()
        self._has_publish_time = has_publish_time
        self._read_topics(topics, tables)
        self._read_totals(log_time)

    def _tables(self) -> set[str]:
        """Names of real tables, without views, whose cost is unlimited."""
        query = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql LIKE 'CREATE TABLE%'"
        try:
            rows = self._db.execute(query).fetchall()
        except sqlite3.DatabaseError:
            # Without this, SQLite refuses a file shorter than its header states.
            self._db.execute("PRAGMA writable_schema = ON")
            rows = self._db.execute(query).fetchall()
        return {name for (name,) in rows}

    def _columns(self, table: str) -> set[str]:
        return {row[1] for row in self._db.execute(f"PRAGMA table_info({table})")}

    def _read_topics(self, columns: set[str], tables: set[str]) -> None:
        definitions: dict[str, tuple[str, bytes]] = {}
        if "message_definitions" in tables:
            query = (
                "SELECT topic_type, encoding, CAST(encoded_message_definition AS BLOB) "
                "FROM message_definitions"
            )
            for name, encoding, data in self._optional(query):
                if data and encoding and str(encoding) != "unknown":
                    definitions.setdefault(str(name), (str(encoding), data))
        optional = [
            name if name in columns else "''"
            for name in ("serialization_format", "offered_qos_profiles", "type_description_hash")
        ]
        # Without an id, a topic has no messages.
        query = (
            f"SELECT CAST(id AS INTEGER), name, type, {', '.join(optional)} FROM topics "  # noqa: S608
            "WHERE id IS NOT NULL ORDER BY id"
        )
        for number, name, kind, encoding, qos, type_hash in self._db.execute(query):
            type_name = str(kind or "")
            # Services and actions are recorded by their events, and defined by themselves.
            found = definitions.get(type_name) or definitions.get(interface_of(type_name))
            metadata = {"topic_type_hash": str(type_hash)} if type_hash else {}
            if "offered_qos_profiles" in columns:
                metadata["offered_qos_profiles"] = str(qos or "")
            schema, has_sent = Schema(type_name, *(found or ("", b""))), self._has_publish_time
            channel = Channel(
                str(name), str(encoding or ""), schema, metadata, has_publish_time=has_sent
            )
            self._channel_of[number] = self.add_channel(channel)

    def _read_totals(self, log_time: str) -> None:
        """Read number and times of the messages; one end of an index a query."""
        columns = f"count(*) min({log_time}) max({log_time})".split()
        found = [self._optional(f"SELECT {one} FROM messages") for one in columns]  # noqa: S608
        if not found[0]:
            return
        ((self.message_count,),), *ends = found
        first, last = (one[0][0] if one else None for one in ends)
        # Messages before 1970 are not read.
        if isinstance(first, int) and isinstance(last, int) and first >= 0:
            self.time_range = (first, last + 1)

    def _optional(self, query: str, *values: str | int) -> list[tuple[Any, ...]]:
        """Rows of an optional query; empty if it fails."""
        try:
            return self._db.execute(query, values).fetchall()
        except (sqlite3.Error, OverflowError):
            return []

    # Reading.

    def batches(self) -> Iterator[Batch]:
        """Yield the messages before the first damage, in the order of row ids."""
        rows: list[_Row] = []
        size = 0
        for row in self._rows():
            rows.append(row)
            size += len(row[4])
            if size >= BATCH_BYTES or len(rows) >= BATCH_MESSAGES:
                yield from self._batch(rows, size)
                rows, size = [], 0
        yield from self._batch(rows, size)
        self.bytes_read = self.size_bytes
        told: list[tuple[str, int | None]] = []
        if self._problem is not None:
            known = self.message_count
            lost = None if known is None else max(0, known - self._got)
            told.append((self._problem, lost))
        elif self._missing > 0:
            reason = "the file is cut short, but only behind its messages"
            self.damage.append(Damage(self.path, self.size_bytes, self._missing, reason, 0))
        if self._undefined:
            ids = listed(sorted(map(str, self._undefined)))
            reason = f"messages of topics that the bag does not list (topic id {ids})"
            told.append((reason, self._undefined.total()))
        if self._early:
            told.append(("messages with a time before 1970, which no log can keep", self._early))
        self.damage += (Damage(self.path, None, None, reason, lost) for reason, lost in told)

    def _rows(self) -> Iterator[_Row]:
        """The rows before the first damage; keeps its place and what SQLite says of it."""
        start, problem = _MIN_ROWID, "rows out of order"
        try:
            for row in self._db.execute(self._select, (start,)):
                if row[0] < start:
                    break
                start = row[0] + 1
                yield row
            else:
                return
        except (sqlite3.Error, OverflowError) as error:
            problem = str(error)
        # The driver reads one row ahead, so the last valid row was lost with the error.
        for row in self._optional(f"{self._select} LIMIT 1", start):
            if row[0] >= start:
                start = row[0] + 1
                yield row
        self._problem = f"rows from id {max(start, 1)} on cannot be read: SQLite says {problem}"

    def _batch(self, rows: list[_Row], size: int) -> Iterator[Batch]:
        if not rows:
            return
        self._got += len(rows)
        self.bytes_read = min(self.bytes_read + size, self.size_bytes)
        _, topics, log_times, publish_times, payloads = zip(*rows, strict=True)
        length = np.fromiter(map(len, payloads), np.int64, len(rows))
        log_time = np.array(log_times, np.int64)
        channel = np.array([self._channel_of.get(topic, -1) for topic in topics], np.int32)
        batch = Batch(
            buffer=b"".join(payloads),
            offset=np.cumsum(length) - length,
            length=length,
            channel=channel,
            log_time=log_time,
            publish_time=np.array(publish_times, np.int64) if self._has_publish_time else log_time,
            sequence=np.zeros(len(rows), np.uint32),
        )
        if len(channel) and int(channel.min()) < 0:
            self._undefined.update(topic for topic in topics if topic not in self._channel_of)
        early = (batch.log_time < 0) | (batch.publish_time < 0)
        self._early += int((early & (channel >= 0)).sum())
        usable = (channel >= 0) & ~early
        if not usable.all():
            batch = batch.take(usable)
        if len(batch):
            yield batch


_LOG_TIMES = ("timestamp", "recv_timestamp")


def _read_header(path: Path) -> tuple[int, int]:
    """Bytes of a page, and number of pages, by the header of a database."""
    try:
        with path.open("rb") as file:
            data = file.read(100)
    except OSError as error:
        raise cannot_open(path, error) from error
    page = int.from_bytes(data[16:18], "big")
    return 1 << 16 if page == 1 else page, int.from_bytes(data[28:32], "big")


def _connect(path: Path, page: int, size: int) -> sqlite3.Connection:
    """Open an untrusted database read-only, without its last page if that is truncated.

    A database with a write-ahead log, left by a crashed recorder, is opened with it. Others are
    opened as immutable, so that no file is written beside them.
    """
    is_whole = page < 512 or size % page == 0
    # SQLite would read zeros for the missing part of a page, and return them as payload.
    whole = path if is_whole else copy_start(path, size - size % page)
    try:
        log = whole.with_name(whole.name + "-wal")
        mode = "ro" if log.is_file() and log.stat().st_size else "ro&immutable=1"
        uri = f"file:{quote(os.fsencode(whole.absolute()))}?mode={mode}"
        db = sqlite3.connect(uri, uri=True, check_same_thread=False)
    finally:
        if not is_whole:
            whole.unlink(missing_ok=True)
    db.text_factory = lambda data: data.decode(errors="replace")
    db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_PAYLOAD)
    db.executescript(
        "PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON; PRAGMA query_only = ON"
    )
    return db
