"""The manifest of a recording: one small file that is only ever replaced as a whole.

A manifest is a line of JSON and a line with the digest of the first. It has bounds for all that
it holds, since it may come from elsewhere: numbers, lengths, names that stay below the store.
Where manifests lie, and how they change, is in `manifests`.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Iterable
from typing import Annotated, Final, Literal, TypeVar

from blake3 import blake3
from msgspec import UNSET, Meta, Struct, UnsetType, json, structs

from hybridlog_storage.errors import StoreError

MAX_BYTES: Final = 64 << 20
"""Largest manifest that is read or written."""
MAX_MARKS: Final = 10_000
"""Marks that a recording can have; others are counted."""

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
"""Of a mark or a pin; drawn before a change is made, which may be made again."""
Id = Annotated[str, Meta(pattern=r"\A[a-z0-9](-?[a-z0-9]){0,63}-[0-9a-f]{16}\Z")]
Digest = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
"""BLAKE3 of all bytes of a file."""
FileName = Annotated[str, Meta(pattern=r"\A[0-9]{6}(\.[a-z0-9_-]{1,64})?\.(mcap|parquet)\Z")]
Tags = dict[Key, Text]


class Record(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """A part of a manifest."""


_Part = TypeVar("_Part", bound=Record)


class Source(Record, frozen=True):
    """The origin of a recording: a file or a robot.

    Attributes:
        kind: Such as `rosbag1`.
        path: Of the file.
        profile: As MCAP files state it, such as `ros2`.
        fingerprint: Of the content; two recordings of one file have the same.
        bytes: The size of the file.
    """

    kind: Text = ""
    path: Text = ""
    profile: Text = ""
    fingerprint: Text = ""
    bytes: Count = 0


class Channel(Record, frozen=True):
    """Messages of one topic, type and encoding.

    Attributes:
        topic: Its topic.
        type: Name of the message type; empty without a definition.
        encoding: Of the messages, such as `cdr`.
        schema: Digest of the definition, which is `schemas/<digest>`; empty without one.
        metadata: As the source states it.
        messages: All that the recording has had, those of files that are gone included.
        bytes: The same, of payloads.
        first: Log time of the first one, ns since the epoch; None without messages.
        last: Of the last one.
    """

    topic: Topic
    encoding: Key | Literal[""] = ""
    type: Topic = ""
    schema: Digest | Literal[""] = ""
    metadata: dict[Text, Text] = {}
    messages: Count = 0
    bytes: Count = 0
    first: Nanoseconds | None = None
    last: Nanoseconds | None = None


class Part(Record, frozen=True, array_like=True):
    """Messages of one channel in a file, and the bytes of their payloads."""

    messages: Count
    bytes: Count


class File(Record, frozen=True):
    """A file below `recordings/<id>`, which never changes.

    Attributes:
        number: Its number; blob references name it.
        group: Number of the group of files that was opened and sealed together.
        name: Its name.
        kind: `log` has messages; `rows` has the fields of those of the log of its number.
        bytes: Its size.
        digest: BLAKE3 of its bytes.
        written: When it was sealed, ns since the epoch.
        first: Log time of its first message, ns; None without messages.
        last: Of its last message.
        parts: What it has of each channel.
        gone: Why the file is no longer here; absent while it is.
        copy: Address of a proven copy, if it is gone.
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
    """A moment or a period of a recording that somebody named.

    Attributes:
        id: Its id.
        time: Its log time, ns since the epoch.
        text: What was said of it.
        tags: Its tags.
        end: Log time of its end; None for a moment.
    """

    id: Random
    time: Nanoseconds
    text: Text
    tags: Tags = {}
    end: Nanoseconds | None = None


class Pin(Record, frozen=True):
    """Messages that no rule may delete.

    Attributes:
        id: Its id.
        first: First log time, ns since the epoch; None from the beginning on.
        last: Last log time; None up to the end.
        topics: Topics whose files must stay; None for all.
        reason: Why.
    """

    id: Random
    first: Nanoseconds | None = None
    last: Nanoseconds | None = None
    topics: tuple[Topic, ...] | None = None
    reason: Text = ""


class Loss(Record, frozen=True):
    """A row of the loss ledger.

    Attributes:
        cause: One word, such as `transport`.
        topic: The topic; empty if unknown.
        count: Messages that are missing; None if unknown.
        first: Beginning of the loss, ns since the epoch; None if unknown.
        last: Its end.
        reason: An explanation for people.
    """

    cause: Text
    topic: Topic = ""
    count: Count | None = None
    first: Nanoseconds | None = None
    last: Nanoseconds | None = None
    reason: Text = ""


