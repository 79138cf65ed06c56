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

import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from hybridlog_storage import durability, files
from hybridlog_storage.checksum import crc32
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
ADOPTED: Final = "adopted"
REMOVING: Final = "removing"
REBUILT: Final = "rebuilt"
COMPACTED: Final = "compacted"
RESERVED: Final = ("expired", "signature")
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
    """

    segment: int
    file: str
    bytes: int
    digest: str
    channels: tuple[Mapping[str, Any], ...]

    @property
    def messages(self) -> int:
        """Number of messages in it."""
        return sum(int(c["messages"]) for c in self.channels)


@dataclass(frozen=True, slots=True)
class PayloadFile:
    """A file with payloads of a topic as columns.

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
        begun: The first event; empty if it is lost.
        name: The present name.
        tags: The present tags.
        notes: Notes in the order of writing: `at` and `text`.
        marks: Marks set after the end: `time`, `text`, `tags`, `segment`.
        sealed: Segments by number.
        replaced: Segments that a crash shortened: as listed before, and as they are.
        payloads: Files of payloads, by path.
        thinned: Digest and size of each segment without moved chunks, by its number; a later
            one follows an earlier one.
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
    begun: dict[str, Any] = field(default_factory=dict)
    name: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    notes: list[dict[str, Any]] = field(default_factory=list)
    marks: list[dict[str, Any]] = field(default_factory=list)
    sealed: dict[int, SealedSegment] = field(default_factory=dict)
    replaced: list[tuple[SealedSegment, SealedSegment]] = field(default_factory=list)
    payloads: dict[str, PayloadFile] = field(default_factory=dict)
    thinned: dict[int, list[tuple[str, int]]] = field(default_factory=dict)
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
            self.end = dict(line["end"])
        elif name == RENAMED:
            self._rename(line)
        elif name == TAGGED:
            self.tags[_text(line["key"])] = _text(line["value"])
        elif name == UNTAGGED:
            self.tags.pop(_text(line["key"]), None)
        elif name == NOTED:
            self.notes.append({"at": int(line["at"]), "text": _text(line["text"])})
        elif name == MARKED:
            self._mark(line)
        elif name == ADOPTED:
            self.store = _text(line["store"])
        elif name == COMPACTED:
            self._compact(line)
        elif name in {REMOVING, REBUILT}:
            self.removing |= name == REMOVING
            self.rebuilt = _text(line["reason"]) if name == REBUILT else self.rebuilt

    def _begin(self, line: Event) -> None:
        if self.begun:
            raise ValueError("a second beginning")
        recording = _text(line["id"])
        if len(recording) != 32 or set(recording) - set("0123456789abcdef"):
            raise ValueError("an id that is none")
        said = _text(line["store"]), _text(line["name"]), _tags(line["tags"])
        self.store, self.name, self.tags = said
        self.id, self.begun = recording, dict(line)

    def _rename(self, line: Event) -> None:
        labels = line.get("from"), line.get("to")
        moving = (_text(labels[0]), _text(labels[1])) if any(labels) else None
        self.name, self.moving = _text(line["name"]), moving

    def _mark(self, line: Event) -> None:
        mark = {
            "time": int(line["time"]),
            "text": _text(line["text"]),
            "tags": _tags(line["tags"]),
            "segment": int(line["segment"]),
        }
        # A mark whose segment a crash kept from being listed does not exist.
        self.marks = [m for m in self.marks if m["segment"] in self.sealed]
        self.marks.append(mark)

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

    def _compact(self, line: Event) -> None:
        found = payload_files(line.get("files", ()))
        segments = [
            (int(value["segment"]), (_text(value["digest"]), int(value["bytes"])))
            for value in line.get("segments", ())
        ]
        self.payloads.update({file.file: file for file in found})
        for number, written in segments:
            self.thinned.setdefault(number, []).append(written)


def payload_files(values: Iterable[Mapping[str, Any]]) -> list[PayloadFile]:
    """Files of payloads as an event or a segment lists them.

    Raises:
        KeyError, TypeError, ValueError: A value is missing or invalid.
    """
    return [
        PayloadFile(
            _inner_path(value["file"]),
            int(value["bytes"]),
            _text(value["digest"]),
            _text(value["topic"]),
            int(value["messages"]),
        )
        for value in values
    ]


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
        raise unreadable(error, path) from error
    if len(data) > MAX_JOURNAL:
        raise StoreError(f"{path} is too large to be a journal.")
    return parse(data)


class Journal:
    """The journal of one recording, open for appending. The user holds the recording's lock.

    Args:
        recording: The recording's directory.
        sync: Whether lines are forced to the disk before `append` returns.
    """

    def __init__(self, recording: Path, *, sync: bool = True) -> None:
        self.path = recording / JOURNAL
        self._sync = sync

    def append(self, *lines: Event) -> None:
        """Append lines; they are on the disk when this returns.

        An incomplete line left by a crash is cut off first.

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
            durability.write_new(old_path, old, depth=files.IN_RECORDING)
        content = b"".join(map(encode, lines))
        durability.write_new(self.path, content, depth=files.IN_RECORDING)


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


def _inner_path(value: object) -> str:
    """A path of a folder and a file in it."""
    path = _text(value)
    names = path.split("/")
    if len(names) != 2 or any(name in {"", ".", ".."} or "\0" in name for name in names):
        raise ValueError("a path that leads elsewhere")
    return path


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError("no text")
    return value


def _tags(value: object) -> dict[str, str]:
    if not isinstance(value, dict):
        raise TypeError("no tags")
    return {_text(key): _text(of) for key, of in value.items()}
