"""Codec of ROS 1 and ROS 2 messages.

Supplies definitions of standard ROS types that a source does not have.

A source may have no definition of a type, an empty one, or a text that cannot be parsed, such as
the name of the type or prose; messages that are empty rightly have a definition without fields.

A standard definition is supplied if it is proved: by the MD5 sum of ROS 1, by the type hash of
ROS 2, or because it fits the messages. Releases of ROS 2 differ in some types; the one that fits
best is chosen, the newest of equal ones.
"""

from __future__ import annotations

import re
import struct
import threading
from contextlib import suppress
from functools import cache, lru_cache, partial
from itertools import accumulate
from operator import itemgetter
from typing import TYPE_CHECKING, Literal, TypeAlias, cast

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from hybridlog.schema.codec import Codec, Decoded, Unreadable, no_rows
from hybridlog.schema.column import Records, concatenate, take
from hybridlog.schema.definition import (
    ArrayOf,
    FieldPath,
    FieldType,
    Instant,
    MessageType,
    Primitive,
    Text,
    parse_definition,
    paths,
    releases,
    typestore,
)
from hybridlog.schema.definition_text import canonical
from hybridlog.schema.wire_program import Wire, compile_type
from hybridlog.schema.wire_walk import MisfitError, Scanner, Source, Walker
from hybridlog_storage.errors import DefinitionError, PayloadError
from hybridlog_storage.messages import REPLACED, SUPPLIED, Batch, Buffer, Channel, Schema, distinct

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray
    from rosbags.interfaces.typing import FieldDesc, Typesdict


_HEADER = 4  # bytes in front of a message in CDR
_LITTLE = 0x0001
_ORDERS: dict[int, Literal["<", ">"]] = {_LITTLE: "<", 0x0000: ">"}
"""Byte orders of plain CDR, by the first two bytes."""
_Bad: TypeAlias = "dict[str, list[NDArray[np.intp]]]"
"""Rows that cannot be read, by reason."""


