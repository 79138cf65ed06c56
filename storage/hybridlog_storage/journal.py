"""The journal of a recording: what must lie beside it, and what was done with it.

Segments alone cannot say that one of them is missing, and they never change once they are
sealed. So each recording has a journal: a text file that only grows. Each line is one
event, with a checksum. A line is on the disk before the step that it announces: a segment
is listed before it gets its final name, a removal before the first file goes. Segments and
journal together are the truth; all else is made from them.

A line is the CRC-32 of its JSON text in 8 hexadecimal digits, a space, the text, and a line
feed. What stands behind the last line feed is a line that a crash has cut short; the step
that it would have announced never began.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from hybridlog_storage import durability, files
from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import StoreError

JOURNAL: Final = "journal"
"""Name of the file in a recording's directory."""
MAX_JOURNAL: Final = 1 << 30
"""Bytes of a journal that are read at most."""

BEGUN: Final = "begun"
SEALED: Final = "sealed"
ENDED: Final = "ended"
RENAMED: Final = "renamed"
TAGGED: Final = "tagged"
UNTAGGED: Final = "untagged"
NOTED: Final = "noted"
MARKED: Final = "marked"
ADOPTED: Final = "adopted"
REMOVING: Final = "removing"
REBUILT: Final = "rebuilt"
RESERVED: Final = ("compacted", "expired", "signature")
"""Events of later versions; a reader of this one keeps them and passes over them."""

Event = Mapping[str, Any]
"""What a line says: `event`, `at` (ns since the epoch), and values of the event's own."""


def event(kind: str, /, **values: Any) -> dict[str, Any]:
    """An event that happens now."""
    return {"event": kind, "at": time.time_ns(), **values}


def encode(line: Event) -> bytes:
    """An event as a line of the journal.

    Raises:
        ValueError: It holds what JSON cannot say.
    """
    text = json.dumps(line, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
    return b"%08x %b\n" % (crc32(text), text)


def decode(line: bytes) -> dict[str, Any] | None:
    """The event that a line holds, without its line feed; None when it is damaged."""
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
    """What a journal says of a segment.

    Attributes:
        segment: Its number.
        file: Its name in the recording's directory.
        bytes: Its size.
        digest: Of its summary: `sha256:` and hexadecimal digits.
        channels: `id`, `topic`, `messages`, `payload_bytes`, `first`, `last` (log time, ns) of
            each channel in it.
    """

    segment: int
    file: str
    bytes: int
    digest: str
    channels: tuple[Mapping[str, Any], ...]

    @property
    def messages(self) -> int:
        """Messages in it."""
        return sum(int(c["messages"]) for c in self.channels)


@dataclass(slots=True)
class JournalState:
    """What a whole journal says of its recording.

    Attributes:
        id: The recording's, 32 hexadecimal digits; empty when no line says it.
        store: Id of the store that it belongs to.
        begun: The first event; empty when it is lost.
        name: As the user calls it now.
        tags: As they are now.
        notes: In the order in which they were written: `at` and `text`.
        marks: Those that were set after the end: `time`, `text`, `tags`, `segment`.
        sealed: By number of the segment.
        replaced: Segments that came out of a crash with less than was listed before: what was
            listed, and what is.
        end: How the recording ended; None while it goes on.
        moving: The label that its directory had when it was renamed, and the one that it was
            to get; None once it has got it.
        removing: Whether somebody began to remove it.
        rebuilt: Why the journal was written again; None for one that was there all the time.
        damaged: Numbers of lines, from 1, that cannot be read.
        lines: Number of whole lines.
        length: Bytes of whole lines.
        torn: Bytes behind the last line feed.
    """

    id: str = ""
    store: str = ""
    begun: dict[str, Any] = field(default_factory=dict)
    name: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    notes: list[dict[str, Any]] = field(default_factory=list)
    marks: list[dict[str, Any]] = field(default_factory=list)
    sealed: dict[int, SealedSegment] = field(default_factory=dict)
    replaced: list[tuple[SealedSegment, SealedSegment]] = field(default_factory=list)
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
        """Whether it lists all that there was: no line of it was lost."""
        return bool(self.begun) and not self.damaged and self.rebuilt is None

    def take(self, line: Event) -> None:
        """Take in the next event.

        Raises:
            KeyError, TypeError, ValueError: It lacks what such an event has.
        """
        name = line["event"]
        if name == BEGUN:
            self._begin(line)
        elif name == SEALED:
            self._seal(line)
        elif name == ENDED:
            self.end = dict(line["end"])
        elif name == RENAMED:
            labels = line.get("from"), line.get("to")
            moving = (_text(labels[0]), _text(labels[1])) if any(labels) else None
            self.name, self.moving = _text(line["name"]), moving
        elif name == TAGGED:
            self.tags[_text(line["key"])] = _text(line["value"])
        elif name == UNTAGGED:
            self.tags.pop(_text(line["key"]), None)
        elif name == NOTED:
            self.notes.append({"at": int(line["at"]), "text": _text(line["text"])})
        elif name == MARKED:
            mark = {
                "time": int(line["time"]),
                "text": _text(line["text"]),
                "tags": _tags(line["tags"]),
                "segment": int(line["segment"]),
            }
            # One that a crash has cut short before its segment was listed was told in vain.
            self.marks = [m for m in self.marks if m["segment"] in self.sealed]
            self.marks.append(mark)
        elif name == ADOPTED:
            self.store = _text(line["store"])
        elif name == REMOVING:
            self.removing = True
        elif name == REBUILT:
            self.rebuilt = _text(line["reason"])

    def _begin(self, line: Event) -> None:
        if self.begun:
            raise ValueError("a second beginning")
        recording = _text(line["id"])
        if len(recording) != 32 or set(recording) - set("0123456789abcdef"):
            raise ValueError("an id that is none")
        said = _text(line["store"]), _text(line["name"]), _tags(line["tags"])
        self.store, self.name, self.tags = said
        self.id, self.begun = recording, dict(line)

    def _seal(self, line: Event) -> None:
        channels = tuple(
            {
                "id": int(c["id"]),
                "topic": _text(c["topic"]),
                "messages": int(c["messages"]),
                "payload_bytes": int(c["payload_bytes"]),
                "first": int(c["first"]),
                "last": int(c["last"]),
            }
            for c in line["channels"]
        )
        number = int(line["segment"])
        file = _text(line["file"])
        if Path(file).name != file or file in {"", ".."}:
            raise ValueError("a name that leads elsewhere")
        sealed = SealedSegment(number, file, int(line["bytes"]), _text(line["digest"]), channels)
        before = self.sealed.get(number)
        if before is not None and before.digest != sealed.digest:
            self.replaced.append((before, sealed))
        self.sealed[number] = sealed


def read_lines(data: bytes) -> Iterator[tuple[int, dict[str, Any] | None]]:
    """Number, from 1, and event of each whole line; None for one that is damaged."""
    end = data.rfind(b"\n") + 1
    for number, line in enumerate(data[:end].split(b"\n")[:-1], 1):
        yield number, decode(line)


def parse(data: bytes) -> JournalState:
    """What the bytes of a journal say. Lines that cannot be read are listed in `damaged`."""
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
    """What the journal of a recording says; None when there is none.

    Args:
        recording: Its directory.

    Raises:
        StoreError: It cannot be read.
    """
    path = recording / JOURNAL
    try:
        data = files.read_file(path, MAX_JOURNAL)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror}.") from error
    if len(data) > MAX_JOURNAL:
        raise StoreError(f"{path} is too large to be a journal.")
    return parse(data)


