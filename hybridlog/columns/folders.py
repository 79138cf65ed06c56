"""Changes of the folders of finished tables.

All changes are made under a lock on the folder `tables`. A shared file is replaced by one
rename, so readers find the old rows or the new ones.

Beside a folder lies a list, `.<folder>.recordings`, which tells the shared files of a recording
without opening any. Each line has an id, names of files and a checksum. It is written before
the rows, so it lacks no file of a recording that it lists. Lines of removed recordings stay.
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from stat import S_ISDIR
from typing import Any, Final

import pyarrow as pa

from hybridlog.columns.layout import (
    SHARED,
    SUFFIX,
    TABLES,
    Section,
    TopicCounts,
    is_of_folder,
    parts_folder,
)
from hybridlog.columns.parquet_file import (
    NoRoomError,
    ParquetFileReader,
    ParquetFileWriter,
    ReusedBytes,
)
from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import StoreError, unreadable

MAX_SHARED_ROWS: Final = 50_000
"""Maximum number of rows of several recordings in one file."""
MAX_SHARED_BYTES: Final = 4 << 20
"""Size from which a shared file gets no more recordings."""
MAX_SHARED_RECORDINGS: Final = 256
"""Maximum number of recordings in one file: each one that comes costs a look at all of them."""
_SHARED_NAME: Final = re.compile(rf"{SHARED}(\d{{6,}}){re.escape(SUFFIX)}", re.ASCII)
_MAX_LIST_BYTES: Final = 256 << 20
_STABLE_NS: Final = 100_000_000  # a time of change that is older tells of every later change
_log = logging.getLogger(__name__)
_Piece = tuple[Section, Any]
"""Rows of a recording, and what they are."""


@dataclass(slots=True)
class Addition:
    """Rows of one recording for a folder.

    Attributes:
        rows: Rows for a shared file, by topic, with all columns; empty for none.
        section: What they are; None without such rows.
        files: Finished files of long topics.
    """

    rows: Any = None
    section: Section | None = None
    files: list[Path] = field(default_factory=list)


class TableFolders:
    """Adds and removes tables of one recording, which this process has locked for writing.

    Args:
        root: The store.
        recording: Id of the recording.
        digests: Digests of its segments; rows of others go.
    """

    def __init__(
        self, root: Path, recording: str, digests: Mapping[str, str] | None = None
    ) -> None:
        self._root = root
        self._recording = recording
        self._digests = digests or {}
        self._numbers = 0
        self._keeps_bytes = True
        # Of the folder that is changed:
        self._is_listed = False
        self._shared: set[str] = set()  # shared files that may have rows of the recording

    def add(
        self,
        additions: Mapping[str, Addition],
        replaced: Collection[str] = (),
        prefixes: Collection[str] = (),
    ) -> None:
        """Add tables, in place of older ones of the same topics.

        Args:
            additions: New tables by folder.
            replaced: Topics whose older tables go.
            prefixes: Beginnings of the names of folders that may have such tables.

        Raises:
            OSError: a file cannot be written.
        """
        self._keeps_bytes = not prefixes  # tables that are made anew leave no holes
        with suppress(FileExistsError):
            files.make_folder(self._root / TABLES)
        with locked(self._root):
            others = [name for name in _folders(self._root) if name.startswith(tuple(prefixes))]
            for name in dict.fromkeys([*additions, *others]):
                if name in additions:
                    files.make_folders(self._root / TABLES / name)
                try:
                    addition = additions.get(name, Addition())
                    self._change(name, addition, replaced.__contains__ if prefixes else None)
                except (OSError, MemoryError):
                    raise
                except Exception as error:
                    _log.warning("no table in %s: %s", name, error or repr(error))

    def remove(self, prefixes: Collection[str] = ("",)) -> None:
        """Remove all tables of the recording.

        Args:
            prefixes: Beginnings of the names of folders that may have tables of it.

        Raises:
            OSError: one cannot be removed.
        """
        with suppress(FileNotFoundError), locked(self._root):
            for name in _folders(self._root):
                if name.startswith(tuple(prefixes)):
                    self._change(name, Addition(), _all)

    def _change(self, folder: str, addition: Addition, goes: Callable[[str], bool] | None) -> None:
        """Remove and add tables in a folder; an empty one is removed.

        Args:
            folder: Its name.
            addition: What is added.
            goes: Returns whether older rows of a topic go; None if there are none.
        """
        place = self._root / TABLES / folder
        names = [n for n in files.names(place) if n.endswith(SUFFIX)]
        shared = sorted(name for name in names if name.startswith(SHARED))
        is_new = goes is None  # and in no file yet
        listed = None if is_new else shared_files(self._root, folder, self._recording)
        self._is_listed = bool(listed)
        self._shared = set() if not listed else listed[self._recording]
        waiting, old = addition, []
        if goes is not None:
            old = self._own_files(place, names, goes)
            for path, reader in self._shared_with_rows(place, shared):
                self._rewrite(path, reader, waiting, goes)
                waiting = Addition()
        if waiting.section is not None:
            self._merge(place, shared, waiting)
        elif addition.files and not self._is_listed:
            self._list(place)
        self._publish(place, addition.files, [name for name in names if name not in old], old)
        with suppress(OSError), files.folder(place.parent) as fd:
            files.system.rmdir(folder, folder=fd)
            files.system.unlink(_list_of(place).name, folder=fd)

    def _shared_with_rows(
        self, place: Path, shared: Sequence[str]
    ) -> list[tuple[Path, ParquetFileReader]]:
        """The shared files with rows of the recording; all are opened only if it is not listed."""
        found = []
        for name in shared:
            is_other = self._is_listed and name not in self._shared
            if is_other and _SHARED_NAME.fullmatch(name):
                continue
            reader = _reader(place / name)
            if reader is not None and reader.about.section(self._recording) is not None:
                found.append((place / name, reader))
        self._shared.update(path.name for path, _ in found)
        return found

    def _list(self, place: Path, *names: str) -> None:
        """List shared files of the recording, before they have rows of it."""
        self._shared.update(names)
        line = " ".join([self._recording, *sorted(self._shared)]).encode()
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
        fd = files.open_file(_list_of(place), flags)
        try:
            # A line before it may have been cut by a crash.
            durability.write_all(fd, [b"\n%b %b\n" % (line, _checksum(line))])
        finally:
            os.close(fd)
        self._is_listed = True

    def _own_files(
        self, place: Path, names: Iterable[str], goes: Callable[[str], bool]
    ) -> list[str]:
        """Files of long topics that are to go; damaged ones are among them."""
        found = []
        for name in sorted(names):
            if name.startswith(f"{self._recording}-"):
                try:
                    about = ParquetFileReader(place / name).about
                    topics = [topic for one in about.recordings for topic in one.topics]
                except (OSError, StoreError):
                    found.append(name)
                    continue
                if all(map(goes, topics)):
                    found.append(name)
        return found

    def _merge(self, place: Path, shared: Sequence[str], addition: Addition) -> None:
        """Add rows to the newest shared file, or to a new one."""
        assert addition.section is not None
        number = 0
        numbers = [int(found[1]) for name in shared if (found := _SHARED_NAME.fullmatch(name))]
        if numbers:
            path = place / f"{SHARED}{max(numbers):06d}{SUFFIX}"
            reader = _reader(path)
            number = max(numbers) + (reader is not None)
            if (
                reader is not None
                and len(reader.about.recordings) < MAX_SHARED_RECORDINGS
                and reader.size_bytes < MAX_SHARED_BYTES
                and reader.about.rows + addition.section.rows <= MAX_SHARED_ROWS
            ):
                self._rewrite(path, reader, addition, lambda _: False)
                return
        path = place / f"{SHARED}{number:06d}{SUFFIX}"
        self._write(path, [(addition.section, addition.rows)])

    def _rewrite(
        self,
        path: Path,
        reader: ParquetFileReader,
        addition: Addition,
        goes: Callable[[str], bool],
    ) -> None:
        """Replace a shared file by one with other rows of the recording."""
        try:
            table = reader.table()
        except StoreError as error:
            # Its other recordings get their tables again when they are asked about.
            _log.info("%s", error)
            files.unlink(path)
            if addition.section is not None:
                self._write(path, [(addition.section, addition.rows)])
            return
        pieces: list[_Piece] = []
        before = 0
        for section in reader.about.recordings:
            piece = section, table.slice(before, section.rows)
            before += section.rows
            if section.id != self._recording:
                pieces.append(piece)
            elif section.segments.items() <= self._digests.items():  # else it is stale
                pieces += (one for one in _by_topic(*piece) if not goes(*one[0].topics))
        if addition.section is not None:
            new = addition.section
            is_replaced = new.topics.__contains__
            pieces = [
                (replace(section, begin=new.begin) if section.id == new.id else section, rows)
                for section, rows in pieces
                if section.id != new.id or not any(map(is_replaced, section.topics))
            ]
            pieces += _by_topic(new, addition.rows)
        if pieces:
            self._write(path, pieces, reader)
        else:
            files.unlink(path)

    def _write(
        self, path: Path, pieces: Iterable[_Piece], before: ParquetFileReader | None = None
    ) -> None:
        """Write a shared file, and give it its name by one rename.

        Args:
            path: The file.
            pieces: What it has, in any order.
            before: The file that it replaces.
        """
        pieces = sorted(pieces, key=lambda piece: (piece[0].place, *piece[0].topics))
        sections = {section.id: section for section, _ in pieces}
        segments: defaultdict[str, dict[str, str]] = defaultdict(dict)
        topics: defaultdict[str, dict[str, TopicCounts]] = defaultdict(dict)
        for section, _ in pieces:
            segments[section.id] |= section.segments
            topics[section.id] |= section.topics
        found = [
            replace(section, segments=segments[name], topics=topics[name])
            for name, section in sections.items()
        ]
        schema = pieces[0][1].schema
        table = pa.concat_tables(
            [rows if rows.schema.equals(schema) else rows.cast(schema) for _, rows in pieces]
        ).combine_chunks()
        reused = before.reusable() if before is not None and self._keeps_bytes else None
        in_front = False
        if reused is not None and before is not None:
            size = len(reused.data) * table.num_rows / max(before.about.rows, 1)
            in_front = size < reused.offset
        try:
            part = self._part(found, table, reused, in_front=in_front)
        except NoRoomError:
            part = self._part(found, table, reused, in_front=False)
        if self._recording in sections and not (self._is_listed and path.name in self._shared):
            self._list(path.parent, path.name)
        files.rename(part, path)

    def _part(
        self, sections: Sequence[Section], table: Any, reused: ReusedBytes | None, *, in_front: bool
    ) -> Path:
        """A finished file without its name."""
        parts = parts_folder(self._root, self._recording)
        files.make_folders(parts)
        self._numbers += 1
        part = parts / f"{SHARED}{self._numbers}{SUFFIX}"
        files.remove_tree(part)
        writer = ParquetFileWriter(
            part,
            table.schema,
            reused=reused,
            in_front=in_front,
        )
        try:
            writer.write(table)
            writer.close(sections, sync=True)
        except BaseException:
            writer.discard()
            raise
        return part

    def _publish(
        self, place: Path, parts: Sequence[Path], names: Collection[str], old: Sequence[str]
    ) -> None:
        """Give finished files their names: first those of the files that they replace."""
        taken, number, free = set(names), 0, list(old)
        for part in parts:
            if free:
                name = free.pop(0)
            else:
                while (name := f"{self._recording}-{number}{SUFFIX}") in taken:
                    number += 1
            taken.add(name)
            files.rename(part, place / name)
        for name in free:
            files.remove_tree(place / name)


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Lock the tables of a store for changes.

    Raises:
        FileNotFoundError: there are none.
    """
    with files.locked_folder(root / TABLES):
        yield


