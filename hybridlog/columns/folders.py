"""Changes of the folders of finished tables.

All changes are made under a lock on the folder `tables`. A shared file is replaced by one
rename, so readers find the old rows or the new ones.

The number in the name of a shared file is when the recording that began it was created; of the
first file 0. A recording comes to the last file of its time or before, and begins another one if
that is full. So one that is looked for is in that file, or else in one of those in front.
"""

from __future__ import annotations

import logging
import re
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from stat import S_ISDIR
from typing import Any, Final

import pyarrow as pa
from msgspec import Struct, field

from hybridlog.columns.column_file import ColumnFile, ColumnFileWriter
from hybridlog.columns.layout import SHARED, SUFFIX, TABLES, Section, parts_folder
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError

MAX_SHARED_ROWS: Final = 50_000
"""Maximum number of rows of several recordings in one file."""
MAX_SHARED_BYTES: Final = 4 << 20
"""Size from which a shared file gets no more recordings."""
MAX_SHARED_RECORDINGS: Final = 256
"""Maximum number of recordings in one file: each one that comes costs a look at all of them."""
_SHARED_NAME: Final = re.compile(rf"{SHARED}(\d{{20}}){re.escape(SUFFIX)}", re.ASCII)
_log = logging.getLogger(__name__)
_Piece = tuple[Section, Any]
"""Rows of a topic of a recording, and what they are."""


class Addition(Struct):
    """Rows of one recording for a folder: pieces of a shared file, and files of long topics."""

    pieces: list[_Piece] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)


class TableFolders:
    """Adds and removes tables of one recording, which this process has locked for writing.

    Without `created` (ns), the recording is looked for in all files.
    """

    def __init__(self, root: Path, recording: str, created: int | None) -> None:
        self._root = root
        self._recording = recording
        self._created = created

    def add(
        self,
        additions: Mapping[str, Addition],
        replaced: Collection[str] = (),
        prefixes: Collection[str] = (),
    ) -> None:
        """Add tables by folder, in place of older ones of the `replaced` topics.

        `prefixes` are beginnings of the names of folders that may have such tables.
        """
        with suppress(FileExistsError):
            files.make_folder(self._root / TABLES)
        with files.locked_folder(self._root / TABLES):
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
        """Remove all tables of the recording in folders whose names begin with a prefix."""
        with suppress(FileNotFoundError), files.locked_folder(self._root / TABLES):
            for name in _folders(self._root):
                if name.startswith(tuple(prefixes)):
                    self._change(name, Addition(), lambda _: True)

    def _change(self, folder: str, addition: Addition, goes: Callable[[str], bool] | None) -> None:
        """Remove older rows of topics that go, and add tables; an empty folder is removed."""
        place = self._root / TABLES / folder
        names = [n for n in files.names(place) if n.endswith(SUFFIX)]
        self._share(place, shared_for(shared_times(names), self._created), addition.pieces, goes)
        old: list[Path] = []
        own = f"{self._recording}-"
        if goes is not None:
            readers = map(_reader, (place / name for name in sorted(names) if name.startswith(own)))
            known = [reader for reader in readers if reader is not None]
            old = [one.path for one in known if all(goes(s.topic) for s in one.about.sections)]
        numbered = (f"{own}{number}{SUFFIX}" for number in count())
        free = (place / name for name in numbered if name not in names)
        for part, path in zip(addition.files, chain(old, free), strict=False):
            files.rename(part, path)
        for path in old[len(addition.files) :]:
            files.remove_tree(path)
        with suppress(OSError), files.folder(place.parent) as fd:
            files.system.rmdir(folder, dir_fd=fd)

    def _share(
        self,
        place: Path,
        names: Iterable[str],
        pieces: Sequence[_Piece],
        goes: Callable[[str], bool] | None,
    ) -> None:
        """Add rows to the shared file that has the recording, to the likeliest, or to a new one."""
        readers = (one for one in (_reader(place / name) for name in names) if one is not None)
        first = reader = next(readers, None)
        while goes is not None and reader is not None and not reader.about.has(self._recording):
            reader = next(readers, None)
        if goes is not None and reader is not None:
            self._rewrite(reader, pieces, goes)
            return
        own = _shared_name(0 if first is None else max(self._created or 0, 0))
        if (
            first is not None
            and pieces
            and (first.path.name == own or self._has_room(first, pieces))
        ):
            self._rewrite(first, pieces, lambda _: False)
        elif pieces:
            self._write(place / own, pieces)

    def _has_room(self, reader: ColumnFile, pieces: Sequence[_Piece]) -> bool:
        return (
            len({one.id for one in reader.about.sections}) < MAX_SHARED_RECORDINGS
            and reader.size_bytes < MAX_SHARED_BYTES
            and reader.rows + sum(one.rows for one, _ in pieces) <= MAX_SHARED_ROWS
        )

    def _rewrite(
        self, reader: ColumnFile, new: Sequence[_Piece], goes: Callable[[str], bool]
    ) -> None:
        """Replace a shared file by one with other rows of the recording."""
        pieces, topics = [*new], {section.topic for section, _ in new}
        try:
            table = reader.table()
            for before, section in reader.sections():
                stays = section.topic not in topics and not goes(section.topic)
                if section.id != self._recording or stays:
                    pieces.append((section, table.slice(before, section.rows)))
        except StoreError as error:
            # Its other recordings get their tables again when they are asked about.
            _log.info("%s", error)
        if pieces:
            self._write(reader.path, pieces)
        else:
            files.unlink(reader.path)

    def _write(self, path: Path, pieces: Iterable[_Piece]) -> None:
        """Write a shared file, and give it its name by one rename."""
        pieces = sorted(pieces, key=lambda one: (one[0].id, one[0].topic))
        found = [section for section, _ in pieces]
        schema = pieces[0][1].schema
        table = pa.concat_tables(
            [rows if rows.schema.equals(schema) else rows.cast(schema) for _, rows in pieces]
        ).combine_chunks()
        parts = parts_folder(self._root, self._recording)
        files.make_folders(parts)
        part = parts / f"{SHARED}{SUFFIX}"
        files.remove_tree(part)
        # A reader that knows the footer of the file before finds nothing at its places.
        front = bytes(1 + table.num_rows % 251)
        writer = ColumnFileWriter(part, table.schema, front=front)
        try:
            writer.write(table)
            writer.close(found, sync=True)
        except BaseException:
            writer.discard()
            raise
        files.rename(part, path)


