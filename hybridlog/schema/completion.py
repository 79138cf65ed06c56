"""Supplies definitions of standard ROS types that a source does not have.

Three cases differ. A source may have no definition of a type; a definition that is empty; or
messages that are empty, whose definition rightly has no fields. A text that cannot be parsed,
such as the name of the type or prose, is no definition. Neither is one that leaves bytes over
where the standard type of that name fits exactly.

A standard definition is supplied if it is proved: by the MD5 sum of ROS 1, by the type hash of
ROS 2, or because it fits the messages. Releases of ROS 2 differ in some types; the one that fits
best is chosen, the newest of equal ones.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache, lru_cache
from itertools import accumulate
from operator import itemgetter
from typing import TYPE_CHECKING

from msgspec import Struct
from msgspec.structs import replace

from hybridlog.schema.definition import (
    MessageType,
    parse_definition,
    parsed_with_supplied,
    releases,
    standard_text,
    typestore,
)
from hybridlog.schema.definition_text import canonical, has_parts
from hybridlog.schema.wire import WireReader
from hybridlog.schema.wire_scan import MAX_PADDING, MisfitError
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import REPLACED, SUPPLIED, Schema

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hybridlog.schema.wire_program import Wire
    from hybridlog_storage.messages import Buffer, Channel

TRIED_MESSAGES = 64
"""Most messages of a channel that definitions are tried on."""
_TRIED_BYTES = 1 << 22  # of these, but one message at least

_EMPTY_MD5 = "d41d8cd98f00b204e9800998ecf8427e"
_DEFAULTS = {"ros1msg": 1, "ros2msg": 2}
_ENCODINGS = {"", "ros1msg", "ros2msg", "ros2idl", "omgidl"}


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
    payloads = _some(payloads)
    own = (0, 0)
    with suppress(DefinitionError):
        found = parse_definition(schema)
        own = _fit(found, wire, payloads) if found.fields else own
        if found.fields and own == (len(payloads), len(payloads)):
            return channel
    proof = _proof(channel.metadata, wire)
    candidates = [each for each in _standard(schema.name, wire) if proof in {"", each.proof}]
    if proof and candidates and not own[1]:
        return _with(channel, candidates[0], "md5sum" if wire == "ros1" else "type hash")
    chosen = _fitting(candidates, wire, payloads, better_than=own)
    return channel if chosen is None else _with(channel, chosen, "fits the messages")


_WIRES: Mapping[str, Wire] = {"ros1": "ros1", "cdr": "cdr"}


@lru_cache(maxsize=1024)
def with_nested(schema: Schema) -> Schema:
    """A definition with those of the standard types that reading supplies, for other readers."""
    if schema.encoding not in _DEFAULTS or has_parts(schema.data.decode(errors="replace")):
        return schema
    ros = _DEFAULTS[schema.encoding]
    with suppress(DefinitionError):
        names = sorted(parsed_with_supplied(schema)[1])
        rule = "=" * 80
        texts = (f"\n{rule}\nMSG: {name}\n{standard_text(name, ros)}" for name in names)
        schema = replace(schema, data=schema.data + "".join(texts).encode())
    return schema


def has_hidden_fields(channel: Channel) -> bool:
    """True if the MD5 sum of a ROS 1 type proves that its empty definition is not its own."""
    schema = channel.schema
    if channel.message_encoding != "ros1" or schema is None or not schema.encoding:
        return False
    if schema.data.strip():
        return False
    return _proof(channel.metadata, "ros1") not in {"", _EMPTY_MD5}


def _with(channel: Channel, chosen: _Candidate, how: str) -> Channel:
    assert channel.schema is not None
    release = chosen.release.partition("_")[2].lower()
    metadata = {**channel.metadata, SUPPLIED: f"{release}, {how}"}
    given = channel.schema.data
    if given.strip() and not chosen.schema.data.startswith(given):
        metadata[REPLACED] = given.decode(errors="replace")
    schema = replace(chosen.schema, name=channel.schema.name)
    return replace(channel, schema=schema, metadata=metadata)


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
    exact = fits = 0
    try:
        reader = WireReader(message_type, wire)
    except DefinitionError:
        return 0, 0
    for payload in payloads:
        try:
            rest = memoryview(payload).nbytes - len(reader.message_in(payload))
        except MisfitError:
            continue
        fits += 1
        exact += rest <= MAX_PADDING[wire]
    return exact, fits


def _fitting(
    candidates: Sequence[_Candidate],
    wire: Wire,
    payloads: Sequence[Buffer],
    *,
    better_than: tuple[int, int],
) -> _Candidate | None:
    """The candidate that fits most messages exactly, then most at all; None if none is better."""
    scored = [(_fit(one.type, wire, payloads), one) for one in candidates]
    most, best = max(scored, key=itemgetter(0), default=(better_than, None))
    return best if most > better_than else None