class Journal:
    """The journal of one recording, open for appending; whoever has it holds the recording.

    Args:
        recording: The recording's directory.
        sync: Whether lines are forced to the disk before `append` returns.
    """

    def __init__(self, recording: Path, *, sync: bool = True) -> None:
        self.path = recording / JOURNAL
        self._sync = sync

    def append(self, *lines: Event) -> None:
        """Add lines; they are on the disk when this returns.

        What a crash has left of a line is cut off first.

        Raises:
            DiskFullError: There is no room; the journal is as it was.
            StoreError: It cannot be written.
        """
        data = b"".join(map(encode, lines))
        flags = os.O_RDWR | os.O_CREAT
        try:
            fd = files.open_file(self.path, flags, depth=files.IN_RECORDING)
            try:
                size = os.lseek(fd, 0, os.SEEK_END)
                whole = _whole(fd, size)
                if whole < size:
                    files.system.truncate(fd, whole)
                os.lseek(fd, whole, os.SEEK_SET)
                try:
                    durability.write_all(fd, [data])
                    if self._sync:
                        files.system.sync(fd)
                except OSError:
                    # What was announced is not begun, so it must not stand there.
                    files.system.truncate(fd, whole)
                    raise
            finally:
                os.close(fd)
            if self._sync and size == 0:
                files.sync_folder(self.path.parent)
        except OSError as error:
            raise durability.explain(error, self.path, "writing") from error

    def replace(self, lines: Sequence[Event]) -> None:
        """Write the journal again; the one that was there is kept as `journal.old`.

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
            durability.write_new(old_path, old, depth=files.IN_RECORDING)
        content = b"".join(map(encode, lines))
        durability.write_new(self.path, content, depth=files.IN_RECORDING)


def _whole(fd: int, size: int) -> int:
    """Where the last whole line ends."""
    at = size
    while at > 0:
        start = max(at - 65536, 0)
        found = os.pread(fd, at - start, start).rfind(b"\n")
        if found >= 0:
            return start + found + 1
        at = start
    return 0


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError("no text")
    return value


def _tags(value: object) -> dict[str, str]:
    if not isinstance(value, dict):
        raise TypeError("no tags")
    return {_text(key): _text(of) for key, of in value.items()}
