"""One decoder for all databases: a serialized message becomes a dictionary, or JSON.

rosbags deserializes; what it returns is made a dictionary by a plan that is compiled
once for each type. MongoDB gets Python values, the others get JSON text. orjson writes it
from the arrays as they are. The standard library's `json` takes thirty times as long: that,
and not the database, would be what a ceiling shows.

| field | MongoDB | JSON |
|---|---|---|
| number, boolean, string | as it is | as it is, NaN and infinity as null |
| `uint8[]`, `byte[]`, `char[]` | binary | base64 |
| `float32[]` | array of doubles | array, each the shortest decimal of that float32 |
| other arrays | array | array |
| time, duration | `{secs, nsecs}` | `{secs, nsecs}` |
| `uint64` of 2^63 and more | double: BSON has no larger integer | as it is |
| `_meta.inserted_at` | log time as a date, ms | log time as ISO 8601 text, ms |
| `_meta.t` | log time, ns | log time, ns |

A message without a definition, or one that does not fit its definition, is kept whole, as
bytes under `data`.
"""

from __future__ import annotations

import threading
from base64 import b64encode
from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hybridlog.schema.definition import parse_definition, paths
from hybridlog_storage.errors import DefinitionError

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rosbags.typesys.store import Typestore

    from hybridlog_storage.messages import Channel, Schema

Document = dict[str, Any]
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
_NUMBERS = frozenset(
    {"float32", "float64", *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64))}
)
_INSTANTS = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})
_TAKEN = frozenset({"_id", META})
_INT64_END = 1 << 63
_IDL_SEPARATOR = "=" * 80 + "\nIDL: "
_ENCODINGS = {"ros1": ("ros1msg",), "cdr": ("ros2msg", "ros2idl")}


class _Leaves(NamedTuple):
    """How numbers and arrays become values; None leaves them as they are."""

    octets: Callable[[NDArray[Any]], object]
    numbers: Callable[[NDArray[Any]], object]
    large: Callable[[int], object] | None
    larges: Callable[[NDArray[Any]], object]


class Converter:
    """Messages of one type, made what a database takes. Thread safe.

    Attributes:
        reason: Why messages are kept as bytes; None when they are decoded.
        indexed: The groups of `INDEXED` whose fields this type has, as single numbers.
    """

    def __init__(self, message_encoding: str, schema: Schema | None) -> None:
        self.reason: str | None = None
        self.indexed: tuple[tuple[str, ...], ...] = ()
        self._to_bson: Callable[[bytes], Document] = _whole
        self._to_json: Callable[[bytes], Document] = _whole_text
        try:
            self._compile(message_encoding, schema)
        except DefinitionError as error:
            self.reason = str(error)
        except Exception as error:
            # Definitions are anybody's text; whatever rosbags makes of one, the message is kept.
            self.reason = f"rosbags: {type(error).__name__}: {error}"

    def document(self, log_time: int, payload: bytes) -> Document:
        """A message for MongoDB.

        Args:
            log_time: ns since the epoch.
            payload: The serialized message.
        """
        try:
            document = self._to_bson(payload)
        except Exception:
            document = _whole(payload)
        document[META] = {"inserted_at": _date(log_time), "t": log_time}
        return document

    def text(self, log_time: int, payload: bytes) -> str:
        """A message as JSON.

        Args:
            log_time: ns since the epoch.
            payload: The serialized message.
        """
        meta = {"inserted_at": iso_text(log_time), "t": log_time}
        try:
            return _encode(self._to_json(payload) | {META: meta})
        except Exception:
            return _encode(_whole_text(payload) | {META: meta})

    def _compile(self, message_encoding: str, schema: Schema | None) -> None:
        if schema is None:
            raise DefinitionError("there is no definition")
        if schema.encoding not in _ENCODINGS.get(message_encoding, ()):
            raise DefinitionError(
                f"{schema.name}: messages {message_encoding!r}, defined by {schema.encoding!r}"
            )
        # Refuses what would take all memory when it is compiled.
        known = {field.path: field.type for field in paths(parse_definition(schema))}
        self.indexed = tuple(
            group for group in INDEXED if all(known.get(path) in _NUMBERS for path in group)
        )
        types, name = typestore_of(schema)
        types.get_msgdef(name)
        read = types.deserialize_ros1 if message_encoding == "ros1" else types.deserialize_cdr
        to_bson = message_plan(types, name)
        to_json = message_plan(types, name, for_json=True)
        # A view, since rosbags cuts the head off CDR, which would copy bytes.
        self._to_bson = lambda payload: to_bson(read(memoryview(payload), name))
        self._to_json = lambda payload: to_json(read(memoryview(payload), name))


