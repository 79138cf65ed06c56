"""Parses `.msg`, `.srv`, `.action` and IDL definitions into unresolved fields.

Each line is one field, so lines are matched one by one. As in genmsg, only a newline ends a
line or a comment. `definition.py` resolves the type names of the result. Text without a wire
form (comments, constants, defaults, annotations) is dropped here.

The parser of rosbags is not used: it refuses CRLF, a byte order mark, services and missing
newlines, reads prose as fields, and takes 3 s for 20,000 blank lines. Its parser of IDL does not
know enums, and fails on deep nesting.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from msgspec import Struct, field
from msgspec.structs import replace

from hybridlog_storage.errors import DefinitionError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

# Names of the primitive types of fields. A new type of number is added here: its bytes on the wire
# follow from its numpy type, its column from `pa.from_numpy_dtype`.
DTYPES: Final = {
    "bool": "?",
    "byte": "u1",  # signed in ROS 1
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
"""Numpy type of each primitive type."""
FLOATS: Final = frozenset(name for name, dtype in DTYPES.items() if dtype[0] == "f")
INTEGERS: Final = frozenset(name for name, dtype in DTYPES.items() if dtype[0] in "iu")
NUMBERS: Final = FLOATS | INTEGERS
TIMES: Final = frozenset({"time", "duration"})
NUMERIC: Final = NUMBERS | TIMES | {"bool"}
"""Types whose values can be drawn as numbers."""

_ARRAY = re.compile(r"(?P<element>.*)\[(?P<bound><=)?(?P<width>\d*)\]", re.DOTALL)


def element_of(kind: str) -> str | None:
    """Type of the elements of an array type; None if it is no array."""
    found = _ARRAY.fullmatch(kind)
    return None if found is None else found["element"]


def width_of(kind: str) -> int | None:
    """Number of elements of an array type whose length is fixed: 9 for `float64[9]`."""
    found = _ARRAY.fullmatch(kind)
    return int(found["width"]) if found and found["width"] and not found["bound"] else None


MAX_NAME = 255
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")

_HEADER = r"\s*(MSG|IDL|SRV|ACTION):[^\S\n]*(\S+)[^\S\n]*(?:\n|\Z)"
_FIRST_LINE = re.compile(_HEADER)
# A line of `=`, or a rule in front of a header where the newlines around it are missing.
_RULE = re.compile(rf"^={{20,}}[^\S\n]*(?:\n|\Z)|(?<!=)={{80,}}(?={_HEADER})", re.MULTILINE)
_PARTS = re.compile(r"^[^\S\n]*---[^\S\n]*$", re.MULTILINE)
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][A-Za-z0-9_/]*)"
    r"(?:<=(?P<text_bound>[0-9]{1,10}))?"
    r"(?P<array>\[(?P<at_most><=)?(?P<count>[0-9]{0,10})\])?"
    r"[ \t]+(?P<name>[A-Za-z0-9_]+)(?=[ \t=#]|\Z)"
    r"[ \t]*(?P<rest>.*)\Z"
)


class RawField(Struct, frozen=True):
    """An unresolved field; its type is a name.

    Attributes:
        name: Field name, not yet checked.
        type: A primitive by its ROS name, or a message by its canonical or bare name.
        width: Number of elements of a fixed array.
        bound: Largest number of elements of a bounded sequence.
        text_bound: Largest length of a bounded string.
    """

    name: str
    type: str
    array: bool = False
    width: int | None = None
    bound: int | None = None
    text_bound: int | None = None


def canonical(name: str) -> str:
    """The canonical spelling of a type: `pkg/Name`, `pkg/srv/Name`.

    The part `msg` is dropped; only ROS 2 uses it.
    """
    parts = name.replace("::", "/").strip("/").split("/")
    if len(parts) > 2 and parts[-2] == "msg":
        del parts[-2]
    return "/".join(parts)


def split_sections(text: str) -> list[tuple[str, str, str]]:
    """Split a concatenation of definitions at its lines of `=`, each followed by a header line.

    The newlines around such a line may be missing. Returns type, kind (`MSG`, `IDL`, `SRV` or
    `ACTION`) and text of each definition; type and kind are empty for a first one without header.
    """
    text = text.removeprefix("\ufeff")
    rules = [*_RULE.finditer(text)]
    begins, ends = [0, *(one.end() for one in rules)], [*(one.start() for one in rules), len(text)]
    sections: list[tuple[str, str, str]] = []
    for part in (text[begin:end] for begin, end in zip(begins, ends, strict=True)):
        header = _FIRST_LINE.match(part)
        if header is not None:
            sections.append((header[2], header[1], part[header.end() :]))
        elif part.strip() or (part and not sections):
            sections.append(("", "", part))
    return sections or [("", "", "")]


def parse_msg(name: str, text: str, *, defaults: bool) -> list[RawField]:
    """Parse the fields of one `.msg` text, in order; with `defaults`, values may follow (ROS 2)."""
    fields: list[RawField] = []
    for number, raw_line in enumerate(text.split("\n"), 1):
        line = raw_line.strip()
        if not line or line[0] in "#@":
            continue
        match = _FIELD.match(line)
        if match is None:
            raise DefinitionError(f"{name}: line {number} is not a field: {line[:80]!r}")
        rest = match["rest"]
        if rest.startswith("="):
            continue
        if rest and not rest.startswith("#") and not defaults:
            raise DefinitionError(f"{name}: line {number} is not a field: {line[:80]!r}")
        count = int(match["count"]) if match["count"] else None
        at_most = match["at_most"] is not None
        if at_most and count is None:
            raise DefinitionError(f"{name}: line {number} has a bound without a number")
        fields.append(
            RawField(
                name=match["name"],
                type=match["type"],
                array=match["array"] is not None,
                width=None if at_most else count,
                bound=count if at_most else None,
                text_bound=int(match["text_bound"]) if match["text_bound"] else None,
            )
        )
    return fields


def _event(stem: str) -> list[RawField]:
    return [
        RawField("info", "service_msgs/ServiceEventInfo"),
        RawField("request", f"{stem}_Request", array=True, bound=1),
        RawField("response", f"{stem}_Response", array=True, bound=1),
    ]


def interface_of(name: str) -> str:
    """The service or action of a derived type: `pkg/srv/Name` of `pkg/srv/Name_Event`."""
    return _PART_SUFFIX.sub("", name)


_PART_SUFFIX = re.compile(
    r"(?:_(?:SendGoal|GetResult))?_(?:Event|Request|Response)\Z|_(?:Goal|Result|Feedback|FeedbackMessage)\Z"
)


def parse_parts(name: str, text: str) -> dict[str, list[RawField]]:
    """Fields of types derived from a `.srv` (two parts) or `.action` (three parts) text.

    ROS 2 records services and actions as messages of derived types such as `pkg/srv/Name_Event`,
    and stores the text of the service or action with them. `name` is the canonical name of any of
    these, or of the interface itself.
    """
    parts = _PARTS.split(text)
    if len(parts) not in {2, 3}:
        raise DefinitionError(f"{name}: {len(parts)} parts; a service has 2 and an action 3")
    stem = interface_of(name)
    names = _SERVICE if len(parts) == 2 else _ACTION
    found = {
        f"{stem}{part}": parse_msg(name, inner, defaults=True)
        for part, inner in zip(names, parts, strict=True)
    }
    return found | derived_from(stem, found)


_SERVICE = ("_Request", "_Response")
_ACTION = ("_Goal", "_Result", "_Feedback")


def derived_from(stem: str, known: Collection[str]) -> dict[str, list[RawField]]:
    """Types that ROS 2 derives from the parts of a service or an action, if all are known."""
    if all(f"{stem}{part}" in known for part in _SERVICE):
        return {f"{stem}_Event": _event(stem)}
    if not all(f"{stem}{part}" in known for part in _ACTION):
        return {}
    goal_id = RawField("goal_id", "unique_identifier_msgs/UUID")
    return {
        f"{stem}_FeedbackMessage": [goal_id, RawField("feedback", f"{stem}_Feedback")],
        f"{stem}_SendGoal_Request": [goal_id, RawField("goal", f"{stem}_Goal")],
        f"{stem}_SendGoal_Response": [
            RawField("accepted", "bool"),
            RawField("stamp", "builtin_interfaces/Time"),
        ],
        f"{stem}_SendGoal_Event": _event(f"{stem}_SendGoal"),
        f"{stem}_GetResult_Request": [goal_id],
        f"{stem}_GetResult_Response": [
            RawField("status", "int8"),
            RawField("result", f"{stem}_Result"),
        ],
        f"{stem}_GetResult_Event": _event(f"{stem}_GetResult"),
    }


def has_parts(text: str) -> bool:
    """True if a text is that of a service or an action."""
    return bool(_PARTS.search(text))


# OMG IDL as ROS 2 uses it: modules, structs, typedefs, constants, enums. A tokenizer and a
# recursive-descent parser for the few constructs with a ROS wire form; every other construct is
# refused by name. Constants matter only as array sizes. As for rosidl, a size is a number or the
# name of a constant, and no expression of several.

# An unclosed token extends to the end of the text. Otherwise a failed match would be
# retried at the next character, in quadratic time.
_TOKEN = re.compile(
    r"""(?P<skip>\s+|//[^\n]*|/\*(?s:.*?)(?:\*/|\Z)|\#[^\n]*)
      |(?P<note>@\s*[A-Za-z_:][A-Za-z0-9_:]*)
      |(?P<name>(?:::)?[A-Za-z_][A-Za-z0-9_]*(?:::[A-Za-z_][A-Za-z0-9_]*)*)
      |(?P<number>[0-9][0-9A-Za-z_.]*)
      |(?P<text>"(?s:[^"\\]|\\.)*\\?(?:"|\Z)|'(?s:[^'\\]|\\.)*\\?(?:'|\Z))
      |(?P<sign>.)""",
    re.VERBOSE,
)
_MAX_DEPTH = 16
_MAX_DIGITS = 20
_WORDS = {
    "boolean": "bool",
    "octet": "byte",
    "char": "char",
    "wchar": "wchar",
    "short": "int16",
    "long": "int32",
    "long long": "int64",
    "long double": "float128",
    "unsigned short": "uint16",
    "unsigned long": "uint32",
    "unsigned long long": "uint64",
    "float": "float32",
    "double": "float64",
    "string": "string",
    "wstring": "wstring",
    **{name: name for name in INTEGERS if "int" in name},
}
_PRIMITIVES = frozenset(_WORDS.values())
_ENUM = "uint32"


class IdlTypes(Struct):
    """Declarations of all IDL texts of one definition, by scoped name with slashes."""

    structs: dict[str, list[RawField]] = field(default_factory=dict)
    typedefs: dict[str, RawField] = field(default_factory=dict)
    constants: dict[str, int] = field(default_factory=dict)

    def resolved(self) -> dict[str, list[RawField]]:
        """Structs by canonical name, with typedefs resolved."""
        return {
            canonical(name): [self._resolve(name, raw) for raw in fields]
            for name, fields in self.structs.items()
        }

    def _resolve(self, scope: str, raw: RawField) -> RawField:
        for _ in range(_MAX_DEPTH):
            if raw.type in _PRIMITIVES:
                return raw
            target = next(filter(self._is_known, _candidates(scope, raw.type)), raw.type)
            if target not in self.typedefs:
                return replace(raw, type=canonical(target))
            alias = self.typedefs[target]
            if raw.array and alias.array:
                raise DefinitionError(
                    f"{canonical(scope)}: field {raw.name} is an array of arrays: not indexed"
                )
            shape = raw if raw.array else alias
            raw = replace(shape, name=raw.name, type=alias.type, text_bound=alias.text_bound)
            scope = target
        raise DefinitionError(f"{canonical(scope)}: typedefs refer to each other in a circle")

    def _is_known(self, name: str) -> bool:
        return name in self.typedefs or name in self.structs


def _candidates(scope: str, name: str) -> list[str]:
    """Possible scoped names of a name, innermost scope first."""
    path = name.replace("::", "/")
    if path.startswith("/"):
        return [path[1:]]
    parts = scope.split("/")[:-1]
    return ["/".join([*parts[:depth], path]) for depth in range(len(parts), -1, -1)]


# A declaration of one type, its words with a space in between.
_TYPE = r"[A-Za-z_:][\w:]*(?: (?:long|short|double))*(?: < [^<>]* >)?"
_DECLARATION = re.compile(
    rf"(?:sequence < (?P<element>{_TYPE})(?P<most> , [^<>]*)? >|(?P<type>{_TYPE})) (?P<names>.+)",
    re.DOTALL,
)


class _Parser:
    """Scopes are the names of the modules around a place, each with a slash behind it."""

    def __init__(self, owner: str, types: IdlTypes) -> None:
        self._owner = owner
        self._types = types

    def parse(self, text: str) -> None:
        scopes = [""]
        fields: list[RawField] | None = None  # of the struct that is open
        for words, end in self._statements(text):
            kind, *rest = words or [""]
            scope, name = scopes[-1], "".join(rest[:1])
            if len(scopes) > _MAX_DEPTH:
                raise self._fail("modules are nested too deep")
            if end == "}" and not words and scopes[1:]:
                scopes.pop()
                fields = None
            elif fields is not None and end == ";":
                fields += self._declared(scope, words) if words else []
            elif kind == "module" and end == "{" and len(rest) == 1:
                scopes.append(f"{scope}{name}/")
            elif kind == "struct" and end == "{" and fields is None:
                fields = self._struct(scope + name, rest)
                scopes.append(scope)
            elif kind == "enum" and end == "}":
                self._types.typedefs[scope + name] = RawField("", _ENUM)
            elif kind == "typedef" and end == ";":
                self._types.typedefs |= {
                    scope + raw.name: raw for raw in self._declared(scope, rest)
                }
            elif kind == "const" and end == ";":
                self._constant(scope, " ".join(rest))
            elif (words or end != ";") and (kind, end) != (
                "struct",
                ";",
            ):  # which is declared later
                raise self._fail(f"not indexed: IDL {kind[:40]!r} has no ROS wire form")
        if scopes[1:]:
            raise self._fail("the IDL text ends too early")

    def _statements(self, text: str) -> Iterator[tuple[list[str], str]]:
        """The words of each statement, and the sign behind it; an enum is one.

        Annotations are left out, unless they change the wire form.
        """
        words, depth = list[str](), 0
        for found in _TOKEN.finditer(text):
            word = found.group()
            depth += {"(": 1, ")": -1}.get(word, 0)
            if found.lastgroup == "note" and word[1:].strip() in {"optional", "bit_bound"}:
                raise self._fail(f"not indexed: IDL {word} has no ROS wire form")
            if depth or word == ")" or found.lastgroup in {"skip", "note"}:
                continue
            if word in ";}" or (word == "{" and words[:1] != ["enum"]):
                yield words, word
                words = []
            else:
                words.append(word)
        if words or depth:
            raise self._fail("the IDL text ends too early")

    def _fail(self, what: str) -> DefinitionError:
        return DefinitionError(f"{self._owner}: {what}")

    def _struct(self, name: str, words: list[str]) -> list[RawField]:
        if len(words) != 1:
            raise self._fail(f"{canonical(name)} inherits from another struct: not indexed")
        if name in self._types.structs:
            raise self._fail(f"{canonical(name)} is defined twice")
        return self._types.structs.setdefault(name, [])

    def _declared(self, scope: str, words: list[str]) -> list[RawField]:
        """The fields of one type that a statement declares."""
        text = " ".join(words)
        found = _DECLARATION.fullmatch(text)
        kind, _, size = (found["element"] or found["type"]).partition(" < ") if found else ("",) * 3
        kind = _WORDS.get(kind, kind)
        if found is None or " " in kind or (size and "string" not in kind):
            raise self._fail(f"not indexed: {text[:80]!r} has no ROS wire form")
        most, is_list = found["most"], found["element"] is not None
        bound = None if most is None else self._size(scope, most[3:])
        raw = RawField(
            "", kind, is_list, None, bound, self._size(scope, size[:-2]) if size else None
        )
        fields = []
        for one in found["names"].split(" , "):
            name, sign, width = one.partition(" [ ")
            if sign and (is_list or "[" in width):
                raise self._fail(f"field {name[:80]} is an array of arrays: not indexed")
            size = self._size(scope, width.rstrip("] ")) if sign else None
            fields.append(replace(raw, name=name, array=is_list or bool(sign), width=size))
        return fields

    def _size(self, scope: str, text: str) -> int:
        if (number := self._value(scope, text)) is None:
            raise self._fail(f"an array size must be a number or a constant, found {text[:40]!r}")
        return number

    def _value(self, scope: str, text: str) -> int | None:
        """A number or a constant; None for anything else."""
        known = map(self._types.constants.get, _candidates(scope, text))
        return next((n for n in (_integer(text), *known) if n is not None), None)

    def _constant(self, scope: str, text: str) -> None:
        declared, _, value = text.partition(" = ")
        if (number := self._value(scope, value)) is not None:
            self._types.constants[scope + declared.rpartition(" ")[2]] = number


def _integer(token: str) -> int | None:
    """Parse an unsigned integer literal: decimal, `0x` hexadecimal or octal."""
    if len(token) > _MAX_DIGITS:
        return None
    try:
        return int(re.sub(r"\A0(?=[0-9])", "0o", token), 0)
    except ValueError:
        return None


def parse_idl(owner: str, text: str, types: IdlTypes) -> None:
    """Add the declarations of one IDL file to `types`; later files see its constants."""
    _Parser(owner, types).parse(text)
