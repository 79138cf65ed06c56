"""The files of logs: what they are by their content, and which belong together by their names."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from hybridlog.formats import LOGS, LogFormat, spool
from hybridlog.formats.reading import Damage, cannot_open, size_of
from hybridlog.formats.rosbag2.directory import plain
from hybridlog_storage.errors import SourceError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from hybridlog.formats.reading import Source

_LONGEST = max(len(start) for log in LOGS for start in log.beginnings)
UNKNOWN: Final = LogFormat("unknown", "", "", (), (), has_end=True)
"""The format of other files."""


def sniff(path: Path) -> tuple[LogFormat, bool]:
    """Detect the format of a file from its first bytes, and whether zstd has compressed it."""
    try:
        with path.open("rb") as file:
            head = file.read(_LONGEST)
    except OSError as error:
        raise cannot_open(path, error) from error
    is_packed = head.startswith(spool.ZSTD_MAGIC)
    if is_packed:
        head = spool.peek(path, _LONGEST)
    found = next((log for log in LOGS if head.startswith(log.beginnings)), UNKNOWN)
    return found, is_packed


class LogFile(Struct, frozen=True):
    """A file of a log.

    Attributes:
        format: Its format; `UNKNOWN` if it is empty, no log or cannot be read.
        is_packed: Whether it is compressed with zstd.
        messages: Number of messages by the metadata of the log, None if unknown.
    """

    path: Path
    format: LogFormat = UNKNOWN
    is_packed: bool = False
    messages: int | None = None

    @classmethod
    def at(cls, path: Path, messages: int | None = None) -> LogFile:
        """Look at a file; what is wrong with it is told when it is opened."""
        try:
            return cls(path, *sniff(path), messages)
        except SourceError:
            return cls(path, messages=messages)

    def open(self, unpacked: Path | None = None) -> Source:
        """Open the file, or what it has been unpacked to."""
        if self.format is not UNKNOWN:
            return self.format.open(unpacked or self.path)
        _, is_packed = sniff(self.path)
        reason = f"not a log of a known kind; hybridlog reads {kinds()}"
        if is_packed:
            reason = "a zstd file that holds no log, or a damaged one; check it with `zstd -t`"
        elif not size_of(self.path):
            reason = "the file is empty; record or copy it again, there is nothing in it"
        raise SourceError(f"{self.path}: {reason}")


def kinds() -> str:
    """The logs that can be read."""
    *others, last = (log.files for log in LOGS)
    return f"{', '.join(others)} and {last}"


def files_in(folder: Path) -> list[LogFile]:
    """The logs and the empty files directly in a folder, in natural order of their names."""
    files: list[LogFile] = []
    refused: SourceError | None = None
    try:
        paths = [p for p in folder.iterdir() if not p.name.startswith(".") and p.is_file()]
    except OSError as error:
        raise cannot_open(folder, error) from error
    for path in sorted(paths, key=natural):
        try:
            file = LogFile(path, *sniff(path))
            if file.format is not UNKNOWN or not size_of(path):
                files.append(file)
        except SourceError as error:
            refused = error
    if refused is not None and all(file.format is UNKNOWN for file in files):
        raise refused
    return files


# Names of the parts of a split log: `name_3.db3`, `name_2024-05-06-07-08-09_3.bag`, `3.mcap`.
_PART = re.compile(r"(?P<stem>|.*_)(?P<number>[0-9]{1,9})(?P<end>\.[A-Za-z0-9.]*)")
_DATE = re.compile(r"[0-9]{4}(?:[-_][0-9]{2}){5}")


def natural(path: Path) -> list[tuple[int, str]]:
    """A key that sorts names by the numbers in them."""
    return [
        (int(piece), "") if piece.isdecimal() else (-1, piece)
        for piece in re.split(r"([0-9]{1,18})", path.name)
    ]


def part_of(path: Path) -> tuple[tuple[str, str], int]:
    """The log that a file is a part of, and its number in it, by its name; 0 if it has none."""
    found = _PART.fullmatch(plain(path))
    if found is None:
        return (path.name, ""), 0
    return (_DATE.sub("*", found["stem"]), found["end"]), int(found["number"])


def grouped_parts(paths: Iterable[Path]) -> list[list[Path]]:
    """Files of one directory, with the parts of each split log together and in order.

    The names of parts differ in their number, which begins with 0, and perhaps in their date.
    """
    groups: list[list[Path]] = []
    latest: dict[tuple[str, str], tuple[int, list[Path]]] = {}
    for path in sorted(paths, key=natural):
        series, number = part_of(path)
        before, group = latest.get(series, (number, []))
        if number > before:
            group.append(path)
        else:
            groups.append(group := [path])
        if number == 0 or len(group) > 1:
            latest[series] = number, group
    return groups


def is_split(files: Sequence[LogFile]) -> bool:
    """True if files are the parts of one log, by their names and formats."""
    parts = {part_of(file.path) for file in files}
    formats = {file.format for file in files if file.format is not UNKNOWN}
    return len({series for series, _ in parts}) == len(formats) == 1 and len(parts) == len(files)


def missing_parts(files: Sequence[LogFile]) -> list[Damage]:
    """The damage for parts that are missing between others, by their numbers."""
    found = {part_of(file.path)[1]: file.path for file in files}
    damage: list[Damage] = []
    for before, after in pairwise(sorted(found)):
        part = _PART.fullmatch(plain(found[before]))
        if after == before + 1 or part is None:
            continue
        (stem, end), _ = part_of(found[before])
        number = str(before + 1).zfill(len(part["number"]))
        what = "the file is" if after == before + 2 else f"parts {before + 1} to {after - 1} are"
        reason = f"{what} missing between {found[before].name} and {found[after].name}"
        path = found[before].with_name(stem + number + end)
        damage.append(Damage(path, None, None, reason, None))
    return damage