_converters: dict[tuple[str, Schema | None], Converter] = {}
_lock = threading.Lock()


def converter_for(channel: Channel) -> Converter:
    """The converter of a channel's messages; one for all channels of the same type."""
    key = (channel.message_encoding, channel.schema)
    with _lock:
        converter = _converters.get(key)
        if converter is None:
            converter = _converters[key] = Converter(*key)
        return converter


def iso_text(log_time: int) -> str:
    """A log time, ns, as text: `2015-07-14T09:26:53.589Z`."""
    return _date(log_time).isoformat(timespec="milliseconds") + "Z"


def without_nul(text: str) -> str:
    """JSON whose strings hold U+FFFD in place of U+0000, which jsonb cannot store."""
    if "\\u0000" not in text:
        return text
    import orjson

    return _encode(_replace_nul(orjson.loads(text)))


def typestore_of(schema: Schema) -> tuple[Typestore, str]:
    """The types of a definition, completed with standard ones, and the message's own name.

    Args:
        schema: Of encoding `ros1msg`, `ros2msg` or `ros2idl`.
    """
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    text = schema.data.decode("utf-8", "replace")
    name = normalize_msgtype(schema.name)
    types = get_typestore(Stores.EMPTY)
    if schema.encoding == "ros2idl":
        head, *others = text.split(_IDL_SEPARATOR)
        sections = [other.partition("\n")[2] for other in others]
        found = {}
        for section in [head, *sections] if head.strip() else sections:
            found.update(get_types_from_idl(section))
    else:
        found = get_types_from_msg(text, name)
    standard = get_typestore(
        Stores.ROS1_NOETIC if schema.encoding == "ros1msg" else Stores.ROS2_KILTED
    ).fielddefs
    waiting = [name]
    wanted: dict[str, Any] = {}
    while waiting:
        current = waiting.pop()
        if current not in wanted:
            wanted[current] = found[current] if current in found else standard[current]
            waiting.extend(_referred(wanted[current][1]))
    types.register(wanted)
    return types, name


def message_plan(types: Typestore, name: str, *, for_json: bool = False) -> Plan:
    """How messages of a type become dictionaries.

    Args:
        types: Holds the type.
        name: As rosbags spells it, `sensor_msgs/msg/Imu`.
        for_json: Values that JSON can hold, rather than those of MongoDB.
    """
    leaves = _FOR_JSON if for_json else _FOR_BSON
    return _plan(types, name, leaves, {}, taken=_TAKEN)


def _plan(
    types: Typestore,
    name: str,
    leaves: _Leaves,
    known: dict[str, Plan],
    *,
    taken: frozenset[str] = frozenset(),
) -> Plan:
    if name in _INSTANTS:
        return _instant
    if not taken and name in known:
        return known[name]
    fields = [
        (field, desc)
        for field, desc in types.get_msgdef(name).fields
        if field != "structure_needs_at_least_one_member"
    ]
    # rosbags appends an underscore to Python's keywords, and so do we to our own.
    keys = tuple(_key(field, types, name, taken) for field, _ in fields)
    special = [
        (key, convert)
        for key, (_, desc) in zip(keys, fields, strict=True)
        if (convert := _conversion(types, desc, leaves, known)) is not None
    ]
    plan = _record([field for field, _ in fields], keys, special)
    if not taken:
        known[name] = plan
    return plan


