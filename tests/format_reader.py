"""A second reader of stores, written from `docs/format.md` alone.

It shares no code with hybridlog: `struct`, `zlib`, `json`, `lz4` and `zstandard` are all it needs,
and `pyarrow` for fields of expired messages (`format_columns.py`). What it reads, it has checked.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import struct
import tomllib
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import lz4.frame
import zstandard
from blake3 import blake3

from tests.format_columns import Columns, WrongColumnsError

MAGIC = b"\x89MCAP0\r\n"
JOINED_NS = 12 * 10**9


class Damaged(Exception):  # noqa: N818 - a word of the specification
    """Something is not as the specification says."""


def demand(condition: bool, what: str) -> None:
    if not condition:
        raise Damaged(what)


class Told(NamedTuple):
    """A message as a reader tells it."""

    seq: int
    topic: str
    encoding: str
    schema: tuple[str, str, bytes] | None
    log_time: int
    publish_time: int | None
    sequence: int
    payload: bytes | dict[str, Any]
    """The payload, or the row that is left of it."""


class Chunk(NamedTuple):
    """A row of `chunks`."""

    offset: int
    length: int
    trailer: int
    first: int
    last: int
    parts: int


class Part(NamedTuple):
    """A row of `parts`."""

    channel: int
    messages: int
    payload_bytes: int
    first: int
    last: int
    first_publish: int
    last_publish: int


class Content:
    """Takes the content of a record apart."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, form: str) -> int:
        (value,) = struct.unpack_from(form, self._data, self._at)
        self._at += struct.calcsize(form)
        return int(value)

    def block(self, size: int) -> bytes:
        self._at += size
        return self._data[self._at - size : self._at]

    def text(self) -> str:
        return self.block(self.take("<I")).decode()

    def mapping(self) -> dict[str, str]:
        end = self.take("<I") + self._at
        found = {}
        while self._at < end:
            name = self.text()
            found[name] = self.text()
        return found