def _folders(root: Path) -> list[str]:
    """Names of the folders of tables."""
    found = files.names(root / TABLES).items()
    return sorted(name for name, about in found if "~" in name and S_ISDIR(about.st_mode))


def shared_times(names: Iterable[str]) -> list[int]:
    """The numbers in the names of shared files, in order."""
    return sorted(int(found[1]) for found in map(_SHARED_NAME.fullmatch, names) if found)


def shared_for(times: Sequence[int], created: int | None) -> Iterator[str]:
    """Names of shared files that may have rows of a recording, likeliest first; `created` in ns."""
    end = len(times) if created is None else bisect_right(times, max(created, 0))
    return map(_shared_name, reversed(times[:end]))


def _shared_name(time: int) -> str:
    return f"{SHARED}{time:020d}{SUFFIX}"


def files_of(root: Path, prefixes: Collection[str] = ("",)) -> Iterator[ColumnFile]:
    """The tables in some folders; those that cannot be read are left out."""
    with suppress(OSError):
        for folder in _folders(root):
            if folder.startswith(tuple(prefixes)):
                for name in sorted(files.names(root / TABLES / folder)):
                    with suppress(OSError, StoreError):
                        yield ColumnFile(root / TABLES / folder / name)


def _reader(path: Path) -> ColumnFile | None:
    """A shared file; one that cannot be read is removed, since all of it can be made again."""
    try:
        return ColumnFile(path)
    except FileNotFoundError:
        return None
    except StoreError as error:
        if isinstance(error.__cause__, PermissionError):
            raise error.__cause__ from error
        _log.info("%s", error)
        files.remove_tree(path)
        return None