def _record(
    attributes: list[str], keys: tuple[str, ...], special: list[tuple[str, Callable[[Any], object]]]
) -> Plan:
    if not attributes:
        return lambda _: {}
    if len(attributes) == 1:
        only = attrgetter(attributes[0])
        key = keys[0]
        if not special:
            return lambda message: {key: only(message)}
        convert = special[0][1]
        return lambda message: {key: convert(only(message))}
    get = attrgetter(*attributes)

    def plan(message: object) -> Document:
        document = dict(zip(keys, get(message), strict=True))
        for key, convert in special:
            document[key] = convert(document[key])
        return document

    return plan


def _key(field: str, types: Typestore, owner: str, taken: frozenset[str]) -> str:
    """The name of a field as its definition spells it."""
    if field.endswith("_") and all(given != field for given, _ in types.fielddefs[owner][1]):
        field = field[:-1]
    return f"{field}_" if field in taken else field


def _conversion(
    types: Typestore, desc: Any, leaves: _Leaves, known: dict[str, Plan]
) -> Callable[[Any], object] | None:
    """How a field's value is converted; None when it stays as it is."""
    from rosbags.interfaces import Nodetype

    kind, detail = desc
    if kind == Nodetype.BASE:
        return leaves.large if detail[0] == "uint64" else None
    if kind == Nodetype.NAME:
        return _plan(types, detail, leaves, known)
    inner, content = detail[0]
    if inner == Nodetype.NAME:
        element = _plan(types, content, leaves, known)
        return lambda values: [element(value) for value in values]
    return _array(content[0], leaves)


def _array(primitive: str, leaves: _Leaves) -> Callable[[Any], object] | None:
    if primitive in {"string", "wstring"}:
        return None  # a list already
    if primitive in _BYTES:
        return leaves.octets
    return leaves.larges if primitive == "uint64" else leaves.numbers


def _referred(fields: Any) -> list[str]:
    """Names of the types that fields are of."""
    from rosbags.interfaces import Nodetype

    names = []
    for _, (kind, detail) in fields:
        if kind in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
            kind, detail = detail[0]  # noqa: PLW2901
        if kind == Nodetype.NAME:
            names.append(detail)
    return names


def _instant(value: Any) -> Document:
    return {"secs": value.sec, "nsecs": value.nanosec}


def _listed(values: NDArray[Any]) -> object:
    return values.tolist()


def _native(values: NDArray[Any]) -> object:
    """As orjson reads an array; a view of a message may begin anywhere in it."""
    return np.require(values, values.dtype.newbyteorder("="), ["C_CONTIGUOUS", "ALIGNED"])


def _bson_integer(value: int) -> int | float:
    return value if value < _INT64_END else float(value)


def _bson_integers(values: NDArray[Any]) -> object:
    if len(values) and int(values.max()) >= _INT64_END:
        return [_bson_integer(value) for value in values.tolist()]
    return values.tolist()


def _base64(octets: bytes | memoryview) -> str:
    return b64encode(octets).decode("ascii")


_FOR_BSON = _Leaves(lambda values: values.tobytes(), _listed, _bson_integer, _bson_integers)
_FOR_JSON = _Leaves(lambda values: _base64(values.data), _native, None, _native)


def _whole(payload: bytes) -> Document:
    return {"data": bytes(payload)}


def _whole_text(payload: bytes) -> Document:
    return {"data": _base64(payload)}


def _date(log_time: int) -> datetime:
    return _EPOCH + timedelta(microseconds=log_time // 1_000_000 * 1000)


def _replace_nul(value: object) -> object:
    if isinstance(value, str):
        return value.replace("\0", "\ufffd")
    if isinstance(value, Mapping):
        return {key: _replace_nul(item) for key, item in value.items()}
    return [_replace_nul(item) for item in value] if isinstance(value, list) else value


def _encode(value: object) -> str:
    import orjson

    return orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY).decode()