class WireReader:
    """Reads payloads of one message type.

    `fields` are dotted paths of those to read, top-level or nested (`header.stamp`,
    `transforms[].child_frame_id`; the brackets are optional), each with everything below it; None
    for all. Unknown paths are ignored. Fields that are not read are still checked.
    """

    def __init__(
        self, message_type: MessageType, wire: Wire, fields: Collection[str] | None = None
    ) -> None:
        self._wire: Wire = wire
        self._program = compile_type(message_type, wire, fields)

    def read(self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]) -> Decoded:
        """Read payloads at `offset` of `length` bytes (int64[n]). Never raises for their content.

        Large arrays of a single row may be views into `buffer`.
        """
        offset = np.asarray(offset, np.int64)
        end = offset + np.asarray(length, np.int64)
        bad: _Bad = {}
        outside = (offset < 0) | (end < offset) | (end > memoryview(buffer).nbytes)
        rows = np.flatnonzero(~outside)
        if len(rows) < len(offset):
            bad["lies outside of the chunk"] = [np.flatnonzero(outside)]
        sources, start = [(Source(buffer, "<"), rows)], offset
        if self._wire == "cdr":
            sources, start = self._by_order(buffer, rows, offset, end, bad), offset + _HEADER
        found = [self._read(*one, start, end, bad) for one in sources]
        good, records, surplus = found[0]
        if found[1:]:
            good, surplus = (np.concatenate([one[at] for one in found]) for at in (0, 2))
            order = np.argsort(good)
            good, records = good[order], take(concatenate([one[1] for one in found]), order)
        unreadable = [Unreadable(np.sort(np.concatenate(r)), why) for why, r in bad.items()]
        return Decoded(good, records, unreadable, np.sort(surplus))

    def message_in(self, payload: Buffer) -> memoryview:
        """A payload without the bytes that are left over behind its message."""
        view = memoryview(payload)
        start = 0 if self._wire == "ros1" else _HEADER
        order: Literal["<", ">"] = ">" if start and view[:2].tobytes() == b"\0\0" else "<"
        scanner = Scanner(Source(payload, order), self._wire)
        return view[: scanner.walk(self._program, start, len(view), start)]

    def _by_order(
        self,
        buffer: Buffer,
        rows: NDArray[np.intp],
        offset: NDArray[np.int64],
        end: NDArray[np.int64],
        bad: _Bad,
    ) -> list[tuple[Source, NDArray[np.intp]]]:
        """The rows of each byte order of CDR, at least of one, and the buffer for these."""
        short = end[rows] - offset[rows] < _HEADER
        if bool(short.any()):
            bad["is shorter than a CDR header"] = [rows[short]]
            rows = rows[~short]
        little, begin = Source(buffer, "<"), offset[rows]
        kind = little.u1(begin, 0).astype(np.int64) << 8
        kind |= little.u1(begin, 1)
        if bool((kind == _LITTLE).all()):
            return [(little, rows)]
        found = []
        for code in distinct(kind).tolist():
            own = rows[kind == code]
            if code in _ORDERS:
                found.append((Source(buffer, _ORDERS[code]), own))
            else:
                bad[f"encapsulation 0x{code:04x} is not read"] = [own]
        return found or [(little, rows[:0])]

    def _read(
        self,
        source: Source,
        rows: NDArray[np.intp],
        start: NDArray[np.int64],
        end: NDArray[np.int64],
        bad: _Bad,
    ) -> tuple[NDArray[np.intp], Records, NDArray[np.intp]]:
        """Read rows of one byte order, and which have bytes left over; `bad` gets the others."""
        walker = Walker(source, self._wire)
        try:
            column, surplus = walker.read(self._program, start[rows], end[rows])
        except MisfitError:
            rows = self._sort_out(source, rows, start, end, bad)
            column, surplus = walker.read(self._program, start[rows], end[rows])
        records = Records({}, len(rows)) if column is None else column
        assert isinstance(records, Records)
        return rows, records, no_rows() if surplus is None else rows[surplus]

    def _sort_out(
        self,
        source: Source,
        rows: NDArray[np.intp],
        start: NDArray[np.int64],
        end: NDArray[np.int64],
        bad: _Bad,
    ) -> NDArray[np.intp]:
        """Check each row separately; return the valid ones."""
        scanner = Scanner(source, self._wire)
        good = np.ones(len(rows), np.bool_)
        places = zip(rows.tolist(), start[rows].tolist(), end[rows].tolist(), strict=True)
        for index, (row, begin, finish) in enumerate(places):
            try:
                scanner.check(self._program, begin, finish)
            except MisfitError as misfit:
                good[index] = False
                bad.setdefault(str(misfit), []).append(np.array([row], np.intp))
        return rows[good]


_MAX_UNROLLED = 10_000
"""Most elements of fixed arrays of strings and messages that rosbags unrolls into code."""

_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z][A-Za-z0-9_]*)*\Z")

# rosbags uses one module name for generated classes while it registers them.
_REGISTERING = threading.Lock()


