"""The journal of a recording: a list of its segments and events.

Segments cannot show that one of them is missing, and they never change once they are
sealed. So each recording has a journal: a text file that only grows. Each line is one
event with a checksum. A line is on the disk before the step that it announces: a segment
is listed before it gets its final name, a removal before the first file is deleted.
Segments and journal are the truth; everything else is derived from them.

A line is the CRC-32 of its JSON text in 8 hexadecimal digits, a space, the text, and a line
feed. Bytes behind the last line feed are a line cut short by a crash; the step that it
would have announced never began.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import StoreError, unreadable

JOURNAL: Final = "journal"
"""Name of the file in a recording's directory."""
MAX_JOURNAL: Final = 1 << 30
"""Largest journal that is read, bytes."""

BEGUN: Final = "begun"
SEALED: Final = "sealed"
ENDED: Final = "ended"
RENAMED: Final = "renamed"
TAGGED: Final = "tagged"
UNTAGGED: Final = "untagged"
NOTED: Final = "noted"
MARKED: Final = "marked"
UNMARKED: Final = "unmarked"
ADOPTED: Final = "adopted"
REMOVING: Final = "removing"
REBUILT: Final = "rebuilt"
EXPIRED: Final = "expired"
PINNED: Final = "pinned"
UNPINNED: Final = "unpinned"
RETAINED: Final = "retained"
RESERVED: Final = ("signature",)
"""Events of later versions; this version preserves and ignores them."""

Event = Mapping[str, Any]
"""The content of a line: `event`, `at` (ns since the epoch), and values of the event."""


def event(kind: str, /, **values: Any) -> dict[str, Any]:
    """An event with the present time."""
    return {"event": kind, "at": time.time_ns(), **values}


