"""Finds logs below a directory, once or as they become complete."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from stat import S_ISREG
from typing import NamedTuple

from msgspec import Struct, field

from hybridlog.formats import LOGS
from hybridlog.formats.log_set import NAME, UNKNOWN, LogFile, LogSet, grouped_parts, read_metadata
from hybridlog.formats.reading import cannot_open
from hybridlog_storage.errors import SourceError
from hybridlog_storage.settings import NAME as STORE

SETTLE_S = 60.0
"""Seconds without a change after which a file counts as complete, if it does not say so."""
_SUFFIXES = tuple(suffix for log in LOGS for suffix in log.suffixes)
_MCAP_END = b"\x89MCAP0\r\n"
_BAG_INDEX = b"index_pos="
_BAG_HEAD = 8192  # bytes; the header record of a bag has 4 KiB


class Found(Struct):
    """Logs by path, and what is unreadable below a directory."""

    logs: list[LogSet] = field(default_factory=list)
    problems: list[SourceError] = field(default_factory=list)

    def is_one_log(self, top: Path) -> bool:
        """True if a directory is the bag, or its parts are all there is below it."""
        return len(self.logs) == 1 and top in {self.logs[0].path, self.logs[0].path.parent}


class _File(NamedTuple):
    """A file, with what changes when it is written."""

    path: Path
    size: int
    changed: int  # ns since the epoch
    inode: int


def find_logs(top: Path) -> Found:
    """All logs below a directory.

    A ROS 2 bag is one log, and so are the parts of a split one, whose numbers begin with 0.
    Symlinks are followed, but no directory is searched twice. Hidden files, stores, and
    databases that are not called `.db3` are left out.
    """
    found = Found()
    for folder, files in _folders(top, found):
        known = {file.path: log for file in files if (log := _log_file(file, found.problems))}
        listed = _listed(folder, files)
        bags: list[LogSet] = []
        for parts in grouped_parts(known):
            if listed.isdisjoint(path.name for path in parts):
                found.logs.append(LogSet.of([known[path] for path in parts]))
            elif not bags:
                found.logs += (bags := [LogSet.at(folder)])
    return found


class Watch:
    """Finds logs below a directory as they become complete, by looking again and again.

    A file that was written since the last look is not complete. An MCAP file or a bag says
    itself when it ends, or `metadata.yaml` lists it; databases and compressed files are complete
    when they have not changed for some time. Each file is a log of its own, but for ROS 2
    bags that are complete when they are met.

    Attributes:
        unfinished: Logs that were not complete at the last look.
    """

    def __init__(self, top: Path, settle_s: float = SETTLE_S) -> None:
        self._top = top
        self._settle_ns = round(settle_s * 1e9)
        self._seen: set[_File] = set()  # at the last look
        self._done: set[_File] = set()  # taken, or no log
        self.unfinished: list[Path] = []

    def look(self) -> Found:
        """The logs that have become complete since the last look.

        It lists the directories, and reads the beginnings and ends of files that are not taken.
        """
        found = Found()
        seen: set[_File] = set()
        self.unfinished.clear()
        for folder, files in _folders(self._top, found):
            seen.update(files)
            if not self._done.issuperset(files):
                found.logs += self._complete_in(folder, files, found.problems)
        self._seen = seen
        self._done &= seen
        return found

    def put_back(self, logs: Sequence[LogSet]) -> None:
        """Find logs again at the next look."""
        files = {path for log in logs for path in log.files}
        self._done = {file for file in self._done if file.path not in files}

    def _complete_in(
        self, folder: Path, files: Sequence[_File], problems: list[SourceError]
    ) -> Iterator[LogSet]:
        new = [file for file in files if file.size and file not in self._done]
        listed = _listed(folder, files)
        names = {file.path.name for file in files}
        ready: dict[_File, LogFile] = {}
        for file in new:
            log = _log_file(file, problems)
            if log is None:
                self._done.add(file)
            elif self._is_complete(file, log, names, listed):
                ready[file] = log
            else:
                self.unfinished.append(file.path)
        self._done.update(ready)
        if listed and listed.issubset(file.path.name for file in ready):
            yield LogSet.at(folder)
            ready = {file: log for file, log in ready.items() if file.path.name not in listed}
        yield from (LogSet.of([log]) for log in ready.values())

    def _is_complete(self, file: _File, log: LogFile, names: set[str], listed: set[str]) -> bool:
        """True if nobody writes a file any more; `names` are of the files beside it."""
        is_unchanged = time.time_ns() - file.changed >= self._settle_ns
        if not is_unchanged and file not in self._seen:
            return False
        if file.path.name in listed or _has_end(file):
            return True
        if log.format.has_end and not file.path.name.endswith(".zstd"):
            return False
        beside = {f"{file.path.name}{suffix}" for suffix in ("-wal", "-journal")}
        return is_unchanged and not beside & names


def _folders(top: Path, found: Found) -> Iterator[tuple[Path, list[_File]]]:
    """Directories below one, itself included, and the regular files in each, by name."""

    def failed(error: OSError) -> None:
        problem = cannot_open(Path(error.filename), error)
        if Path(error.filename) == top:
            raise problem from error
        found.problems.append(problem)

    visited = set()
    for place, below, names in os.walk(top, onerror=failed, followlinks=True):
        folder, about = Path(place), Path(place).stat()
        if STORE in names or (about.st_dev, about.st_ino) in visited:
            below.clear()
            continue
        visited.add((about.st_dev, about.st_ino))
        below[:] = sorted(name for name in below if not name.startswith("."))
        files = []
        for name in sorted(name for name in names if not name.startswith(".")):
            with suppress(OSError):  # a symlink to nowhere, or a file that has just gone
                about = (folder / name).stat()
                if S_ISREG(about.st_mode):
                    own = about.st_size, about.st_mtime_ns, about.st_ino
                    files.append(_File(folder / name, *own))
        yield folder, files


def _log_file(file: _File, problems: list[SourceError]) -> LogFile | None:
    """A log; None for other files. A wrong file with the name of a log is one."""
    is_called = file.path.name.removesuffix(".zstd").endswith(_SUFFIXES)
    log = LogFile.at(file.path) if file.size else LogFile(file.path)
    if log.problem is not None:
        problems += [log.problem] if is_called else []
        return None
    return log if is_called or not (log.format is UNKNOWN or log.format.needs_suffix) else None


def _listed(folder: Path, files: Sequence[_File]) -> set[str]:
    """The names that the metadata of the ROS 2 bag in a directory lists; none without."""
    bag = read_metadata(folder)[0] if any(file.path.name == NAME for file in files) else None
    return set() if bag is None else {*bag.files}


def _has_end(file: _File) -> bool:
    """True if an MCAP file or a bag has the end that its writer gives it."""
    try:
        with file.path.open("rb") as opened:
            head = opened.read(_BAG_HEAD)
            opened.seek(max(0, file.size - len(_MCAP_END)))
            tail = opened.read()
    except OSError:
        return False
    if head.startswith(_MCAP_END):
        return file.size > len(_MCAP_END) and tail == _MCAP_END
    _, _, place = head.partition(_BAG_INDEX)
    return head.startswith(b"#ROSBAG V2.0") and 0 < int.from_bytes(place[:8], "little") <= file.size