def _folders(root: Path) -> list[str]:
    """Names of the folders of tables."""
    found = files.names(root / TABLES).items()
    return sorted(name for name, about in found if "~" in name and S_ISDIR(about.st_mode))


def shared_files(root: Path, folder: str, recording: str = "") -> dict[str, set[str]]:
    """Names of the shared files of a folder, by the recordings in its list.

    A recording that is not listed may be in any of them.

    Args:
        root: The store.
        folder: Name of the folder.
        recording: Only this one; empty for all.
    """
    found: dict[str, set[str]] = {}
    path, wanted = _list_of(root / TABLES / folder), recording.encode()
    with suppress(OSError):
        for line in files.read_file(path, _MAX_LIST_BYTES).splitlines():
            content, _, checksum = line.rpartition(b" ")
            if line.startswith(wanted) and checksum == _checksum(content):
                known, *names = content.decode().split(" ")
                found.setdefault(known, set()).update(names)
    return found


def list_bytes(folder: Path) -> int:
    """Bytes of the list beside a folder; 0 without one."""
    try:
        return files.status(_list_of(folder)).st_size
    except OSError:
        return 0


def _list_of(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.recordings")


def _checksum(content: bytes) -> bytes:
    return f"{crc32(content):08x}".encode()


class Listing:
    """The entries of a folder, which are read again only after a change.

    Args:
        path: The folder.

    Attributes:
        names: The status of each entry, by name; empty without the folder.
    """

    def __init__(self, path: Path) -> None:
        self.names: dict[str, os.stat_result] = {}
        self._path = path
        self._read_at: tuple[int, int] | None = None  # inode, and time of its last change

    def look(self) -> bool:
        """Read the entries if they may have changed; returns whether it did.

        Raises:
            StoreError: they cannot be read.
        """
        try:
            now, names = files.changed_names(self._path, self._read_at)
            if names is None:
                return False
            self.names = names
        except FileNotFoundError:
            self.names, self._read_at = {}, None
            return True
        except OSError as error:
            raise unreadable(error, self._path) from error
        # A change within the same tick of the clock would have the same time.
        is_stable = time.time_ns() - now[1] > _STABLE_NS
        self._read_at = now if is_stable else None
        return True


def files_of(root: Path, prefixes: Collection[str] = ("",)) -> Iterator[ParquetFileReader]:
    """The tables in some folders; those that cannot be read are left out."""
    with suppress(OSError):
        for folder in _folders(root):
            if folder.startswith(tuple(prefixes)):
                for name in sorted(files.names(root / TABLES / folder)):
                    with suppress(OSError, StoreError):
                        yield ParquetFileReader(root / TABLES / folder / name)


def recordings_of(root: Path) -> set[str]:
    """Ids of all recordings with tables."""
    return {section.id for file in files_of(root) for section in file.about.recordings}


def _reader(path: Path) -> ParquetFileReader | None:
    """A shared file; one that cannot be read is removed, since all of it can be made again."""
    try:
        reader = ParquetFileReader(path)
        if not is_of_folder(path.parent.name, reader.schema):
            raise StoreError(f"The table {path} is of another folder.")
        return reader
    except FileNotFoundError:
        return None
    except StoreError as error:
        if isinstance(error.__cause__, PermissionError):
            raise error.__cause__ from error
        _log.info("%s", error)
        files.remove_tree(path)
        return None


def _all(_: str) -> bool:
    return True


def _by_topic(section: Section, rows: Any) -> Iterator[_Piece]:
    """Rows of a recording, those of each topic on their own."""
    before = 0
    for topic, counts in section.topics.items():
        yield replace(section, topics={topic: counts}), rows.slice(before, counts.rows)
        before += counts.rows
