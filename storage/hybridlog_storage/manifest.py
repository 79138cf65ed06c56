"""The manifest of a recording: one small file that is only ever replaced as a whole.

A manifest is a line of JSON and a line with the digest of the first. It has bounds for all that
it holds, since it may come from elsewhere: numbers, lengths, names that stay below the store.
Where manifests lie, and how they change, is in `manifests`; `docs/format.md` has each field.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Collection, Iterable, Mapping
from typing import Annotated, Final, Literal, TypeVar

from blake3 import blake3
from msgspec import UNSET, Meta, Struct, UnsetType, json, structs

from hybridlog_storage.errors import StoreError

MAX_BYTES: Final = 64 << 20
"""Largest manifest that is read or written."""
MAX_MARKS: Final = 10_000
"""Marks that a recording can have."""

Nanoseconds = Annotated[int, Meta(ge=-(1 << 62), le=(1 << 63) - 1)]
"""A time since the epoch."""
Count = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
Number = Annotated[int, Meta(ge=0, lt=10**6)]
"""Of a file in its recording, and of its group."""
ChannelNumber = Annotated[int, Meta(ge=0, lt=1 << 16)]
Text = Annotated[str, Meta(max_length=1 << 16)]
Topic = Annotated[str, Meta(max_length=1 << 12)]
Key = Annotated[str, Meta(min_length=1, max_length=255, pattern=r"\A[^\0]*\Z")]
Name = Annotated[str, Meta(pattern=r"\A(?!\.)[^/\0]{1,255}\Z")]
Random = Annotated[str, Meta(pattern=r"\A[0-9a-f]{16}\Z")]
"""Of a mark; drawn before a change is made, which may be made again."""
PinId = Annotated[str, Meta(pattern=r"\A[^\s/\0]{1,64}\Z")]
"""Drawn as well; that of a copy begins with what it is known by."""
Id = Annotated[str, Meta(pattern=r"\A[a-z0-9](-?[a-z0-9]){0,63}-[0-9a-f]{16}\Z")]
Digest = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
"""BLAKE3 of all bytes of a file."""
Hash = Annotated[str, Meta(min_length=64, max_length=64)]
"""Of a definition; names no file. A pattern would cost as much as the rest of a channel."""
FileName = Annotated[str, Meta(pattern=r"\A[0-9]{6}(\.[a-z0-9_-]{1,64}){0,2}\.(mcap|parquet)\Z")]
Tags = dict[Key, Text]


class Record(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """A part of a manifest."""


_Part = TypeVar("_Part", bound=Record)


class Source(Record, frozen=True):
    """The origin of a recording: a file, or a robot, which has a `flush_interval_s`."""

    kind: Text = ""
    path: Text = ""
    profile: Text = ""
    fingerprint: Text = ""
    bytes: Count = 0
    parts: tuple[Text, ...] = ()
    flush_interval_s: Annotated[float, Meta(ge=0, le=1e9)] | None = None


class Channel(Record, frozen=True):
    """Messages of one topic, type and encoding.

    `messages`, `bytes` (of payloads), `first` and `last` are of all that the recording has had,
    also of files that are gone, but not of what a ring has let go.
    """

    topic: Topic
    encoding: Key | Literal[""] = ""
    type: Topic = ""
    metadata: dict[Text, Text] = {}
    messages: Count = 0
    bytes: Count = 0
    first: Nanoseconds | None = None
    last: Nanoseconds | None = None
    schema: Hash | Literal[""] = ""
    has_publish_time: bool = True
    is_indexed: bool = True


class Part(Record, frozen=True, array_like=True):
    """Messages of one channel in a file, bytes of their payloads, first and last log time (ns)."""

    messages: Count
    bytes: Count
    first: Nanoseconds | None = None
    last: Nanoseconds | None = None


LOST: Final = "segment"
"""Cause of the loss of stored messages whose part of the store is missing or damaged."""


class Loss(Record, frozen=True):
    """A row of the loss ledger; `offset` and `length` are the damaged bytes of `file`."""

    cause: Text
    topic: Topic = ""
    count: Count | None = None
    first: Nanoseconds | None = None
    last: Nanoseconds | None = None
    reason: Text = ""
    file: Text = ""
    offset: Count | None = None
    length: Count | None = None


class File(Record, frozen=True):
    """A file below `recordings/<id>`, which never changes.

    A `log` has messages; `rows` are what is left of those of the log of their number, once that is
    gone: expired, or left elsewhere, in the store at the address `copy`.
    """

    number: Number
    group: Number
    name: FileName
    kind: Literal["log", "rows"]
    bytes: Count
    digest: Digest
    written: Nanoseconds
    first: Nanoseconds | None = None
    last: Nanoseconds | None = None
    parts: dict[ChannelNumber, Part] = {}
    chunks: Count = 0
    attachments: Count = 0
    metadata: Count = 0
    losses: tuple[Loss, ...] = ()
    gone: Literal["expired", "elsewhere"] | UnsetType = UNSET
    copy: Text = ""

    @property
    def is_here(self) -> bool:
        """True unless it has expired, or was left elsewhere."""
        return self.gone is UNSET


class Note(Record, frozen=True):
    """A remark about a recording, and when it was written, ns since the epoch."""

    at: Nanoseconds
    text: Text


class Mark(Record, frozen=True):
    """A moment of a recording that somebody named; a period, if it has an `end`. Times are ns."""

    id: Random
    time: Nanoseconds
    text: Text
    tags: Tags = {}
    end: Nanoseconds | None = None


class Pin(Record, frozen=True):
    """Messages that no rule may delete; users type the id.

    `first` and `last` are log times, ns since the epoch, None for no bound. Files of `topics` must
    stay; None for all.
    """

    id: PinId
    first: Nanoseconds | None = None
    last: Nanoseconds | None = None
    topics: tuple[Topic, ...] | None = None
    reason: Text = ""


class LetGo(Record, frozen=True):
    """The messages that a ring has let go of a recording.

    `through` is the greatest number of a file that went. What has such a number or a smaller one
    and is not listed is about to be deleted, or left over.
    """

    messages: Count
    through: Number


class Manifest(Record, frozen=True):
    """A recording: who it is, its channels and files, its losses, and what users said of it.

    It is `open` while it is recorded, or after its recorder died; `unproven` if it was made again
    after it was lost; `removed` if its files are being deleted.
    """

    id: Id
    name: Name
    created: Nanoseconds
    changes: Count = 0
    status: Literal["open", "complete", "damaged", "recovered", "unproven", "removed"] = "open"
    source: Source = Source()
    tags: Tags = {}
    notes: tuple[Note, ...] = ()
    marks: Annotated[tuple[Mark, ...], Meta(max_length=MAX_MARKS)] = ()
    pins: tuple[Pin, ...] = ()
    channels: dict[ChannelNumber, Channel] = {}
    files: tuple[File, ...] = ()
    losses: tuple[Loss, ...] = ()
    let_go: LetGo | None = None

    @property
    def logs(self) -> dict[int, File]:
        """Its logs by number."""
        return {file.number: file for file in self.files if file.kind == "log"}

    @property
    def rows(self) -> dict[int, list[File]]:
        """Files with what is left of the messages of logs, gone or not, by number of the log."""
        found: dict[int, list[File]] = {}
        for file in self.files:
            if file.kind == "rows":
                found.setdefault(file.number, []).append(file)
        return found

    @property
    def present(self) -> dict[str, File]:
        """Its files that are not gone, by name."""
        return {file.name: file for file in self.files if file.is_here}

    @property
    def is_ended(self) -> bool:
        """True once nobody records it any more."""
        return self.status != "open"

    def has_let_go(self, number: int) -> bool:
        """True if a ring has let files of this number go."""
        is_old = self.let_go is not None and number <= self.let_go.through
        return is_old and number not in self.logs

    def __post_init__(self) -> None:
        """Refuse what no writer writes."""
        if len({file.name for file in self.files}) < len(self.files):
            raise ValueError("two files have one name")
        if any(int(file.name[:6]) != file.number for file in self.files):
            raise ValueError("a file has the number of another one")
        logs = self.logs
        if len(logs) < sum(file.kind == "log" for file in self.files):
            raise ValueError("two logs have one number")
        gone = {log.number for log in logs.values() if not log.is_here}
        if not gone <= self.rows.keys() <= logs.keys():
            raise ValueError("a log is gone without its rows, or rows are of no log")
        for ids in ([mark.id for mark in self.marks], [pin.id for pin in self.pins]):
            if len({*ids}) < len(ids):
                raise ValueError("two marks or pins have one id")
        parts = [part for file in self.files for part in file.parts.values()]
        if any(part.messages and part.first is None for part in parts):
            raise ValueError("a file has messages without times")
        timed: Iterable[Channel | File | Part | Loss] = (
            *self.channels.values(), *self.files, *parts, *self.losses
        )  # fmt: skip
        spans = [(one.first, one.last) for one in timed]
        if any((first is None) != (last is None) for first, last in spans):
            raise ValueError("something begins and never ends, or the opposite")
        spans += [(mark.time, mark.end) for mark in self.marks]
        spans += [(pin.first, pin.last) for pin in self.pins]
        if any(first is not None and last is not None and last < first for first, last in spans):
            raise ValueError("something ends before it begins")
        if not all(file.parts.keys() <= self.channels.keys() for file in self.files):
            raise ValueError("a file has messages of an unknown channel")


def new_id(kind: str) -> str:
    """Draw the id of a recording.

    Its folder shows `kind`, such as the name of a file; other characters than letters and digits
    become hyphens.
    """
    word = re.sub("[^a-z0-9]+", "-", kind.lower()).strip("-")[:40].strip("-")
    return "-".join(filter(None, (time.strftime("%Y%m%d"), word, new_random())))


def new_random() -> str:
    """Draw the id of a mark."""
    return secrets.token_hex(8)


def is_id(name: str) -> bool:
    """True if a name can be the id of a recording."""
    return _ID.fullmatch(name) is not None


def name_of(text: str) -> str:
    """A valid name of a recording, from what a user calls it."""
    plain = re.sub(r"[/\x00-\x1f\x7f-\x9f]", "-", text).lstrip(".")
    return plain.encode()[:_MAX_NAME].decode(errors="ignore") or "recording"


def free_name(text: str, taken: Collection[str]) -> str:
    """A valid name that no other recording has: `name`, `name-2`, `name-3` and so on."""
    name = name_of(text)
    found, number = name, 1
    while found in taken:
        number += 1
        end = f"-{number}"
        found = name.encode()[: _MAX_NAME - len(end)].decode(errors="ignore") + end
    return found


def replace(part: _Part, **values: object) -> _Part:
    """A manifest, or a part of one, with other values."""
    return structs.replace(part, **values)


def hasher(data: bytes = b"") -> blake3:
    """A hasher whose hexadecimal digest is that of a file."""
    return blake3(data)


def digest_of(pieces: Iterable[bytes]) -> str:
    """The digest of a file, as a manifest has it."""
    found = hasher()
    for piece in pieces:
        found.update(piece)
    return found.hexdigest()


def with_totals(manifest: Manifest) -> Manifest:
    """The manifest with the totals of its channels as its files have them."""
    parts: dict[int, list[Part]] = {number: [] for number in manifest.channels}
    for file in manifest.logs.values():
        for number, part in file.parts.items():
            parts[number].append(part)
    channels = {
        number: replace(
            channel,
            messages=sum(one.messages for one in parts[number]),
            bytes=sum(one.bytes for one in parts[number]),
            first=min((one.first for one in parts[number] if one.first is not None), default=None),
            last=max((one.last for one in parts[number] if one.last is not None), default=None),
        )
        for number, channel in sorted(manifest.channels.items())
    }
    return replace(manifest, channels=channels)


def with_mark(manifest: Manifest, mark: Mark) -> Manifest:
    """The manifest with a mark; unchanged if it has `MAX_MARKS`."""
    if len(manifest.marks) == MAX_MARKS:
        return manifest
    return replace(manifest, marks=(*manifest.marks, mark))


def with_rows(manifest: Manifest, log: File, rows: Iterable[File]) -> Manifest:
    """The manifest with another line of a log, and with these rows of it."""
    others = (f for f in manifest.files if f.kind == "log" or f.number != log.number)
    files = [log if f.kind == "log" and f.number == log.number else f for f in others]
    return replace(manifest, files=(*files, *rows))


def rows_line(log: File, name: str, size: int, digest: str, parts: Mapping[int, Part]) -> File:
    """The line of a file of rows of a log; `digest` is BLAKE3."""
    return replace(
        log,
        name=name,
        kind="rows",
        bytes=size,
        digest=digest,
        first=min(part.first for part in parts.values() if part.first is not None),
        last=max(part.last for part in parts.values() if part.last is not None),
        parts=dict(parts),
        chunks=0,
        attachments=0,
        metadata=0,
        losses=(),
        gone=UNSET,
        copy="",
    )


def encode_file(file: File) -> bytes:
    """The line of a file as JSON."""
    return json.encode(file)


def decode_file(data: bytes) -> File:
    """The opposite."""
    return json.decode(data, type=File)


def encode(manifest: Manifest) -> bytes:
    """The bytes of a manifest."""
    try:
        text = json.encode(manifest)
        _DECODER.decode(text)
    except ValueError as error:
        raise StoreError(f"{manifest.name} cannot be changed like this: {error}.") from error
    if len(text) > MAX_BYTES - _DIGEST_LINE:
        raise StoreError(f"{manifest.name} has too many files or losses for one recording.")
    return b"%b\n%b\n" % (text, blake3(text).hexdigest().encode())


def decode(data: bytes) -> Manifest:
    """The manifest of some bytes."""
    text, _, digest = data.removesuffix(b"\n").rpartition(b"\n")
    if blake3(text).hexdigest().encode() != digest:
        raise ValueError("its digest differs")
    try:
        return _DECODER.decode(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


_MAX_NAME: Final = 255  # bytes
_DIGEST_LINE: Final = 66  # bytes, with both line feeds
_DECODER: Final = json.Decoder(Manifest)
_ID: Final = re.compile(r"[a-z0-9](-?[a-z0-9]){0,63}-[0-9a-f]{16}")
