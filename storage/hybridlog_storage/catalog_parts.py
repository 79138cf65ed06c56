"""The parts of a catalog: small files of lines, each replaced as a whole.

A part has everything about some recordings. Its first line has the version, the store, and the
size of the file. Each other line is `checksum kind key text`, in ASCII, sorted so that a reader
who lists recordings can stop early. What fails its checksum is left out, and is made again by
whoever misses it.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from urllib.parse import quote, unquote

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files

VERSION: Final = 8
MAX_PART_BYTES: Final = 48 << 10
"""Size of a part from which it takes no more recordings."""
SUMMARY: Final = "0-summary"
DAMAGE: Final = "0-damage"
ENTRY: Final = "2-entry"
STAMPS: Final = "2-stamps-"
"""Kinds of the lines of a recording, whose key is its id; the number of a segment follows
`STAMPS`."""
TOPICS: Final = "0-topics"
"""Kind of the lines with sets of topics; the key is a hash."""
BOUNDS: Final = "1-bounds-"
"""Beginning of the kinds of lines with bounds; what they are bounds of follows."""
_OF_RECORDING: Final = (SUMMARY, DAMAGE, ENTRY, STAMPS, BOUNDS)
_DETAILS: Final = (b"1-", b"2-")
_PART = re.compile(r"part-(\d{6,12})")
_HEAD = re.compile(rb"hybridlog catalog (\d+) (\S*) (\d{10})\n")
_LINE_BYTES: Final = 64  # of a line besides its text
_MAX_BYTES: Final = 1 << 30
_TICK_NS: Final = 50_000_000

Version = tuple[int, ...]


def part_name(number: int) -> str:
    """The name of the file of a part."""
    return f"part-{number:06d}"


def number_of(name: str) -> int | None:
    """The number of a part by the name of its file; None for other files."""
    found = _PART.fullmatch(name)
    return int(found[1]) if found is not None else None


def is_of_another(store: str, data: bytes) -> bool:
    """True if a file is a part of another store's catalog, or of another version."""
    head = _HEAD.match(data)
    return head is not None and (head[1], head[2]) != (b"%d" % VERSION, store.encode())


@dataclass(slots=True)
class PartContent:
    """The content of a part.

    Attributes:
        rows: For each recording, by id, its texts by kind.
        shared: Texts of other lines, by kind and key.
        is_whole: False if anything in what was read is damaged.
    """

    rows: dict[str, dict[str, str]] = field(default_factory=dict)
    shared: dict[tuple[str, str], str] = field(default_factory=dict)
    is_whole: bool = True

    @property
    def size(self) -> int:
        """Bytes of the file, about."""
        texts = [*self.shared.values(), *(t for row in self.rows.values() for t in row.values())]
        return sum(len(text) + _LINE_BYTES for text in texts)

    def to_bytes(self, store: str) -> bytes:
        """The file, for the catalog of a store."""
        lines = [(kind, key, text) for (kind, key), text in self.shared.items()]
        for recording, row in self.rows.items():
            listed = {DAMAGE: "[]", **row}  # the list says that it is here
            lines += [(kind, quote(recording, safe=""), text) for kind, text in listed.items()]
        texts = [" ".join(line).encode("ascii") for line in sorted(lines)]
        body = b"".join(b"%08x %s\n" % (crc32(text), text) for text in texts)
        return b"hybridlog catalog %d %s %010d\n" % (VERSION, store.encode(), len(body)) + body

    @classmethod
    def from_bytes(cls, store: str, data: bytes, *, is_list: bool = False) -> PartContent:
        """The content of a file, without what is damaged.

        Args:
            store: Id of the store.
            data: The file.
            is_list: Read only what is needed to list recordings, and to choose among them.
        """
        head = _HEAD.match(data)
        if head is None or is_of_another(store, data):
            return cls(is_whole=False)
        found = cls(is_whole=head.end() + int(head[3]) == len(data))
        begin = head.end()
        while begin < len(data):
            end = data.find(b"\n", begin) % (len(data) + 1)
            if is_list and data.startswith(_DETAILS, begin + 9):
                break
            found.add_line(data[begin : begin + 8], data[begin + 9 : end])
            begin = end + 1
        return found

    def add_line(self, checksum: bytes, line: bytes) -> None:
        """Add a line, without its checksum; a damaged one is left out."""
        if checksum != b"%08x" % crc32(line):
            self.is_whole = False
            return
        kind, key, text = line.decode("ascii").split(" ", 2)
        if kind.startswith(_OF_RECORDING):
            self.rows.setdefault(unquote(key), {})[kind] = text
        else:
            self.shared[kind, key] = text