def records(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Offset, opcode and content of records that follow one another."""
    at = 0
    while at < len(data):
        demand(at + 9 <= len(data), "a record is cut off")
        opcode, length = struct.unpack_from("<BQ", data, at)
        demand(at + 9 + length <= len(data), "a record is cut off")
        yield at, opcode, data[at + 9 : at + 9 + length]
        at += 9 + length


def unpacked(frame: bytes, size: int) -> bytes:
    """The content of a zstd frame that has a checksum."""
    demand(zstandard.get_frame_parameters(frame).has_checksum, "a frame without a checksum")
    try:
        found = zstandard.ZstdDecompressor().decompressobj().decompress(frame)
    except zstandard.ZstdError as error:
        raise Damaged(f"a frame: {error}") from error
    demand(len(found) == size, "a frame of another size")
    return found


# --- the manifest ---------------------------------------------------------------------


class Manifest:
    """What a manifest says, by the section "Manifest".

    Raises:
        Damaged: It is none.
    """

    def __init__(self, data: bytes) -> None:
        lines = data.split(b"\n")
        demand(len(lines) == 3 and not lines[2], "a manifest has two lines")
        demand(blake3(lines[0]).hexdigest().encode() == lines[1], "the digest of the manifest")
        said = json.loads(lines[0])
        self.id: str = said["id"]
        self.name: str = said["name"]
        self.created: int = said["created"]
        self.status: str = said.get("status", "open")
        self.tags: dict[str, str] = said.get("tags", {})
        self.notes = [(note["at"], note["text"]) for note in said.get("notes", ())]
        self.marks: list[dict[str, Any]] = said.get("marks", [])
        self.topics = {int(n): about["topic"] for n, about in said.get("channels", {}).items()}
        self.schemas = {
            int(n): one.get("schema", "") for n, one in said.get("channels", {}).items()
        }
        self.logs = {one["number"]: one for one in said.get("files", ()) if one["kind"] == "log"}
        self.rows = [one for one in said.get("files", ()) if one["kind"] == "rows"]
        self.losses = [*map(loss_of, said.get("losses", ()))]
        totals: dict[int, list[int]] = {}
        for log in self.logs.values():
            for channel, part in log.get("parts", {}).items():
                found = totals.setdefault(int(channel), [0, 0])
                found[0] += part[0]
                found[1] += part[1]
        for channel, about in said.get("channels", {}).items():
            have = [about.get("messages", 0), about.get("bytes", 0)]
            demand(have == totals.get(int(channel), [0, 0]), "the totals of a channel")


def loss_of(said: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the loss ledger as entries have it."""
    empty = {
        "topic": None, "count": None, "from": None, "to": None, "reason": "", "file": "",
        "offset": None, "length": None,
    }  # fmt: skip
    words = {"first": "from", "last": "to"}
    return {**empty, **{words.get(key, key): value for key, value in said.items()}}


# --- segments -------------------------------------------------------------------------


class Segment:
    """A sealed segment whose summary and metadata have been checked.

    Raises:
        Damaged: They are not as the specification says.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = data = self._read(path)
        demand(len(data) > 8 + 29 + 8 and data[-8:] == MAGIC, "no magic at the end")
        opcode, length, start, offsets, crc = struct.unpack_from("<BQQQI", data, len(data) - 37)
        demand((opcode, length) == (0x02, 20), "no footer")
        demand(8 <= start <= offsets <= len(data) - 37, "a footer that leads elsewhere")
        demand(zlib.crc32(data[start : len(data) - 12]) == crc, "the checksum of the summary")
        self.schemas: dict[int, tuple[str, str, bytes]] = {}
        self.channels: dict[int, tuple[int, str, str, dict[str, str]]] = {}
        self.metadata: list[tuple[int, int, str]] = []
        self._counts: dict[int, int] = {}
        groups: list[int] = []
        table = None
        for _, opcode, body in records(data[start:offsets]):
            if not groups or groups[-1] != opcode:
                groups.append(opcode)
            content = Content(body)
            if opcode == 0x03:
                number, name, encoding = content.take("<H"), content.text(), content.text()
                self.schemas[number] = (name, encoding, content.block(content.take("<I")))
            elif opcode == 0x04:
                number, schema = content.take("<H"), content.take("<H")
                about = (schema, content.text(), content.text(), content.mapping())
                self.channels[number] = about
            elif opcode == 0x0B:
                content.block(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)
                for _ in range(content.take("<I") // 10):
                    number = content.take("<H")
                    self._counts[number] = content.take("<Q")
            elif opcode == 0x0D:
                self.metadata.append((content.take("<Q"), content.take("<Q"), content.text()))
            elif opcode == 0x92:
                table = body
        known = [0x03, 0x04, 0x0B, 0x08, 0x0A, 0x0D, 0x92]
        demand(groups == [g for g in known if g in groups], "the groups are not in order")
        told = [body[0] for _, _, body in records(data[offsets : len(data) - 37])]
        demand(told == groups, "the summary offsets")
        demand(table is not None, "no chunk table")
        assert table is not None
        self._table(table, start)
        self.about = self._json("hybridlog.recording")[0]
        self.losses = [
            loss_of(row) for said in self._json("hybridlog.losses") for row in said["rows"]
        ]

    def _read(self, path: Path) -> bytes:
        data = path.read_bytes()
        self.digest = blake3(data).hexdigest()
        return data

    def _table(self, body: bytes, start: int) -> None:
        n, m = struct.unpack_from("<II", body)
        size = 44 * n + 48 * m
        demand(size <= 1 << 28, "the chunk table is too large")
        raw = unpacked(body[8:], size)
        self.chunks = [Chunk(*row) for row in struct.iter_unpack("<QQQqqI", raw[: 44 * n])]
        self.parts = [Part(*row) for row in struct.iter_unpack("<IIQqqqq", raw[44 * n :])]
        at = 0
        for chunk in self.chunks:
            demand(at <= chunk.offset, "the chunks are not in order")
            demand(min(chunk[:3]) > 0, "a chunk without bytes")
            at = sum(chunk[:3])
        demand(at <= start, "a chunk in the summary")
        demand(sum(c.parts for c in self.chunks) == m, "the parts")
        counts: dict[int, int] = {}
        for number, chunk in enumerate(self.chunks):
            parts = self.parts_of(number)
            channels = [part.channel for part in parts]
            demand(bool(parts) and channels == sorted(set(channels)), "the parts of a chunk")
            demand(chunk.first == min(p.first for p in parts), "the first time of a chunk")
            demand(chunk.last == max(p.last for p in parts), "the last time of a chunk")
            for part in parts:
                counts[part.channel] = counts.get(part.channel, 0) + part.messages
        demand(counts == {c: n for c, n in self._counts.items() if n}, "the statistics")

    def parts_of(self, number: int) -> list[Part]:
        before = sum(chunk.parts for chunk in self.chunks[:number])
        return self.parts[before : before + self.chunks[number].parts]

    def _json(self, name: str) -> list[dict[str, Any]]:
        """The metadata records of a name, after their checksums."""
        found = []
        for offset, length, its_name in self.metadata:
            if its_name != name:
                continue
            record = self.data[offset : offset + length]
            crc = zlib.crc32(record[:-8], zlib.crc32(struct.pack("<Q", offset)))
            demand(record[-8:] == b"%08x" % crc, "the checksum of a metadata record")
            ((_, opcode, body),) = records(record)
            content = Content(body)
            demand((opcode, content.text()) == (0x0C, name), "no metadata record")
            values = content.mapping()
            demand(list(values)[-1] == "hybridlog.crc32", "the last key of a metadata record")
            found.append(json.loads(values["json"]))
        return found

    @property
    def totals(self) -> dict[int, list[int]]:
        """Messages, bytes, first and last log time of each channel."""
        found: dict[int, list[int]] = {}
        for part in self.parts:
            now = found.setdefault(part.channel, [0, 0, part.first, part.last])
            now[0] += part.messages
            now[1] += part.payload_bytes
            now[2:] = min(now[2], part.first), max(now[3], part.last)
        return found

    def chunk(self, number: int) -> Iterator[tuple[int, Told]]:
        """Offset of the payload, and the message, of all messages of a chunk."""
        place = self.chunks[number]
        end = place.offset + place.length
        record, trailer = self.data[place.offset : end], self.data[end : end + place.trailer]
        ((_, opcode, body),) = records(record)
        demand(opcode == 0x06, "no chunk")
        messages = list(records(self._content(Content(body), place)))
        at = trailer.rindex(struct.pack("<Q", place.offset)) - 9
        ((_, opcode, arrivals),) = records(trailer[at:])
        demand(opcode == 0x90, "no arrival record")
        _, head, crc = struct.unpack_from("<QII", arrivals)
        demand(zlib.crc32(record[: self._head(record)]) == head, "the head of a chunk")
        demand(zlib.crc32(trailer[:at]) == crc, "the message indexes")
        count, sizes = struct.unpack_from("<II", arrivals, 16), (48, 8)
        demand(count[1] == len(messages), "the number of arrival numbers")
        raw = unpacked(arrivals[24:], sum(n * size for n, size in zip(count, sizes, strict=True)))
        said = [Part(*row) for row in struct.iter_unpack("<IIQqqqq", raw[: 48 * count[0]])]
        demand(said == self.parts_of(number), "the parts in an arrival record")
        steps = struct.unpack(f"<{count[1]}q", raw[48 * count[0] :])
        seq = 0
        heads = []
        for step, (start, opcode, message) in zip(steps, messages, strict=True):
            demand(opcode == 0x05, "no message")
            seq += step
            channel, sequence, log_time, publish = struct.unpack_from("<HIQQ", message)
            heads.append((channel, log_time, start))
            yield start + 31, self._told(seq, channel, log_time, publish, sequence, message[22:])
        indexes = records(trailer[:at])
        listed = [row for _, opcode, index in indexes for row in self._index(opcode, index)]
        demand(sorted(heads) == sorted(listed), "the message indexes")
        self._compare(number, messages)

    @staticmethod
    def _head(record: bytes) -> int:
        body = Content(record[37:])
        return 37 + 4 + len(body.text()) + 8

    def _told(
        self, seq: int, channel: int, log_time: int, publish: int, sequence: int, payload: Any
    ) -> Told:
        schema, topic, encoding, metadata = self.channels[channel]
        known = "hybridlog.no_publish_time" not in metadata
        return Told(
            seq, topic, encoding, self.schemas[schema] if schema else None,
            log_time, publish if known else None, sequence, payload,
        )  # fmt: skip

    @staticmethod
    def _content(body: Content, place: Chunk) -> bytes:
        times = body.take("<Q"), body.take("<Q")
        demand(times == (place.first, place.last), "the times in the head of a chunk")
        size, crc, compression = body.take("<Q"), body.take("<I"), body.text()
        packed = body.block(body.take("<Q"))
        demand(compression in {"", "zstd", "lz4"}, "another compression")
        content = packed
        if compression == "lz4":
            content = lz4.frame.decompress(packed)
        elif compression:
            content = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        demand(len(content) == size and zlib.crc32(content) == crc, "the content of a chunk")
        return content

    @staticmethod
    def _index(opcode: int, index: bytes) -> Iterator[tuple[int, int, int]]:
        demand(opcode == 0x07, "no message index")
        channel, length = struct.unpack_from("<HI", index)
        demand(length == len(index) - 6, "the length of a message index")
        rows = list(struct.iter_unpack("<QQ", index[6:]))
        demand([t for t, _ in rows] == sorted(t for t, _ in rows), "an index out of order")
        for log_time, offset in rows:
            yield channel, log_time, offset

    def _compare(self, number: int, messages: Sequence[tuple[int, int, bytes]]) -> None:
        """Hold the parts of a chunk against its messages."""
        by_channel: dict[int, list[tuple[int, int, int]]] = {}
        for _, _, message in messages:
            channel, _, log_time, publish = struct.unpack_from("<HIQQ", message)
            by_channel.setdefault(channel, []).append((log_time, publish, len(message) - 22))
        for part in self.parts_of(number):
            rows = by_channel.pop(part.channel)
            logged, published, sizes = zip(*rows, strict=True)
            demand(part.messages == len(rows), "the number of messages of a part")
            demand(part.payload_bytes == sum(sizes), "the bytes of a part")
            demand((part.first, part.last) == (min(logged), max(logged)), "the times of a part")
            publish = (part.first_publish, part.last_publish)
            demand(publish == (min(published), max(published)), "the publish times of a part")
        demand(not by_channel, "a channel without a part")


class GoneSegment(Segment):
    """One that is gone: its metadata and summary, and the rows of its messages.

    Args:
        path: Its first file of rows.
        rows: All of them, as the manifest lists them.
        recording: Id of its recording.
    """

    def __init__(self, path: Path, rows: Sequence[Mapping[str, Any]], recording: str) -> None:
        self._rows = Columns(path.parent, rows, recording)
        super().__init__(path)

    def _read(self, path: Path) -> bytes:
        data = path.read_bytes()
        size, crc, length = struct.unpack_from("<IIQ", data, 12)
        demand(data[:12] == b"PAR1hbl-rows", "no file of rows")
        front = data[28 : 28 + length]
        demand(zlib.crc32(front) == crc and len(front) == length, "the front of a file of rows")
        self.line: dict[str, Any] = json.loads(front[:size])
        self.digest = self.line["digest"]
        found, at = bytearray(self.line["bytes"]), size
        while at < length:
            place, own = struct.unpack_from("<QQ", front, at)
            found[place : place + own] = front[at + 16 : at + 16 + own]
            at += 16 + own
        return bytes(found)

    def chunk(self, number: int) -> Iterator[tuple[int, Told]]:
        try:
            left = self._rows.left(number)
        except WrongColumnsError as error:
            raise Damaged(str(error)) from error
        counts = {part.channel: part.messages for part in self.parts_of(number)}
        demand(Counter(row["channel"] for row in left) == counts, "the rows of a chunk")
        for row in left:
            ref = row["ref"]
            demand((ref["seg"], ref["chunk"]) == (self.line["number"], number), "a row")
            about = row["seq"], row["channel"], row["t"], row["pub"]
            yield ref["off"], self._told(*about, ref["sequence"], row)


# --- recordings -----------------------------------------------------------------------


def _manifest_of(path: Path) -> Path:
    return path.parent.parent / "manifests" / f"{path.name}.json"


class Recording:
    """A recording: its manifest, the segments that are believed, what follows from both."""

    _NAME: ClassVar = re.compile(r"(\d{6})\.mcap(\.open)?")

    def __init__(self, path: Path) -> None:
        self.path = path
        self.manifest = Manifest(_manifest_of(path).read_bytes())
        sealed: dict[int, Segment | None] = {}
        self.open: set[int] = set()
        listed = self.manifest.logs
        for file in sorted(path.iterdir(), key=lambda file: (file.name.count("."), file.name)):
            match = self._NAME.fullmatch(file.name)
            if match is None or not file.is_file():
                continue
            number = int(match[1])
            if match[2]:
                self.open.add(number)
                continue
            if number in listed and (
                listed[number]["name"] != file.name or "gone" in listed[number]
            ):
                continue
            try:
                sealed[number] = Segment(file)
            except Damaged:
                sealed[number] = None
        for number, log in listed.items():
            own = [row for row in self.manifest.rows if row["number"] == number]
            if "gone" in log and all(self._is_there(row) for row in own):
                sealed[number] = GoneSegment(path / own[0]["name"], own, self.manifest.id)
        self.id = self.manifest.id
        self.segments = {
            number: segment
            for number, segment in sorted(sealed.items())
            if segment is not None and self._is_believed(number, segment, listed.get(number))
        }
        self.unlisted = {number for number in self.segments if number not in listed}
        for number in self.segments.keys() & listed.keys():
            segment = self.segments[number]
            losses = [*map(loss_of, listed[number].get("losses", ()))]
            demand(losses == segment.losses, "the losses of a segment")
            for channel, (schema, *_) in segment.channels.items():
                digest = schema_hash(*segment.schemas[schema]) if schema else ""
                demand(self.manifest.schemas[channel] == digest, "the definition of a channel")
        self.end = self._end()
        self.damage = dict(self._damage())
        self.lost = [*self._lost_segments(listed), *self._lost_chunks()]
        self.status = self._status()

    def _is_believed(self, number: int, segment: Segment, listed: Mapping[str, Any] | None) -> bool:
        about = segment.about
        if about["format"] != 4 or (about["id"], about["segment"]) != (self.id, number):
            return False
        if listed is None:
            return True
        parts = {int(channel): part for channel, part in listed.get("parts", {}).items()}
        return (len(segment.data), segment.totals) == (listed["bytes"], parts)

    def _end(self) -> dict[str, Any] | None:
        if self.manifest.status == "open":
            return None
        return {"status": self.manifest.status, "losses": self.manifest.losses}

    def _damage(self) -> Iterator[tuple[tuple[int, int], str]]:
        for number, segment in self.segments.items():
            for chunk in range(len(segment.chunks)):
                try:
                    for _ in segment.chunk(chunk):
                        pass
                except (Damaged, zstandard.ZstdError) as error:
                    yield (number, chunk), str(error)

    def _lost_segments(self, listed: Mapping[int, Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
        for number, file in listed.items():
            if number in self.segments or number in self.open:
                continue
            if "gone" in file:
                rows = [row for row in self.manifest.rows if row["number"] == number]
                for one in rows:
                    yield from self._lost_file(one)
                continue
            yield from self._lost_file(file)

    def _lost_file(self, file: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        row = _row(file["name"], None, file["bytes"], 0, None, None, None)
        parts = {n: part for n, part in file.get("parts", {}).items() if part[0]}
        for channel, (count, _, first, last) in parts.items():
            topic = self.manifest.topics[int(channel)]
            yield _row(file["name"], None, file["bytes"], count, topic, first, last)
        if not parts:
            yield row

    def _lost_chunks(self) -> Iterator[dict[str, Any]]:
        for number, chunk in self.damage:
            segment = self.segments[number]
            if isinstance(segment, GoneSegment):
                continue
            place = segment.chunks[chunk]
            for part in segment.parts_of(chunk):
                topic = segment.channels[part.channel][1]
                about = (part.messages, topic, part.first, part.last)
                yield _row(segment.path.name, place.offset, place.length, *about)

    def _is_there(self, row: Mapping[str, Any]) -> bool:
        path = self.path / row["name"]
        return path.is_file() and path.stat().st_size == row["bytes"]

    def _status(self) -> str:
        if self._is_recorded() and (self.end is None or self.open):
            return "open"
        if self.open:
            return "unfinished"
        if self.lost or any(row["cause"] == "segment" for row in self.manifest.losses):
            return "damaged"
        return str(self.end["status"]) if self.end is not None else "recovered"

    def _is_recorded(self) -> bool:
        try:
            fd = os.open(self.path / "writer.lock", os.O_RDONLY | os.O_NOFOLLOW)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return os.pread(fd, 256, 0).split(b" ")[1:2] == [b"1"]
        finally:
            os.close(fd)
        return False

    @property
    def losses(self) -> list[dict[str, Any]]:
        """All rows of the loss ledger, without the reasons of those that follow from files."""
        said = list((self.end or {}).get("losses", ()))
        for segment in self.segments.values():
            said += segment.losses
        return [*_joined(said), *self.lost]

    def messages(self) -> Iterator[tuple[tuple[int, int, int], Told]]:
        """All messages: segment, chunk and offset as in `_meta.ref`; the message."""
        for number, segment in self.segments.items():
            for chunk in range(len(segment.chunks)):
                if (number, chunk) not in self.damage:
                    for offset, message in segment.chunk(chunk):
                        yield (number, chunk, offset), message


def _row(
    file: str,
    offset: int | None,
    length: int | None,
    count: int,
    topic: str | None,
    first: int | None,
    last: int | None,
) -> dict[str, Any]:
    return {
        "cause": "segment", "file": file, "offset": offset, "length": length,
        "count": count, "topic": topic, "from": first, "to": last,
    }  # fmt: skip


def _joined(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    found = [dict(row) for row in rows if row["from"] is None]
    last: dict[tuple[str, str, str], dict[str, Any]] = {}
    timed = [row for row in rows if row["from"] is not None]
    for row in sorted(timed, key=lambda row: (row["from"], row["to"])):
        key = (row["topic"] or "", row["cause"], row["reason"])
        before = last.get(key)
        if before is None or row["from"] - before["to"] > JOINED_NS:
            last[key] = dict(row)
            found.append(last[key])
            continue
        before["to"] = max(before["to"], row["to"])
        counts = (before["count"], row["count"])
        before["count"] = None if None in counts else sum(counts)
    return found


class FormatReader:
    """Reads a store."""

    def __init__(self, store: Path) -> None:
        self.store = store
        settings = tomllib.loads((store / "hybridlog.toml").read_text())
        demand(settings["format"] == 4, "another format")
        self.store_id: str = settings["store_id"]

    def names(self) -> list[str]:
        return sorted(self._places())

    def recording(self, name: str) -> Recording:
        found = Recording(self._places()[name])
        demand(found.id == found.path.name, "a directory that is not named by its id")
        return found

    def _places(self) -> dict[str, Path]:
        """Directories of recordings by name."""
        places = (self.store / "recordings").iterdir()
        return {
            self._name(p): p
            for p in places
            if p.is_dir() and not p.is_symlink() and p.name[0] != "."
        }

    @staticmethod
    def _name(path: Path) -> str:
        return Manifest(_manifest_of(path).read_bytes()).name


def collection_name(topic: str) -> str:
    """By the section "Collection names"."""
    if re.fullmatch(r"(/[A-Za-z0-9]+(_[A-Za-z0-9]+)*)+", topic) and len(topic) <= 120:
        return topic[1:].replace("/", "__")
    plain = topic.removeprefix("/").replace("/", "__")
    digest = hashlib.sha256(topic.encode()).hexdigest()
    return re.sub("[^A-Za-z0-9_]", "_", plain)[:100] + "~" + digest[:8]


def index_key(log_time: int, key: str, seq: int) -> bytes:
    """`_id` of an index document."""
    return struct.pack(">Q8sQ", log_time, bytes.fromhex(key), seq)


def schema_hash(name: str, encoding: str, data: bytes) -> str:
    """As in `channels.schema`."""
    parts = (name.encode(), encoding.encode(), data)
    return hashlib.sha256(b"".join(struct.pack("<Q", len(p)) + p for p in parts)).hexdigest()
