"""Parses message definitions into types.

A definition is untrusted text. Its size, its nesting and its number of unfolded fields
are limited before types are built, and nothing in it is executed.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import TYPE_CHECKING, Literal, TypeAlias

from msgspec import Struct

from hybridlog.schema.definition_text import (
    DTYPES,
    MAX_NAME,
    NAME,
    IdlTypes,
    RawField,
    canonical,
    derived_from,
    has_parts,
    interface_of,
    parse_idl,
    parse_msg,
    parse_parts,
    split_sections,
)
from hybridlog_storage.errors import DefinitionError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from hybridlog_storage.messages import Schema

MAX_DEFINITION = 1 << 20
"""Largest definition, in bytes."""
MAX_DEPTH = 62
"""Deepest nesting of messages, arrays of messages counted twice: deeper columns cannot be read."""
MAX_FIELDS = 10_000
"""Most fields of an unfolded type; nested ones count at each occurrence."""
MAX_WIDTH = 1 << 28
"""Most elements of a fixed array."""
MAX_FIXED_BYTES = 1 << 40
"""Largest minimum size of a message in bytes; nested fixed arrays multiply."""


class Primitive(Struct, frozen=True):
    """A number or a boolean; `code` is its kind and size in bytes, such as `u1`.

    Those of `byte` and `char` differ between ROS 1 and ROS 2.
    """

    name: str
    code: str

    @property
    def size(self) -> int:
        """Its bytes."""
        return int(self.code[1:] or 1)


class Text(Struct, frozen=True):
    """A string of at most `bound` characters, None without a bound."""

    bound: int | None = None


class Instant(Struct, frozen=True):
    """A time or a duration: 32 bits of seconds, then 32 bits of nanoseconds.

    Seconds are signed except for the time of ROS 1, nanoseconds only for the duration of ROS 1.
    """

    kind: Literal["time", "duration"]
    signed_seconds: bool
    signed_nanoseconds: bool


class ArrayOf(Struct, frozen=True):
    """An array of `width` elements, a number not on the wire; or a sequence, `bound` unchecked."""

    element: FieldType
    width: int | None = None
    bound: int | None = None


class MessageType(Struct, frozen=True):
    """A message: its name in the definition, and its fields in wire order."""

    name: str
    fields: tuple[tuple[str, FieldType], ...]


FieldType: TypeAlias = Primitive | Text | Instant | ArrayOf | MessageType


class FieldPath(Struct, frozen=True):
    """A field for predicates.

    Attributes:
        path: Names joined by dots; `[]` after the name of an array of messages that
            the path passes through: `transforms[].header.stamp`.
        type: Its type as in a definition, `float64[9]`.
        array: True if a message holds several values at this path.
    """

    path: str
    type: str
    array: bool


_NOT_PORTABLE = frozenset({"wstring", "wchar", "float128"})
_DUMMY = "structure_needs_at_least_one_member"
_TIME_FIELDS = [RawField("sec", "int32"), RawField("nanosec", "uint32")]
_TIME_TYPES: dict[str, Literal["time", "duration"]] = {
    "builtin_interfaces/Time": "time",
    "builtin_interfaces/Duration": "duration",
}
_ROS1_TIMES = {"time": Instant("time", False, False), "duration": Instant("duration", True, True)}
_WORDS = frozenset({*DTYPES, "string", *_NOT_PORTABLE})


@lru_cache(maxsize=1024)
def parse_definition(schema: Schema) -> MessageType:
    """Parse a definition of encoding `ros1msg`, `ros2msg`, `ros2idl` or `omgidl`.

    Missing standard types (`std_msgs/Header`, `geometry_msgs/Point`, ...) are those of Noetic or
    Kilted; definitions in the text take precedence.
    """
    if schema.encoding not in {"ros1msg", "ros2msg", "ros2idl", "omgidl"}:
        raise DefinitionError(f"{schema.name}: {schema.encoding!r} is not a ROS definition")
    if len(schema.data) > MAX_DEFINITION:
        raise DefinitionError(
            f"{schema.name}: the definition has {len(schema.data)} bytes; "
            f"more than {MAX_DEFINITION} are not read"
        )
    ros = 1 if schema.encoding == "ros1msg" else 2
    types, first = _parse_sections(schema, ros)
    top = canonical(schema.name)
    if top not in types:
        top = first
    fields = _Resolver(schema.name, types, ros).message(top)[0].fields
    return MessageType(schema.name, fields)


_RELEASES = {1: "ROS1_NOETIC", 2: "ROS2_KILTED"}
"""Whose standard types are supplied, by version of ROS."""


def releases(wire: Literal["ros1", "cdr"]) -> list[str]:
    """The releases that are known, newest first."""
    from rosbags.typesys import Stores

    prefix = "ROS1_" if wire == "ros1" else "ROS2_"
    return sorted((name for name in Stores.__members__ if name.startswith(prefix)), reverse=True)


@cache
def typestore(release: str) -> Typestore:
    """The standard types of a release; not to be changed."""
    # Imported here, since it is slow and most definitions are complete.
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores[release])


def _parse_sections(schema: Schema, ros: int) -> tuple[dict[str, list[RawField]], str]:
    """Parse the text: fields by canonical type name, and the name of the first type."""
    text = schema.data.decode("utf-8", errors="replace")
    if ros == 2 and "\n" not in text:
        text = text.replace("\r", "\n")  # rosidl accepts any line end
    types: dict[str, list[RawField]] = {}
    blank: dict[str, list[RawField]] = {}
    idl = IdlTypes()
    first = ""
    for given, kind, section in split_sections(text):
        name = canonical(given or schema.name)
        first = first or name
        is_idl = kind == "IDL" or (not kind and schema.encoding in {"ros2idl", "omgidl"})
        if is_idl and ros == 2:
            parse_idl(name, section, idl)
            continue
        if ros == 2 and has_parts(section):
            parsed = parse_parts(name, section)
        else:
            parsed = {name: parse_msg(name, section, defaults=ros == 2)}
        if not kind and not any(parsed.values()):
            blank = parsed  # what stands before the header line of the definition
            continue
        for key, fields in parsed.items():
            if types.setdefault(key, fields) != fields:
                raise DefinitionError(f"{schema.name}: {key} is defined twice, differently")
    for key, fields in idl.resolved().items():
        types.setdefault(key, fields)
    derived = derived_from(interface_of(canonical(schema.name)), types) if ros == 2 else {}
    return blank | derived | types, first


def standard_text(name: str, ros: int) -> str | None:
    """The definition of a standard type alone, without those of nested types; None of others."""
    package, _, leaf = name.rpartition("/")
    key = name if "/" in package else f"{package}/msg/{leaf}"
    store = typestore(_RELEASES[ros])
    if key not in store.fielddefs:
        return None
    text, _ = store.generate_msgdef(key, ros_version=ros)
    return text.split("=" * 80, maxsplit=1)[0]


class _Extent(Struct, frozen=True):
    """Size of an unfolded type: levels, fields, least bytes."""

    depth: int
    fields: int
    size: int


class _Resolver:
    """Resolves type names to types, each type once."""

    def __init__(self, owner: str, types: dict[str, list[RawField]], ros: int) -> None:
        self._owner = owner
        self._types = types
        self._ros = ros
        self._done: dict[str, tuple[MessageType, _Extent]] = {}
        self._open: set[str] = set()
        self._by_leaf: dict[str, list[str]] = {}
        for name in types:
            self._by_leaf.setdefault(name.rpartition("/")[2], []).append(name)

    def _fail(self, what: str) -> DefinitionError:
        return DefinitionError(f"{self._owner}: {what}")

    def message(self, name: str) -> tuple[MessageType, _Extent]:
        if name in self._done:
            return self._done[name]
        if name in self._open:
            raise self._fail(f"{name} contains itself")
        if len(self._open) >= MAX_DEPTH:
            raise self._fail(f"messages are nested deeper than {MAX_DEPTH}")
        raw_fields = self._types.get(name)
        if raw_fields is None:
            text = standard_text(name, self._ros)
            if text is None:
                raise self._fail(f"the definition does not say what {name} is")
            raw_fields = parse_msg(name, text, defaults=self._ros == 2)
        if [raw.name for raw in raw_fields] == [_DUMMY]:
            raw_fields = []
        self._open.add(name)
        fields: dict[str, FieldType] = {}
        depth, count, size = 0, 0, 0
        for raw in raw_fields:
            if not NAME.match(raw.name) or len(raw.name) > MAX_NAME:
                raise self._fail(f"{name} has a field that cannot be named {raw.name[:80]!r}")
            if raw.name in fields:
                raise self._fail(f"{name} has two fields named {raw.name}")
            fields[raw.name], inner = self._field(name, raw)
            depth = max(depth, inner.depth)
            count += 1 + inner.fields
            size += inner.size
        self._open.discard(name)
        extent = _Extent(depth + 1, count, size)
        self._check(name, extent)
        self._done[name] = MessageType(name, tuple(fields.items())), extent
        return self._done[name]

    def _check(self, name: str, extent: _Extent) -> None:
        if extent.depth > MAX_DEPTH:
            raise self._fail(f"messages are nested deeper than {MAX_DEPTH}")
        if extent.fields > MAX_FIELDS:
            raise self._fail(
                f"{name} unfolds to {extent.fields} fields; at most {MAX_FIELDS} are indexed"
            )
        if extent.size > MAX_FIXED_BYTES:
            raise self._fail(f"{name} takes {extent.size} bytes at the least: no message can")

    def _field(self, owner: str, raw: RawField) -> tuple[FieldType, _Extent]:
        element, extent = self._element(owner, raw)
        if not raw.array:
            return element, extent
        width = raw.width
        depth = extent.depth + (extent.depth > 0)
        if width is None:
            return ArrayOf(element, None, raw.bound), _Extent(depth, extent.fields, 4)
        if width > MAX_WIDTH or (width == 0 and self._ros == 2):
            least = 0 if self._ros == 1 else 1
            raise self._fail(
                f"{owner}.{raw.name} has {width} elements; from {least} to {MAX_WIDTH} are indexed"
            )
        extent = _Extent(depth, extent.fields, extent.size * width)
        return ArrayOf(element, width), extent

    def _element(self, owner: str, raw: RawField) -> tuple[FieldType, _Extent]:
        kind = raw.type
        if raw.text_bound is not None and kind not in {"string", "wstring"}:
            raise self._fail(f"{owner}.{raw.name}: only strings have a length bound")
        if kind in _NOT_PORTABLE:
            raise self._fail(f"not indexed: {kind} has no portable wire form")
        if kind == "string":
            return Text(raw.text_bound), _Extent(0, 0, 4)
        if kind in _WORDS:
            code = "i1" if kind == "byte" and self._ros == 1 else DTYPES[kind]
            primitive = Primitive(kind, code)
            return primitive, _Extent(0, 0, primitive.size)
        name = self._name(owner, kind)
        if (instant := self._instant(name)) is not None:
            return instant, _Extent(0, 0, 8)
        return self.message(name)

    def _name(self, owner: str, kind: str) -> str:
        """The canonical name of a type spelled `kind` within `owner`."""
        name = canonical(kind)
        if "/" in name:
            return name
        if name in {"time", "duration"}:
            return name if self._ros == 1 else f"builtin_interfaces/{name.capitalize()}"
        package = owner.split("/", maxsplit=1)[0] if "/" in owner else ""
        here = [f"{owner.rpartition('/')[0]}/{name}", f"{package}/{name}"] if package else [name]
        for candidate in here:
            if candidate in self._types:
                return candidate
        if name == "Header":
            return "std_msgs/Header"
        named = self._by_leaf.get(name, [])
        return named[0] if len(named) == 1 else here[-1]

    def _instant(self, name: str) -> Instant | None:
        """The time or duration type of this name, in any spelling, else None."""
        if self._ros == 1:
            if name in _TIME_TYPES and name not in self._types:
                return _ROS1_TIMES[_TIME_TYPES[name]]
            return _ROS1_TIMES.get(name)
        kind = _TIME_TYPES.get(name)
        is_usual = self._types.get(name, _TIME_FIELDS) == _TIME_FIELDS
        return Instant(kind, True, False) if kind is not None and is_usual else None


def type_text(field_type: FieldType) -> str:
    """A type in the spelling of a definition: `float64[9]`, `string<=10`, `time`."""
    if isinstance(field_type, Text):
        return "string" if field_type.bound is None else f"string<={field_type.bound}"
    if isinstance(field_type, Instant):
        return field_type.kind
    if isinstance(field_type, ArrayOf):
        size = "" if field_type.width is None else str(field_type.width)
        if field_type.bound is not None:
            size = f"<={field_type.bound}"
        return f"{type_text(field_type.element)}[{size}]"
    return field_type.name


def paths(message_type: MessageType) -> list[FieldPath]:
    """All fields for predicates, in the order of the definition.

    Messages and arrays of messages precede their content.
    """
    found: list[FieldPath] = []

    def visit(message: MessageType, prefix: str, *, within_array: bool) -> None:
        for name, field_type in message.fields:
            path = prefix + name
            array = within_array or isinstance(field_type, ArrayOf)
            found.append(FieldPath(path, type_text(field_type), array))
            inner = field_type
            while isinstance(inner, ArrayOf):
                inner, path = inner.element, f"{path}[]"
            if isinstance(inner, MessageType):
                visit(inner, f"{path}.", within_array=array)

    visit(message_type, "", within_array=False)
    return found
