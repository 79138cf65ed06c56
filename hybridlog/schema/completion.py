"""Supplies definitions of standard ROS types that a source does not have.

A source may have no definition of a type, an empty one, or a text that cannot be parsed, such as
the name of the type or prose; messages that are empty rightly have a definition without fields.

A standard definition is supplied if it is proved: by the MD5 sum of ROS 1, by the type hash of
ROS 2, or because it fits the messages. Releases of ROS 2 differ in some types; the one that fits
best is chosen, the newest of equal ones.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from itertools import accumulate
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from hybridlog.schema.definition import MessageType, parse_definition, releases, typestore
from hybridlog.schema.definition_text import canonical
from hybridlog.schema.ros_codec import WireReader
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import REPLACED, SUPPLIED, Schema

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hybridlog.schema.wire_program import Wire
    from hybridlog_storage.messages import Buffer, Channel

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