class Manifest(Record, frozen=True):
    """A recording: who it is, its channels and files, its losses, and what users said of it.

    Attributes:
        id: Never changes; the files lie in `recordings/<id>`.
        name: What people call it.
        created: When it began, ns since the epoch.
        changes: How many there have been.
        status: `open` while it is recorded, or after its recorder died; `unproven` if it was
            made again after it was lost; `removed` if its files are being deleted.
        source: Where it comes from.
        tags: Its tags.
        notes: Its notes, in the order of writing.
        marks: Its marks.
        uncounted_marks: Marks beyond `MAX_MARKS`.
        pins: Its pins.
        channels: Its channels by number.
        files: Its files, in the order of writing.
        losses: Its loss ledger.
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
    uncounted_marks: Count = 0
    pins: tuple[Pin, ...] = ()
    channels: dict[ChannelNumber, Channel] = {}
    files: tuple[File, ...] = ()
    losses: tuple[Loss, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what no writer writes.

        Raises:
            ValueError: Two files have one name, or a time or a channel does not fit.
        """
        if len({file.name for file in self.files}) < len(self.files):
            raise ValueError("two files have one name")
        if any(int(file.name[:6]) != file.number for file in self.files):
            raise ValueError("a file has the number of another one")
        for ids in ([mark.id for mark in self.marks], [pin.id for pin in self.pins]):
            if len({*ids}) < len(ids):
                raise ValueError("two marks or pins have one id")
        spans: Iterable[Channel | File | Pin | Loss] = (
            *self.channels.values(), *self.files, *self.pins, *self.losses
        )  # fmt: skip
        for one in spans:
            _check_order(one.first, one.last)
        for mark in self.marks:
            _check_order(mark.time, mark.end)
        if any(file.parts.keys() - self.channels.keys() for file in self.files):
            raise ValueError("a file has messages of an unknown channel")


def _check_order(first: int | None, last: int | None) -> None:
    if first is not None and last is not None and last < first:
        raise ValueError("something ends before it begins")


def new_id(kind: str) -> str:
    """Draw the id of a recording.

    Args:
        kind: A word that its folder shows, such as the name of a file; other characters than
            letters and digits become hyphens.
    """
    word = re.sub("[^a-z0-9]+", "-", kind.lower()).strip("-")[:40].strip("-")
    return "-".join(filter(None, (time.strftime("%Y%m%d"), word, new_random())))


def new_random() -> str:
    """Draw the id of a mark or a pin."""
    return secrets.token_hex(8)


def is_id(name: str) -> bool:
    """True if a name can be the id of a recording."""
    return _ID.fullmatch(name) is not None


def replace(part: _Part, **values: object) -> _Part:
    """A manifest, or a part of one, with other values.

    Raises:
        ValueError: They do not fit.
    """
    return structs.replace(part, **values)


def hasher() -> blake3:
    """A hasher whose hexadecimal digest is that of a file."""
    return blake3()


def encode(manifest: Manifest) -> bytes:
    """The bytes of a manifest.

    Raises:
        StoreError: It would be larger than any that is read, or have a value out of bounds.
    """
    try:
        text = json.encode(manifest)
        _DECODER.decode(text)
    except ValueError as error:
        raise StoreError(f"{manifest.name} cannot be changed like this: {error}.") from error
    if len(text) > MAX_BYTES - _DIGEST_LINE:
        raise StoreError(f"{manifest.name} has too many files or losses for one recording.")
    return b"%b\n%b\n" % (text, blake3(text).hexdigest().encode())


def decode(data: bytes) -> Manifest:
    """The manifest of some bytes.

    Raises:
        ValueError: They are none, or are damaged; says why.
    """
    text, _, digest = data.removesuffix(b"\n").rpartition(b"\n")
    if blake3(text).hexdigest().encode() != digest:
        raise ValueError("its digest differs")
    try:
        return _DECODER.decode(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


_DIGEST_LINE: Final = 66  # bytes, with both line feeds
_DECODER: Final = json.Decoder(Manifest)
_ID: Final = re.compile(r"[a-z0-9](-?[a-z0-9]){0,63}-[0-9a-f]{16}")
