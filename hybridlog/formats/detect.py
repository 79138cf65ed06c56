"""Opens any log by its content; names and extensions do not matter."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from stat import S_ISDIR, S_ISREG
from typing import TYPE_CHECKING, Final

from hybridlog.formats import LOGS, LogFormat, spool
from hybridlog.formats.joined import JoinedSource, Part, Total
from hybridlog.formats.reading import Damage, Source, cannot_open
from hybridlog.formats.rosbag2.directory import NAME, BagMetadata, locate, plain, read_metadata
from hybridlog.wording import listed
from hybridlog_storage.errors import SourceError
from hybridlog_storage.times import span_of

if TYPE_CHECKING:
    from pathlib import Path

_LONGEST = max(len(start) for log in LOGS for start in log.beginnings)
UNKNOWN: Final = LogFormat("unknown", "", "", (), (), has_end=True)
"""The format of other files."""


def open_source(path: Path) -> Source:
    """Open a log: a file, or the directory of a ROS 2 bag or of a split log.

    A directory without `metadata.yaml` is read when it holds exactly one log, or the
    parts of one log that was split.

    Raises:
        SourceError: Nothing can be read: the path is missing, not readable, empty, of an
            unknown kind, encrypted or of an old version, or a directory without a log. The
            message names the cause and the cure.
    """
    try:
        mode = path.stat().st_mode
        if S_ISDIR(mode):
            return _open_directory(path)
    except OSError as error:
        raise cannot_open(path, error) from error
    if path.name == NAME:
        return _open_directory(path.parent)
    if not S_ISREG(mode):
        raise SourceError(f"{path}: neither a file nor a directory; give the path of a log")
    metadata = read_metadata(path.parent)
    if isinstance(metadata, BagMetadata) and sniff(path)[0].rosbag2:
        files, _ = locate(path.parent, metadata)
        if path in files:
            return _join(path, {path: files[path]}, metadata)
    return _open_file(path)


def read_time_range(path: Path) -> tuple[int, int] | None:
    """Read a log to find its log time `[start, end)`, ns; None without messages.

    Raises:
        SourceError: As `open_source`.
    """
    first, last = 1 << 63, -1
    with open_source(path) as source:
        for batch in source.batches():
            if len(batch):
                first = min(first, int(batch.log_time.min()))
                last = max(last, int(batch.log_time.max()))
            source.extras.clear()
    return span_of(first, last) if first <= last else None


def open_parts(paths: Sequence[Path]) -> Source:
    """Open the parts of one split log, in their order, as one source.

    Raises:
        SourceError: As `open_source`.
    """
    return _join(paths[0], dict.fromkeys(paths), None, gaps=_gaps(paths))


def grouped_parts(paths: Sequence[Path]) -> list[list[Path]]:
    """Files of one directory, with the parts of each split log together and in order.

    The names of parts differ in their number, which begins with 0, and perhaps in their date.
    """
    groups: list[list[Path]] = []
    latest: dict[tuple[str, str], tuple[int, list[Path]]] = {}
    for path in sorted(paths, key=_natural):
        part = _PART.fullmatch(plain(path))
        group = [path]
        if part is not None:
            series, number = (_DATE.sub("", part["stem"]), part["end"]), int(part["number"])
            before, parts = latest.get(series, (number, group))
            if number > before:
                parts.append(path)
                latest[series] = number, parts
                continue
            if number == 0:
                latest[series] = number, group
        groups.append(group)
    return groups


def sniff(path: Path) -> tuple[LogFormat, bool]:
    """Detect the format of a file from its first bytes.

    Returns:
        The format, and whether the file is compressed with zstd.

    Raises:
        SourceError: It cannot be read.
    """
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


def _open_file(path: Path) -> Source:
    """Open a single file."""
    found, is_packed = sniff(path)
    if found is UNKNOWN:
        raise _unknown(path, is_packed=is_packed)
    return _join(path, {path: None}, None)


def _open_plain(path: Path) -> Source:
    """Open an uncompressed file with the reader of its format."""
    found, _ = sniff(path)
    if found is UNKNOWN:
        raise _unknown(path, is_packed=False)
    return found.open(path)


def _unknown(path: Path, *, is_packed: bool) -> SourceError:
    try:
        size = path.stat().st_size
    except OSError as error:
        return cannot_open(path, error)
    if size == 0:
        return SourceError(
            f"{path}: the file is empty; record or copy it again, there is nothing in it"
        )
    if is_packed:
        return SourceError(
            f"{path}: a zstd file that holds no log, or a damaged one; check it with `zstd -t`"
        )
    return SourceError(f"{path}: not a log of a known kind; hybridlog reads {_kinds()}")


def _kinds() -> str:
    """The logs that can be read."""
    *others, last = (log.files for log in LOGS)
    return f"{', '.join(others)} and {last}"


def _open_directory(folder: Path) -> Source:
    metadata = read_metadata(folder)
    if isinstance(metadata, BagMetadata):
        return _open_bag(folder, metadata)
    damage = [metadata] if isinstance(metadata, Damage) else []
    logs = _logs_in(folder)
    if not logs:
        raise SourceError(
            f"{folder}: a directory without a log; give one that holds {_kinds()}, or the path "
            "of a log itself"
        )
    if len(logs) > 1 and not _is_split(logs):
        names = listed((path.name for path in logs), 5)
        raise SourceError(
            f"{folder}: {len(logs)} logs that are not parts of one ({names}); give the path of "
            "one of them"
        )
    empty = [path for path in _empty_in(folder) if _continues(logs[0], path)]
    parts = sorted([*logs, *empty], key=_natural)
    return _join(folder, dict.fromkeys(parts), None, damage, gaps=_gaps(parts))


def _open_bag(folder: Path, metadata: BagMetadata) -> Source:
    """Open a ROS 2 bag with its metadata, which need not list all parts."""
    files, damage = locate(folder, metadata)
    if not files:
        return _open_renamed(folder, metadata, damage)
    names = {plain(path) for path in files}
    first = next((path for path in files if path.stat().st_size), None)
    more = [path for path in _empty_in(folder) if _continues(first, path)]
    unread: list[Damage] = []
    for path in _logs_in(folder):
        if path in files:
            continue
        if plain(path) in names:
            unread.append(_unread(path, f"it is another form of {plain(path)}", 0))
        elif _continues(first, path):
            more.append(path)
        else:
            reason = f"{NAME} does not list it, and its name is not that of a part of the bag"
            unread.append(_unread(path, f"{reason}; record it by its own path", _count_of(path)))
    if more:
        files = {path: files.get(path) for path in sorted({*files, *more}, key=_natural)}
    lost = {damaged.file for damaged in damage}
    gaps = [gap for gap in _gaps(list(files)) if gap.file not in lost]
    return _join(folder, files, metadata, damage, gaps=gaps, unread=unread)


def _open_renamed(folder: Path, metadata: BagMetadata, damage: Sequence[Damage]) -> Source:
    """Open the files of a ROS 2 bag whose metadata lists none of them.

    Raises:
        SourceError: There are none, or they are not parts of one log.
    """
    logs = _logs_in(folder)
    if not logs or (len(logs) > 1 and not _is_split(logs)):
        listed = ", ".join(metadata.files[:5]) or "no file"
        raise SourceError(
            f"{folder}: none of the files that its {NAME} lists is there ({listed}); put them "
            "beside it, or give the path of the file itself"
        )
    # With as many messages as listed, they are the listed files under other names.
    return _join(folder, dict.fromkeys(logs), metadata, gaps=[*damage, *_gaps(logs)])


def _continues(first: Path | None, path: Path) -> bool:
    """True if a file is another part of the log that the first one is a part of."""
    return first is not None and _is_split([first, path])


def _unread(path: Path, reason: str, lost: int | None) -> Damage:
    return Damage(path, None, None, f"the file is not read: {reason}", lost)


def _count_of(path: Path) -> int | None:
    """Number of messages of a log by its own index, None if unknown."""
    if sniff(path)[1]:
        return None
    try:
        with _open_plain(path) as source:
            return source.message_count
    except SourceError:
        return None


def _join(
    path: Path,
    files: Mapping[Path, int | None],
    metadata: BagMetadata | None,
    damage: Sequence[Damage] = (),
    *,
    gaps: Sequence[Damage] = (),
    unread: Sequence[Damage] = (),
) -> Source:
    """Open the files of one log as one source.

    Args:
        path: The opened path.
        files: The files in order, with their number of messages as listed.
        metadata: Metadata of the log.
        damage: Damage known beforehand.
        gaps: Files that may be missing, by the numbers of the others.
        unread: Files that are left out.

    Raises:
        SourceError: None of the files is a log.
    """
    parts: list[Part] = []
    formats: list[LogFormat] = []
    for file, count in files.items():
        try:
            found, is_packed = sniff(file)
        except SourceError:
            # Reading reports the damage; other files may be readable.
            found, is_packed = UNKNOWN, False
        has_packed = metadata is not None and metadata.packed_messages
        parts.append(Part(file, count, is_packed, has_packed))
        formats.append(found)
    known = [found for found in formats if found is not UNKNOWN]
    if not known:
        sniff(parts[0].path)
        raise _unknown(parts[0].path, is_packed=parts[0].packed)
    is_bag = metadata is not None and bool(known[0].rosbag2)
    total = None
    if metadata is not None and metadata.message_count is not None and path.is_dir():
        total = Total(path / NAME, metadata.message_count)
    source = JoinedSource(
        path,
        kind=known[0].rosbag2 if is_bag else "",
        profile="ros2" if is_bag else known[0].profile,
        parts=parts,
        opener=_open_plain,
        damage=damage,
        gaps=gaps,
        unread=unread,
        total=total,
    )
    source.look()
    source.kind = source.kind or known[0].name
    return source


def _files_in(folder: Path) -> list[tuple[Path, int]]:
    """The files directly in a folder, and their sizes in bytes."""
    try:
        names = [path for path in folder.iterdir() if not path.name.startswith(".")]
        return [(path, path.stat().st_size) for path in names if path.is_file()]
    except OSError as error:
        raise cannot_open(folder, error) from error


def _empty_in(folder: Path) -> list[Path]:
    """The empty files directly in a folder."""
    return [path for path, size in _files_in(folder) if not size]


def _logs_in(folder: Path) -> list[Path]:
    """The logs directly in a folder, in natural order of their names."""
    files = [path for path, size in _files_in(folder) if size]
    refused: SourceError | None = None
    logs = []
    for path in files:
        try:
            if sniff(path)[0] is not UNKNOWN:
                logs.append(path)
        except SourceError as error:
            refused = error
    if refused is not None and not logs:
        raise refused
    return sorted(logs, key=_natural)


def _natural(path: Path) -> list[tuple[int, str]]:
    return [
        (int(piece), "") if piece.isdecimal() else (-1, piece)
        for piece in re.split(r"([0-9]{1,18})", path.name)
    ]


# Names of the parts of a split log: `name_3.db3`, `name_2024-05-06-07-08-09_3.bag`, `3.mcap`.
_PART = re.compile(r"(?P<stem>|.*_)(?P<number>[0-9]{1,9})(?P<end>\.[A-Za-z0-9.]*)")
_DATE = re.compile(r"[0-9]{4}(?:[-_][0-9]{2}){5}")


def _is_split(logs: Sequence[Path]) -> bool:
    """True if files are the parts of one log, by their names and formats."""
    found = [_PART.fullmatch(plain(path)) for path in logs]
    series = {(_DATE.sub("", each["stem"]), each["end"]) for each in found if each is not None}
    numbers = {int(each["number"]) for each in found if each is not None}
    formats = {sniff(path)[0] for path in logs if path.stat().st_size}
    return None not in found and len(series) == len(formats) == 1 and len(numbers) == len(logs)


def _gaps(parts: Sequence[Path]) -> list[Damage]:
    """The damage for parts that are missing between others, by their numbers."""
    found = {
        int(part["number"]): (path, part)
        for path in parts
        if (part := _PART.fullmatch(plain(path))) is not None
    }
    if len(found) < len(parts):
        return []
    damage: list[Damage] = []
    for before, after in pairwise(sorted(found)):
        if after == before + 1:
            continue
        path, part = found[before]
        stem, number = _DATE.sub("*", part["stem"]), str(before + 1).zfill(len(part["number"]))
        what = "the file is" if after == before + 2 else f"parts {before + 1} to {after - 1} are"
        reason = f"{what} missing between {path.name} and {found[after][0].name}"
        damage.append(Damage(path.with_name(stem + number + part["end"]), None, None, reason, None))
    return damage
