"""Parses OMG IDL as ROS 2 uses it: modules, structs, typedefs, constants, enums.

A tokenizer and a recursive-descent parser for the few constructs with a ROS wire form.
Every other construct is refused by name. Constants matter only as array sizes. As for rosidl,
a size is a number or the name of a constant, and no expression of several.

The parser of rosbags is not used: it does not know enums, and fails on deep nesting.
"""

from __future__ import annotations

import re

from msgspec import Struct, field
from msgspec.structs import replace

from hybridlog.schema.definition_text import RawField, canonical
from hybridlog.schema.kinds import INTEGERS
from hybridlog_storage.errors import DefinitionError

# An unclosed token extends to the end of the text. Otherwise a failed match would be
# retried at the next character, in quadratic time.
_TOKEN = re.compile(
    r"""(?P<skip>\s+|//[^\n]*|/\*(?s:.*?)(?:\*/|\Z)|\#[^\n]*)
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


class _Parser:
    """Scopes are the names of the modules around a place, each with a slash behind it."""

    def __init__(self, owner: str, text: str, types: IdlTypes) -> None:
        self._owner = owner
        self._types = types
        self._tokens = [
            match.group() for match in _TOKEN.finditer(text) if match.lastgroup != "skip"
        ]
        self._at = 0
        self._definitions = {
            "module": self._module,
            "struct": self._struct,
            "typedef": self._typedef,
            "const": self._constant,
            "enum": self._enum,
        }

    def parse(self) -> None:
        while self._peek():
            self._definition("")

    def _fail(self, what: str) -> DefinitionError:
        return DefinitionError(f"{self._owner}: {what}")

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _next(self) -> str:
        token = self._peek()
        if not token:
            raise self._fail("the IDL text ends too early")
        self._at += 1
        return token

    def _take(self, sign: str) -> bool:
        """Skip a sign if it is next."""
        found = self._peek() == sign
        self._at += found
        return found

    def _expect(self, sign: str) -> None:
        if not self._take(sign):
            raise self._fail(f"expected {sign!r}, found {self._next()[:40]!r}")

    def _name(self) -> str:
        token = self._next()
        if not (token[0].isalpha() or token[0] == "_") or ":" in token:
            raise self._fail(f"expected a name, found {token[:40]!r}")
        return token

    def _annotations(self) -> set[str]:
        """Skip annotations; return their names."""
        found = set()
        while self._take("@"):
            found.add(self._next())
            depth = int(self._take("("))
            while depth:
                depth += {"(": 1, ")": -1}.get(self._next(), 0)
        return found

    def _definition(self, scope: str) -> None:
        if scope.count("/") > _MAX_DEPTH:
            raise self._fail("modules are nested too deep")
        annotations, word = self._annotations(), self._next()
        if word == "enum" and "bit_bound" in annotations:
            raise self._fail("not indexed: an enum with a bit bound")
        if word in self._definitions:
            self._definitions[word](scope)
        elif word != ";":
            raise self._fail(f"not indexed: IDL {word[:40]!r} has no ROS wire form")
        self._take(";")

    def _module(self, scope: str) -> None:
        inner = f"{scope}{self._name()}/"
        self._expect("{")
        while not self._take("}"):
            self._definition(inner)

    def _struct(self, scope: str) -> None:
        name = scope + self._name()
        if self._peek() == ";":
            return  # declared here, defined elsewhere
        if self._peek() == ":":
            raise self._fail("not indexed: a struct that inherits")
        self._expect("{")
        fields: list[RawField] = []
        while not self._take("}"):
            if "optional" in self._annotations():
                raise self._fail("not indexed: optional members")
            fields += self._declared(name)
        if name in self._types.structs:
            raise self._fail(f"{canonical(name)} is defined twice")
        self._types.structs[name] = fields

    def _typedef(self, scope: str) -> None:
        for raw in self._declared(scope):
            self._types.typedefs[scope + raw.name] = raw

    def _declared(self, scope: str) -> list[RawField]:
        """Parse a type and its declarators, up to the semicolon."""
        kind = self._type(scope)
        fields: list[RawField] = []
        while not fields or self._take(","):
            raw = replace(kind, name=self._name())
            if self._take("["):
                width = self._size(scope, "]")
                if raw.array or self._peek() == "[":
                    raise self._fail(f"field {raw.name[:80]} is an array of arrays: not indexed")
                raw = replace(raw, array=True, width=width)
            fields.append(raw)
        self._expect(";")
        return fields

    def _type(self, scope: str) -> RawField:
        word = self._next()
        if word == "sequence":
            self._expect("<")
            if self._peek() == "sequence":
                raise self._fail("a sequence of sequences: not indexed")
            element = self._type(scope)
            bound = self._size(scope, ">") if self._take(",") else None
            if bound is None:
                self._expect(">")
            return replace(element, array=True, bound=bound)
        if word in {"unsigned", "long"}:
            while self._peek() in {"long", "short", "double"}:
                word += " " + self._next()
        if word in {"string", "wstring"} and self._take("<"):
            return RawField("", word, text_bound=self._size(scope, ">"))
        if word in _WORDS:
            return RawField("", _WORDS[word])
        if not (word[0].isalpha() or word[0] in "_:") or " " in word:
            raise self._fail(f"expected a type, found {word[:40]!r}")
        return RawField("", word)

    def _size(self, scope: str, end: str) -> int:
        """An array size and the sign behind it."""
        begin, number = self._at, self._value(scope, end)
        if number is None:
            found = " ".join(self._tokens[begin : self._at - 1])
            raise self._fail(f"an array size must be a number or a constant, found {found[:40]!r}")
        return number

    def _value(self, scope: str, end: str) -> int | None:
        """A number or a constant, up to a sign; None for anything else."""
        tokens: list[str] = []
        while (token := self._next()) != end:
            tokens.append(token)
        if len(tokens) != 1:
            return None
        known = map(self._types.constants.get, _candidates(scope, tokens[0]))
        return next((n for n in (_integer(tokens[0]), *known) if n is not None), None)

    def _constant(self, scope: str) -> None:
        self._type(scope)
        name = self._name()
        self._expect("=")
        number = self._value(scope, ";")
        if number is not None:
            self._types.constants[scope + name] = number

    def _enum(self, scope: str) -> None:
        self._types.typedefs[scope + self._name()] = RawField("", _ENUM)
        self._expect("{")
        while not self._take("}"):
            self._next()


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
    _Parser(owner, text, types).parse()