def bounds_in(data: bytes) -> bytes:
    """The lines of a part with bounds, and perhaps some before them."""
    begin = data.find(f" {BOUNDS}".encode("ascii"))
    end = data.find(f" {ENTRY} ".encode("ascii"), begin)
    return data[max(begin - 8, 0) : end] if begin >= 0 else b""


def texts_in(lines: bytes, kind: str) -> dict[str, str]:
    """The texts of one kind among some lines by key, without damaged ones."""
    wanted = f"{kind} ".encode("ascii")
    found = PartContent()
    for line in lines.splitlines():
        if line.startswith(wanted, 9):
            found.add_line(line[:8], line[9:])
    return {key: row[kind] for key, row in found.rows.items()}


class MemoryFolder:
    """Files in memory, for a store that this user cannot write."""

    def __init__(self) -> None:
        self._contents: dict[str, tuple[bytes, Version]] = {}
        self._changes = 0

    def has_changed(self) -> bool:
        """True if `versions` may differ from what it was."""
        return True

    def versions(self) -> dict[str, Version]:
        """A value for each file by name, which changes with its content."""
        return {name: version for name, (_, version) in self._contents.items()}

    def read(self, name: str) -> bytes:
        """The content of a file.

        Raises:
            FileNotFoundError: It does not exist.
        """
        if name not in self._contents:
            raise FileNotFoundError(name)
        return self._contents[name][0]

    def write(self, name: str, data: bytes) -> None:
        """Create or replace a file."""
        self._changes += 1
        self._contents[name] = data, (self._changes,)

    def remove(self, name: str) -> None:
        """Remove a file, if it exists."""
        self._contents.pop(name, None)

    @contextmanager
    def lock(self, _wait_s: float) -> Iterator[None]:
        """Nothing: no other process has these files."""
        yield


class DiskFolder(MemoryFolder):
    """The folder of a catalog in a store.

    A reader sees each file as it was before a change, or after it. Writers take turns.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._seen: Version | None = None

    def has_changed(self) -> bool:
        """True if `versions` may differ from what it was."""
        with suppress(OSError):
            return self._seen is None or self._look() != self._seen
        return True

    def _look(self) -> Version:
        about = files.status(self.path)
        return about.st_ino, about.st_mtime_ns

    def versions(self) -> dict[str, Version]:
        """A value for each file by name, which changes with its content.

        Raises:
            OSError: The folder cannot be read.
        """
        self._seen = None
        try:
            before = self._look()
            found = files.names(self.path)
        except FileNotFoundError:
            return {}
        # Within a tick of the clock another change would show the same time.
        now = time.time_ns()
        self._seen = before if abs(now - before[1]) > _TICK_NS else None
        return {
            name: (about.st_ino, about.st_size, about.st_mtime_ns)
            + ((now,) if abs(now - about.st_mtime_ns) < _TICK_NS else ())
            for name, about in found.items()
        }

    def read(self, name: str) -> bytes:
        """The content of a file.

        Raises:
            OSError: It cannot be read, or is not an ordinary file.
        """
        return files.read_file(self.path / name, _MAX_BYTES)

    def write(self, name: str, data: bytes) -> None:
        """Create or replace a file. It is derived, so it is not forced to the disk.

        Raises:
            OSError: It cannot be written.
        """
        files.write_file(self.path / name, data, sync=False)

    def remove(self, name: str) -> None:
        """Remove a file, if it exists.

        Raises:
            OSError: It cannot be removed.
        """
        files.remove_tree(self.path / name)

    @contextmanager
    def lock(self, wait_s: float) -> Iterator[None]:
        """Keep other writers away.

        Raises:
            BlockingIOError: Another process has been writing for longer.
            OSError: The folder cannot be made, or opened.
        """
        with suppress(FileExistsError):
            files.make_folder(self.path)
        with files.locked_folder(self.path, wait_s):
            yield