def encode(line: Event) -> bytes:
    """Encode an event as a line of the journal.

    Raises:
        ValueError: It is not representable in JSON.
    """
    text = json.dumps(line, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
    return b"%08x %b\n" % (crc32(text), text)


def decode(line: bytes) -> dict[str, Any] | None:
    """The event of a line without its line feed; None if the line is damaged."""
    if line[:9] != b"%08x " % crc32(line[9:]):
        return None
    try:
        value = json.loads(line[9:].decode())
    except (ValueError, RecursionError):
        return None
    is_event = isinstance(value, dict) and isinstance(value.get("event"), str)
    return value if is_event else None


@dataclass(frozen=True, slots=True)
class SealedSegment:
    """A segment as the journal lists it.

    Attributes:
        segment: Its number.
        file: Its name in the recording's directory.
        bytes: Its size.
        digest: Digest of its summary: `sha256:` and hexadecimal digits.
        channels: `id`, `topic`, `messages`, `payload_bytes`, `first`, `last` (log time, ns) of
            each channel in it.
        at: When the line about it was written, ns since the epoch; 0 if unknown.
    """

    segment: int
    file: str
    bytes: int
    digest: str
    channels: tuple[Mapping[str, Any], ...]
    at: int = 0

    @property
    def messages(self) -> int:
        """Number of messages in it."""
        return sum(int(c["messages"]) for c in self.channels)


@dataclass(frozen=True, slots=True)
class PayloadFile:
    """A file with the fields of expired messages of a topic.

    Attributes:
        file: Its path below the recording's `payloads`.
        bytes: Its size.
        digest: Digest of its footer: `sha256:` and hexadecimal digits.
        topic: The topic.
        messages: Number of messages in it.
    """

    file: str
    bytes: int
    digest: str
    topic: str
    messages: int


@dataclass(slots=True)
class JournalState:
    """The state of a recording after all events of its journal.

    Attributes:
        id: The recording's id, 32 hexadecimal digits; empty if no line states it.
        store: Id of the store that it belongs to.
        lacks_payloads: Whether it is a copy whose payloads have not been copied yet.
        begun: The first event; empty if it is lost.
        name: The present name.
        tags: The present tags.
        notes: Notes in the order of writing: `at` and `text`.
        marks: Marks set after the end: `time`, `text`, `tags`, `segment`; those that last, `end`.
        unmarked: Numbers of the segments of removed marks: their files are removed, too.
        pins: Pins by id: `id`, `from` and `to` (log times, ns), `topics`, `reason`; None for all.
        sealed: Segments by number.
        replaced: Segments that a crash shortened: as listed before, and as they are.
        payloads: Files of fields of expired messages, by path.
        deleted: Such files that others have replaced.
        expired: Topics with expired messages, by the number of their segment.
        thinned: Digest and size of each segment with expired chunks, by its number;
            a later one follows an earlier one.
        retained: Segments that a rule of retention was applied to: topics whose payloads have
            expired, None for all.
        end: The end of the recording; None while it is running.
        moving: Old and new label of a rename that is not finished, else None.
        removing: Whether a removal began.
        rebuilt: The reason why the journal was rebuilt; None for an original one.
        damaged: Numbers of lines, from 1, that cannot be read.
        lines: Number of whole lines.
        length: Bytes of whole lines.
        torn: Bytes behind the last line feed.
    """

    id: str = ""
    store: str = ""
    lacks_payloads: bool = False
    begun: dict[str, Any] = field(default_factory=dict)
    name: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    notes: list[dict[str, Any]] = field(default_factory=list)
    marks: list[dict[str, Any]] = field(default_factory=list)
    unmarked: set[int] = field(default_factory=set)
    pins: dict[str, dict[str, Any]] = field(default_factory=dict)
    sealed: dict[int, SealedSegment] = field(default_factory=dict)
    replaced: list[tuple[SealedSegment, SealedSegment]] = field(default_factory=list)
    payloads: dict[str, PayloadFile] = field(default_factory=dict)
    deleted: set[str] = field(default_factory=set)
    expired: dict[int, set[str]] = field(default_factory=dict)
    thinned: dict[int, list[tuple[str, int]]] = field(default_factory=dict)
    retained: dict[int, frozenset[str] | None] = field(default_factory=dict)
    end: dict[str, Any] | None = None
    moving: tuple[str, str] | None = None
    removing: bool = False
    rebuilt: str | None = None
    damaged: list[int] = field(default_factory=list)
    lines: int = 0
    length: int = 0
    torn: int = 0

    @property
    def is_proof(self) -> bool:
        """True if it is a complete list: no line of it was lost."""
        return bool(self.begun) and not self.damaged and self.rebuilt is None

    def take(self, line: Event) -> None:
        """Apply the next event.

        Raises:
            KeyError, TypeError, ValueError: A value of the event is missing or invalid.
        """
        name = line["event"]
        if name == BEGUN:
            self._begin(line)
        elif name == SEALED:
            self._seal(line)
        elif name == ENDED:
            self.end = end_of(line["end"])
        elif name == RENAMED:
            self._rename(line)
        elif name == ADOPTED:
            self.store = _text(line["store"])
            self.lacks_payloads |= line.get("lacks") == "payloads"
        elif name == EXPIRED:
            self._expire(line)
        elif name in {REMOVING, REBUILT}:
            self.removing |= name == REMOVING
            self.rebuilt = _text(line["reason"]) if name == REBUILT else self.rebuilt
        else:
            self._edit(line)

    def _edit(self, line: Event) -> None:
        """Apply an event of a user's command."""
        name = line["event"]
        if name == TAGGED:
            self.tags[_key(line["key"])] = _text(line["value"])
        elif name == UNTAGGED:
            self.tags.pop(_key(line["key"]), None)
        elif name == NOTED:
            self.notes.append(_values(line, {"at": _time, "text": _text}))
        elif name == MARKED:
            self._mark(line)
        elif name == UNMARKED:
            self._unmark(_segment(line["segment"]))
        elif name == PINNED:
            self._pin(line)
        elif name == UNPINNED:
            self.pins.pop(_text(line["id"]), None)
        elif name == RETAINED:
            self._retain(line)

    def _begin(self, line: Event) -> None:
        if self.begun:
            raise ValueError("a second beginning")
        said = description_of(line)
        self.store, self.begun = _text(line["store"]), {**_plain(line), **said}
        self.id, self.name, self.tags = said["id"], said["name"], dict(said["tags"])

    def _rename(self, line: Event) -> None:
        labels = line.get("from"), line.get("to")
        moving = None if labels == (None, None) else (_label(labels[0]), _label(labels[1]))
        self.name, self.moving = _text(line["name"]), moving

    def _mark(self, line: Event) -> None:
        mark = _values(line, _MARK)
        if line.get("end") is not None:
            mark["end"] = _time(line["end"])
            if mark["end"] < mark["time"]:
                raise ValueError("a mark that ends before it begins")
        # A mark whose segment a crash kept from being listed does not exist.
        self.marks = [m for m in self.marks if m["segment"] in self.sealed]
        self.marks.append(mark)

    def _unmark(self, number: int) -> None:
        left = [mark for mark in self.marks if mark["segment"] != number]
        if len(left) == len(self.marks) or number not in self.sealed:
            raise ValueError("it is no mark")
        self.marks = left
        del self.sealed[number]
        self.unmarked.add(number)

    def _pin(self, line: Event) -> None:
        pin = {name: check(line.get(name)) for name, check in _PIN.items()}
        if None not in (pin["from"], pin["to"]) and pin["to"] < pin["from"]:
            raise ValueError("a pin that ends before it begins")
        self.pins[pin["id"]] = pin

    def _retain(self, line: Event) -> None:
        topics = _TOPICS(line.get("topics"))
        for number in [_segment(one) for one in _list(line["segments"])]:
            before = self.retained.get(number, frozenset())
            whole = topics is None or before is None
            self.retained[number] = None if whole else frozenset({*(before or ()), *topics})

    def _seal(self, line: Event) -> None:
        channels = tuple(_values(channel, _CHANNEL) for channel in _list(line["channels"]))
        sealed = SealedSegment(**_values(line, _SEALED), channels=channels, at=_written(line))
        number, _ = sealed.segment, _number(sealed.messages)
        before = self.sealed.get(number)
        if before is not None and before.digest != sealed.digest:
            self.replaced.append((before, sealed))
        self.sealed[number] = sealed
        self.unmarked.discard(number)

    def _expire(self, line: Event) -> None:
        found = payload_files(line.get("files", ()))
        values = line.get("segments", ())
        segments = [_values(value, _REPLACED) for value in values]
        expired = [(one["segment"], {*map(_text, one.get("topics", ()))}) for one in values]
        deleted = {_text(path) for path in line.get("deleted", ())}
        self.payloads.update({file.file: file for file in found})
        for one in segments:
            self.thinned.setdefault(one["segment"], []).append((one["digest"], one["bytes"]))
        for segment, topics in expired:
            self.expired.setdefault(segment, set()).update(topics)
        self.deleted |= self.payloads.keys() & deleted
        for path in deleted:
            self.payloads.pop(path, None)


def _written(line: Event) -> int:
    """Time at which a line was written, ns; 0 if it does not say that."""
    try:
        return int(_time(line.get("at")))
    except ValueError:
        return 0


def payload_files(values: Iterable[Mapping[str, Any]]) -> list[PayloadFile]:
    """Files of fields as an event or a segment lists them.

    Raises:
        KeyError, TypeError, ValueError: A value is missing or invalid.
    """
    return [PayloadFile(**_values(value, _PAYLOAD_FILE)) for value in values]


def description_of(value: Mapping[str, Any]) -> dict[str, Any]:
    """The description of a recording in its first event or in a segment.

    Raises:
        KeyError, TypeError, ValueError: A value is missing or invalid.
    """
    return _values(value, _DESCRIPTION)


def end_of(value: Mapping[str, Any]) -> dict[str, Any]:
    """The end of a recording in an event or in a segment.

    Raises:
        KeyError, TypeError, ValueError: A value is missing or invalid.
    """
    return _with_known(value, _END)


def compacted_of(value: Mapping[str, Any]) -> dict[str, Any]:
    """The statement of a segment with expired chunks.

    Raises:
        KeyError, TypeError, ValueError: A value is missing or invalid.
    """
    return _with_known(value, _COMPACTED)


def loss_rows(values: object) -> list[dict[str, Any]]:
    """Rows of the loss ledger in an event or in a segment.

    Raises:
        KeyError, TypeError, ValueError: A value is missing or invalid.
    """
    rows = [{**_plain(row), **_values(row, _LOSS)} for row in _list(values)]
    for begin, end in ((row["from"], row["to"]) for row in rows):
        if (begin, end) != (None, None) and not begin <= end:
            raise ValueError("a loss that ends before it begins")
    return rows


def read_lines(data: bytes) -> Iterator[tuple[int, dict[str, Any] | None]]:
    """Number, from 1, and event of each whole line; None for a damaged line."""
    end = data.rfind(b"\n") + 1
    for number, line in enumerate(data[:end].split(b"\n")[:-1], 1):
        yield number, decode(line)


def parse(data: bytes) -> JournalState:
    """Parse the bytes of a journal. Unreadable lines are listed in `damaged`."""
    state = JournalState()
    state.length = data.rfind(b"\n") + 1
    state.torn = len(data) - state.length
    for number, line in read_lines(data):
        state.lines = number
        try:
            if line is None:
                raise ValueError("its checksum differs")
            if number == 1 and line["event"] != BEGUN:
                state.damaged.append(0)
            state.take(line)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            state.damaged.append(number)
    state.marks = [mark for mark in state.marks if mark["segment"] in state.sealed]
    return state


def read(recording: Path) -> JournalState | None:
    """Read the journal of a recording; None if it does not exist.

    Raises:
        StoreError: It cannot be read.
    """
    path = recording / JOURNAL
    try:
        data = files.read_file(path, MAX_JOURNAL)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise unreadable(error, path) from error
    if len(data) > MAX_JOURNAL:
        raise StoreError(f"{path} is too large to be a journal.")
    return parse(data)


class Journal:
    """The journal of one recording, open for appending. The user holds the recording's lock.

    Pins of a running recording need no lock: `append` alone keeps others out.

    Args:
        recording: The recording's directory.
        sync: Whether lines are forced to the disk before `append` returns.
        check: Called with the state before lines are appended; raises to append none.
    """

    def __init__(
        self,
        recording: Path,
        *,
        sync: bool = True,
        check: Callable[[JournalState], None] | None = None,
    ) -> None:
        self.path = recording / JOURNAL
        self._sync = sync
        self._check = check

    def append(self, *lines: Event) -> None:
        """Append lines; they are on the disk when this returns.

        An incomplete line left by a crash is cut off first. Nobody else appends meanwhile.

        Raises:
            DiskFullError: There is no room; the journal is as it was.
            StoreError: It cannot be written.
        """
        data = b"".join(map(encode, lines))
        flags = os.O_RDWR | os.O_CREAT
        try:
            fd = files.open_file(self.path, flags)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX)
                size = os.lseek(fd, 0, os.SEEK_END)
                whole = _whole(fd, size)
                if self._check is not None:
                    self._check(parse(os.pread(fd, whole, 0)))
                if whole < size:
                    files.system.truncate(fd, whole)
                os.lseek(fd, whole, os.SEEK_SET)
                try:
                    durability.write_all(fd, [data])
                    if self._sync:
                        files.system.sync(fd)
                except OSError:
                    # The announced step has not begun, so its line must not remain.
                    files.system.truncate(fd, whole)
                    raise
            finally:
                os.close(fd)
            if self._sync and size == 0:
                files.sync_folder(self.path.parent)
        except OSError as error:
            raise durability.explain(error, self.path, "writing") from error

    def replace(self, lines: Sequence[Event]) -> None:
        """Rewrite the journal; the previous one stays as `journal.old`.

        Raises:
            DiskFullError: There is no room; the journal is as it was.
            StoreError: It cannot be written.
        """
        try:
            old = files.read_file(self.path, MAX_JOURNAL)
        except FileNotFoundError:
            old = b""
        except OSError as error:
            raise durability.explain(error, self.path, "reading") from error
        if old:
            old_path = self.path.with_name(f"{JOURNAL}.old")
            durability.write_new(old_path, old)
        content = b"".join(map(encode, lines))
        durability.write_new(self.path, content)