class RosCodec(Codec):
    """Messages of one ROS type."""

    def __init__(self, schema: Schema, wire: Literal["ros1", "cdr"]) -> None:
        self._name = schema.name
        self._wire: Literal["ros1", "cdr"] = wire
        self._type = parse_definition(schema)
        self._paths = paths(self._type)
        self._readers = lru_cache(maxsize=64)(partial(WireReader, self._type, wire))
        self._readers(None)  # which refuses some definitions
        self._objects: RosObjects | None = None

    def paths(self) -> list[FieldPath]:
        """All fields, in the order of the definition."""
        return self._paths

    def decode(self, payload: Buffer) -> object:
        """Decode the message with rosbags: fields as attributes, arrays as numpy views."""
        if self._objects is None:
            with _REGISTERING:
                self._objects = self._objects or RosObjects(self._type, self._wire)
        try:
            return self._objects.decode(payload)
        except PayloadError:
            # rosbags refuses payloads with bytes left over.
            with suppress(MisfitError):
                return self._objects.decode(self._readers(None).message_in(payload))
            raise

    def columns_of(self, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
        """Decode messages; see `Codec.columns_of`."""
        reader = self._readers(None if fields is None else frozenset(fields))
        decoded = reader.read(batch.buffer, batch.offset, batch.length)
        for bad in decoded.unreadable:
            bad.reason = f"the payload does not fit {self._name}: {bad.reason}"
        return decoded


class RosObjects:
    """Decodes single messages to objects with rosbags.

    rosbags runs code generated from type and field names. So it gets the checked type and
    never the text of the definition.
    """

    def __init__(self, message_type: MessageType, wire: Literal["ros1", "cdr"]) -> None:
        from rosbags.typesys import TypesysError
        from rosbags.typesys.store import Typestore

        self._wire = wire
        self._label = message_type.name
        build = _Typesdict(message_type.name)
        self._name = build.add(message_type)
        self._store = Typestore()
        try:
            self._store.register(build.types)
            self._store.get_msgdef(self._name)
        except (TypesysError, SyntaxError, RecursionError, MemoryError) as error:
            raise DefinitionError(
                f"{message_type.name}: rosbags cannot make a class from this definition ({error}). "
                "`.raw` has the bytes"
            ) from error

    def decode(self, payload: Buffer) -> object:
        """The message; PayloadError if the payload does not fit the definition."""
        view = memoryview(payload)
        read = self._store.deserialize_ros1 if self._wire == "ros1" else self._store.deserialize_cdr
        from rosbags.serde import SerdeError

        try:
            return read(view, self._name)
        except (
            SerdeError,
            struct.error,
            ValueError,
            IndexError,
            OverflowError,
            MemoryError,
        ) as error:
            raise PayloadError(
                f"the payload does not fit {self._label}: {error}. `.raw` has the bytes"
            ) from error


class _Typesdict:
    """A type and all its nested types, in the form that rosbags registers."""

    def __init__(self, owner: str) -> None:
        self.types: Typesdict = {}
        self._owner = owner
        self._names: dict[MessageType, str] = {}
        self._unrolled = 0

    def add(self, message: MessageType) -> str:
        """Add a message; return its rosbags name."""
        if message not in self._names:
            name = self._free(_rosbags_name(message.name))
            self.types[name] = ([], [])
            self._names[message] = name
            self.types[name][1].extend((n, self._describe(t)) for n, t in message.fields)
        return self._names[message]

    def _free(self, name: str) -> str:
        if not _TYPE_NAME.match(name):
            raise DefinitionError(f"{self._owner}: {name[:80]!r} is not a valid type name")
        while name in self.types:
            name += "_"
        return name

    def _describe(self, field: FieldType) -> FieldDesc:
        from rosbags.interfaces import Nodetype

        if isinstance(field, Primitive):
            return _base(np.dtype(field.code).name)
        if isinstance(field, Text):
            return _base("string")
        if isinstance(field, Instant):
            parts = {"sec": field.signed_seconds, "nanosec": field.signed_nanoseconds}
            fields = ((name, Primitive("", "i4" if own else "u4")) for name, own in parts.items())
            field = MessageType(f"builtin_interfaces/{field.kind.capitalize()}", tuple(fields))
        if isinstance(field, MessageType):
            return (Nodetype.NAME, self.add(field))
        return self._describe_array(field)

    def _describe_array(self, field: ArrayOf) -> FieldDesc:
        from rosbags.interfaces import Nodetype

        if field.width is not None and not isinstance(field.element, Primitive):
            self._unrolled += field.width
            if self._unrolled > _MAX_UNROLLED:
                raise DefinitionError(
                    f"{self._owner}: fixed arrays of {field.width} messages or strings are not "
                    "made objects. `.raw` has the bytes"
                )
        kind = Nodetype.SEQUENCE if field.width is None else Nodetype.ARRAY
        inner = self._describe(field.element)
        return cast("FieldDesc", (kind, (inner, field.width or 0)))


def _base(name: str) -> FieldDesc:
    from rosbags.interfaces import Nodetype

    return cast("FieldDesc", (Nodetype.BASE, (name, 0)))


def _rosbags_name(name: str) -> str:
    """The rosbags spelling of `pkg/Name`: `pkg/msg/Name`."""
    parts = name.strip("/").split("/")
    if len(parts) == 1:
        # Its class would hide names that the code of rosbags uses.
        parts.insert(0, "unnamed")
    if len(parts) == 2:
        parts.insert(1, "msg")
    return "/".join(parts)


TRIED_MESSAGES = 64
"""Most messages of a channel that definitions are tried on."""
_TRIED_BYTES = 1 << 22  # of these, but one message at least
_ENCODINGS = {"", "ros1msg", "ros2msg", "ros2idl", "omgidl"}
_WIRES: Mapping[str, Wire] = {"ros1": "ros1", "cdr": "cdr"}


class _Candidate(Struct, frozen=True):
    """A definition of one release.

    Attributes:
        release: The newest release that has it.
        schema: The definition, with those of all nested types.
        proof: MD5 sum of a ROS 1 type, RIHS01 hash of a ROS 2 type.
    """

    release: str
    schema: Schema
    type: MessageType
    proof: str


def completed(channel: Channel, payloads: Sequence[Buffer]) -> Channel:
    """A channel with the definition of its standard type, if its source has none.

    A few payloads are enough. If it has a definition, or none is proved, it is the channel itself.
    """
    schema = channel.schema
    wire = _WIRES.get(channel.message_encoding)
    if wire is None or schema is None or not schema.name or schema.encoding not in _ENCODINGS:
        return channel
    with suppress(DefinitionError):
        if parse_definition(schema).fields:
            return channel
    proof = _proof(channel.metadata, wire)
    candidates = [each for each in _standard(schema.name, wire) if proof in {"", each.proof}]
    how = "fits the messages"
    if proof:
        how = "md5sum" if wire == "ros1" else "type hash"
    else:
        payloads = _some(payloads)
        scored = [(_fit(one.type, wire, payloads), one) for one in candidates]
        most = max(scored, key=itemgetter(0), default=None)
        candidates = [] if most is None or most[0] == (0, 0) else [most[1]]
    if not candidates:
        return channel
    chosen, given = candidates[0], schema.data
    release = chosen.release.partition("_")[2].lower()
    metadata = {**channel.metadata, SUPPLIED: f"{release}, {how}"}
    if given.strip():
        metadata[REPLACED] = given.decode(errors="replace")
    return replace(channel, schema=replace(chosen.schema, name=schema.name), metadata=metadata)


def _proof(metadata: Mapping[str, str], wire: Wire) -> str:
    """The MD5 sum or type hash of a channel; empty without one."""
    text = metadata.get("md5sum" if wire == "ros1" else "topic_type_hash", "").strip()
    if wire == "ros1":
        return text.lower() if len(text) == 32 and text.strip("0") else ""
    return text if text.startswith("RIHS01_") and text[7:].strip("0") else ""


@cache
def _standard(name: str, wire: Wire) -> list[_Candidate]:
    """The definitions of a standard type in all releases, newest first; equal ones once."""
    package, _, leaf = canonical(name).rpartition("/")
    full = f"{package}/msg/{leaf}"
    found: dict[MessageType, _Candidate] = {}
    for release in releases(wire):
        store = typestore(release)
        if full not in store.fielddefs:
            continue
        version, encoding = (1, "ros1msg") if wire == "ros1" else (2, "ros2msg")
        text, md5 = store.generate_msgdef(full, ros_version=version)
        schema = Schema(name, encoding, text.encode())
        try:
            parsed = parse_definition(schema)
        except DefinitionError:
            continue
        proof = md5 if wire == "ros1" else store.hash_rihs01(full)
        found.setdefault(parsed, _Candidate(release, schema, parsed, proof))
    return list(found.values())


def _some(payloads: Sequence[Buffer]) -> list[Buffer]:
    """A few of many messages, and of few bytes."""
    found = list(payloads[:: -(-len(payloads) // TRIED_MESSAGES) or 1])
    sizes = accumulate(memoryview(payload).nbytes for payload in found)
    return found[: max(sum(size <= _TRIED_BYTES for size in sizes), 1)]


def _fit(message_type: MessageType, wire: Wire, payloads: Sequence[Buffer]) -> tuple[int, int]:
    """Messages that a type fits exactly, and that it fits at all."""
    sizes = np.array([memoryview(payload).nbytes for payload in payloads], np.int64)
    begins = np.cumsum(sizes) - sizes
    try:
        decoded = WireReader(message_type, wire).read(b"".join(payloads), begins, sizes)
    except DefinitionError:
        return 0, 0
    fits = len(decoded.rows)
    return fits - len(decoded.surplus), fits
