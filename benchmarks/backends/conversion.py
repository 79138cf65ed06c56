"""One decoder for all databases: a serialized message becomes a dictionary, or JSON.

The loads hold ROS 1 messages with whole definitions. rosbags deserializes; what it returns is
made a dictionary by a plan that is compiled once for each type. MongoDB gets Python values, the
others get JSON text. orjson writes it from the arrays as they are. The standard library's `json`
takes thirty times as long: that, and not the database, would be what a ceiling shows.

| field | MongoDB | JSON |
|---|---|---|
| number, boolean, string | as it is | as it is, NaN and infinity as null |
| `uint8[]`, `byte[]`, `char[]` | binary | base64 |
| `float32[]` | array of doubles | array, each the shortest decimal of that float32 |
| other arrays | array | array |
| time, duration | `{secs, nsecs}` | `{secs, nsecs}` |
| `_meta.inserted_at` | log time as a date, ms | log time as ISO 8601 text, ms |
| `_meta.t` | log time, ns | log time, ns |
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.backends.base import Backend
from hybridlog.schema.definition import parse_definition, paths

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from hybridlog_storage.messages import Channel, Schema

Document = dict[str, Any]
Convert = Callable[[Any], object]
Plan = Callable[[Any], Document]
"""From a message that rosbags has deserialized to its dictionary."""

META = "_meta"
INSERTED_AT = "_meta.inserted_at"
T = "_meta.t"
INDEXED = (
    ("position",),
    ("position.x",),
    ("pose.position.x", "pose.position.y", "pose.position.z"),
)
"""Fields that the paper's appendix A puts indexes on, together or alone."""

_EPOCH = datetime(1970, 1, 1)  # UTC: so pymongo takes a date without a zone
_BYTES = frozenset({"uint8", "byte", "char", "octet"})
_INSTANTS = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})


class Converter:
    """Messages of one type, made what a database takes. Thread safe.

    Attributes:
        indexed: The groups of `INDEXED` whose fields this type has, as single numbers.
    """

    def __init__(self, schema: Schema) -> None:
        known = {field.path: field.type for field in paths(parse_definition(schema))}
        self.indexed = tuple(
            group for group in INDEXED if all(known.get(path) == "float64" for path in group)
        )
        self._types, self._name = typestore_of(schema)
        self._to_bson = _plan(self._types, self._name, for_json=False)
        self._to_json = _plan(self._types, self._name, for_json=True)

    def document(self, log_time: int, payload: bytes) -> Document:
        """A message for MongoDB."""
        document = self._to_bson(self._types.deserialize_ros1(payload, self._name))
        document[META] = {"inserted_at": date_of(log_time), "t": log_time}
        return document

    def text(self, log_time: int, payload: bytes) -> str:
        """A message as JSON."""
        import orjson

        document = self._to_json(self._types.deserialize_ros1(payload, self._name))
        document[META] = {"inserted_at": iso_text(log_time), "t": log_time}
        return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY).decode()


@cache
def converter_for(schema: Schema) -> Converter:
    """The converter of a type."""
    return Converter(schema)


def iso_text(log_time: int) -> str:
    """A log time, ns, as text: `2015-07-14T09:26:53.589Z`."""
    return date_of(log_time).isoformat(timespec="milliseconds") + "Z"


def typestore_of(schema: Schema) -> tuple[Typestore, str]:
    """The types of a ROS 1 definition and the message's own name."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    name = normalize_msgtype(schema.name)
    types = get_typestore(Stores.EMPTY)
    types.register(get_types_from_msg(schema.data.decode(), name))
    return types, name


def _plan(types: Typestore, name: str, *, for_json: bool) -> Plan:
    """How messages of a type become dictionaries."""
    if name in _INSTANTS:
        return lambda value: {"secs": value.sec, "nsecs": value.nanosec}
    fields = types.get_msgdef(name).fields
    names = tuple(field for field, _ in fields)
    converted = {field: _conversion(types, desc, for_json=for_json) for field, desc in fields}
    special = [(field, how) for field, how in converted.items() if how is not None]
    get = attrgetter(*names)
    if len(names) == 1:
        convert = special[0][1] if special else lambda value: value
        return lambda message: {names[0]: convert(get(message))}

    def plan(message: object) -> Document:
        document = dict(zip(names, get(message), strict=True))
        for field, convert in special:
            document[field] = convert(document[field])
        return document

    return plan


def _conversion(types: Typestore, desc: Any, *, for_json: bool) -> Convert | None:
    """How a field's value is converted; None when it stays as it is."""
    from rosbags.interfaces import Nodetype

    kind, detail = desc
    if kind == Nodetype.BASE:
        return None
    if kind == Nodetype.NAME:
        return _plan(types, detail, for_json=for_json)
    return _of_array(types, detail[0], for_json=for_json)


def _of_array(types: Typestore, element: Any, *, for_json: bool) -> Convert | None:
    """As `_conversion`, of an array or a sequence."""
    from rosbags.interfaces import Nodetype

    inner, content = element
    if inner == Nodetype.NAME:
        plan = _plan(types, content, for_json=for_json)
        return lambda values: [plan(value) for value in values]
    if content[0] == "string":
        return None  # a list already
    if content[0] in _BYTES:
        if for_json:
            return lambda values: b64encode(values.data).decode("ascii")
        return lambda values: values.tobytes()
    if for_json:
        # As orjson reads an array; a view of a message may begin anywhere in it.
        return lambda values: np.require(
            values, values.dtype.newbyteorder("="), ["C_CONTIGUOUS", "ALIGNED"]
        )
    return lambda values: values.tolist()


def date_of(log_time: int) -> datetime:
    return _EPOCH + timedelta(microseconds=log_time // 1_000_000 * 1000)


def schema_of(channel: Channel) -> Schema:
    """The definition of a channel's messages: all loads have them."""
    assert channel.schema is not None
    return channel.schema


class DatabaseBackend(Backend):
    """A backend whose messages are decoded first."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._channels: Sequence[Channel] = ()
        self._converters: list[Converter] = []

    def _take_channels(self, channels: Sequence[Channel]) -> None:
        """Compile the decoders, so that no message has to wait for that."""
        self._channels = channels
        self._converters = [converter_for(schema_of(channel)) for channel in channels]

    def _topics(self) -> dict[str, list[tuple[str, ...]]]:
        """Topics in order, and the groups of fields to be indexed in each."""
        found: dict[str, list[tuple[str, ...]]] = {}
        for channel, converter in zip(self._channels, self._converters, strict=True):
            groups = found.setdefault(channel.topic, [])
            groups.extend(group for group in converter.indexed if group not in groups)
        return found