def _whole(fd: int, size: int) -> int:
    """End of the last whole line."""
    at = size
    while at > 0:
        start = max(at - 65536, 0)
        found = os.pread(fd, at - start, start).rfind(b"\n")
        if found >= 0:
            return start + found + 1
        at = start
    return 0


# Checks of values. They raise KeyError, TypeError or ValueError.

_Check = Callable[[Any], Any]


def _values(value: Mapping[str, Any], checks: Mapping[str, _Check]) -> dict[str, Any]:
    return {name: check(value[name]) for name, check in checks.items()}


def _with_known(value: Mapping[str, Any], checks: Mapping[str, _Check]) -> dict[str, Any]:
    """Any values; those with a check may be missing."""
    known = {name: check for name, check in checks.items() if name in value}
    return {**_plain(value), **_values(value, known)}


def _text(value: object, like: str = ".*") -> str:
    """Text that a regular expression matches."""
    if not isinstance(value, str) or re.fullmatch(like, value, re.DOTALL) is None:
        raise TypeError("no text, or another one")
    value.encode()  # fails for half of a surrogate pair
    return value


def _number(value: object, within: range = range(1 << 48)) -> int:
    """By default a number of bytes or messages; a sum of many still has 64 bits."""
    if type(value) is not int or value not in within:  # a boolean is no number
        raise ValueError("no number, or one out of range")
    return value


def _list(value: object) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError("no list")
    return value


def _tags(value: Mapping[str, object]) -> dict[str, str]:
    return {_key(key): _text(of) for key, of in value.items()}


def _plain(value: Any, depth: int = 8) -> Any:
    """A value that the catalog and MongoDB can hold."""
    if depth and isinstance(value, Mapping):
        return {_key(key): _plain(inner, depth - 1) for key, inner in value.items()}
    if depth and isinstance(value, list):
        return [_plain(inner, depth - 1) for inner in value]
    if isinstance(value, str):
        return _text(value)
    if value is None or isinstance(value, bool):
        return value
    return value if isinstance(value, float) and math.isfinite(value) else _time(value)


def _or_none(check: _Check) -> _Check:
    return lambda value: None if value is None else check(value)


_name: Final = r"(?!\.{1,2}(/|$))[^/\0]{1,255}"  # of a file in a folder
_key: Final = partial(_text, like=r"[^\0]*")
_label: Final = partial(_text, like=rf"(?!\.){_name}")  # hidden ones are of interrupted work
_time: Final = partial(_number, within=range(-(1 << 62), 1 << 63))
_segment: Final = partial(_number, within=range(10**9))
_REPLACED: Final[Mapping[str, _Check]] = {"segment": _segment, "bytes": _number, "digest": _text}
_SEALED: Final[Mapping[str, _Check]] = {"file": partial(_text, like=_name), **_REPLACED}
_CHANNEL: Final[Mapping[str, _Check]] = {
    "id": partial(_number, within=range(1 << 16)),
    "topic": _text,
    **dict.fromkeys(("messages", "payload_bytes"), _number),
    **dict.fromkeys(("first", "last"), _time),
}
_PAYLOAD_FILE: Final[Mapping[str, _Check]] = {
    "file": partial(_text, like=f"{_name}/{_name}"),
    **dict.fromkeys(("bytes", "messages"), _number),
    **dict.fromkeys(("digest", "topic"), _text),
}
_COMPACTED: Final[Mapping[str, _Check]] = {
    "digest": _text,
    "bytes": _number,
    "files": payload_files,
}
_MARK: Final[Mapping[str, _Check]] = {
    "time": _time,
    "text": _text,
    "tags": _tags,
    "segment": _segment,
}
_TOPICS: Final = _or_none(lambda value: [_text(topic) for topic in _list(value)])
_PIN: Final[Mapping[str, _Check]] = {
    "id": _text,
    **dict.fromkeys(("from", "to"), _or_none(_time)),
    "topics": _TOPICS,
    "reason": lambda value: "" if value is None else _text(value),
}
_SOURCE: Final[Mapping[str, _Check]] = {
    **dict.fromkeys(("path", "kind", "profile", "fingerprint"), _text),
    "bytes": _number,
}
_DESCRIPTION: Final[Mapping[str, _Check]] = {
    "id": partial(_text, like="[0-9a-f]{32}"),
    "name": _text,
    "tags": _tags,
    "source": partial(_with_known, checks=_SOURCE),
    "created": _time,
}
_LOSS: Final[Mapping[str, _Check]] = {
    **dict.fromkeys(("cause", "reason"), _text),
    **dict.fromkeys(("file", "topic"), _or_none(_text)),
    **dict.fromkeys(("count", "offset", "length"), _or_none(_number)),
    **dict.fromkeys(("from", "to"), _or_none(_time)),
}
_END: Final[Mapping[str, _Check]] = {
    "status": partial(_text, like="complete|damaged|recovered"),
    "losses": loss_rows,
    "cut_bytes": _number,
    "damage": lambda value: [_text(reason) for reason in _list(value)],
}
