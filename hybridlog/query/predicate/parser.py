r"""Predicates over message fields: `ranges.min < 0.5 and header.frame_id == "laser"`.

    expression  = term { ("or" | "||") term }
    term        = factor { ("and" | "&&") factor }
    factor      = ("not" | "!") factor | "(" expression ")" | condition | near
    near        = TOPIC ":" [ expression ]                  a message of another topic
    condition   = field ("==" | "=" | "!=" | "<" | "<=" | ">" | ">=") (value | field)
                | value order field [ order value ]             0 < x < 5
                | field [ "not" ] "in" "[" value { "," value } "]"
                | field ("~" | "=~" | "!~") string              a regular expression
                | field ("exists" | "missing")
    field       = "abs" "(" field ")"
                | name { "." name | "[" index "]" | "[" [ begin ] ":" [ end ] "]" | "[]" | "[*]" }
    value       = integer | 0xff | 1e-3 | inf | nan | "string" | true | false | null
                | t"2015-03-03T18:28:33.5Z" | 5ms | 1m30s

Keywords may be in any case; names are case-sensitive. A name that is no
identifier, or that is a keyword at the beginning of a condition, needs
backquotes: `` `a-b` ``. A path through an array (`status[].level`, `status.level`) means
*any* element. Different elements may satisfy several conditions on one array:
`0 < x < 5` means `0 < x and x < 5`. A slice `x[3:8]` is an array: the elements 3 to 7 of x,
as far as there are any. Times and durations are integer nanoseconds, as stored.

Two fields that are compared are single numbers or times of one message, and NaN equals nothing
there.

`!=`, `not in` and `!~` hold only where the field exists. For an array, they mean that no
element equals or matches the operand. `not (...)` is plain negation: it also holds where
the field is missing. Numbers are compared by value, whatever their type. A comparison of
different kinds (a number and a string) is false. NaN equals NaN and is neither less nor
greater than anything. A null is missing: `== null` is `missing`, `!= null` is `exists`.

The pattern of `~` is found anywhere in the string unless anchored; its backslashes have no
escaping of their own. It has RE2's syntax and takes linear time.

`TOPIC: expression` holds for a message if another one, of that topic and near in time,
satisfies the expression. A space follows the colon. Conditions behind a topic are about one
message of it, up to the next topic or the end of the brackets.

`x.min`, `x.max`, `x.mean` and `x.n` of an array are its least and greatest finite element,
their mean, and the number of elements. Where the types of the fields are unknown, a
field of that name in an element takes precedence. An order holds for an array if it
holds for any finite element.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from functools import lru_cache
from typing import Literal, NamedTuple, TypeAlias, cast

from msgspec.structs import replace

from hybridlog.query.predicate.tree import (
    ALWAYS,
    And,
    Condition,
    Field,
    Near,
    Node,
    Not,
    Op,
    Or,
    Order,
    Parts,
    Predicate,
    Slice,
    Value,
    error_at,
)
from hybridlog.query.times import parse_duration, parse_time
from hybridlog_storage.errors import TimeError, WhereError

MAX_LENGTH = 1_000
"""Maximum length of a pattern, characters."""
_MAX_BYTES = 8 << 20  # of a compiled pattern; Arrow has the same limit
MAX_TEXT = 10_000
"""Maximum length of a predicate, characters."""

_NAME = r"(?:[^\W\d]\w*|`[^`.$\0][^`.\0]*`)"
_SLICE = r"(?P<begin>[0-9]*)\s*(?P<colon>:)\s*(?P<end>[0-9]*)"
_PART = re.compile(
    rf"""\.?(?P<name>{_NAME})|\.(?P<digits>[0-9]+)"""
    rf"""|\[\s*(?:{_SLICE}|(?P<index>[0-9]+)|\*?)\s*\]"""
)
_STRING = r"""(?:"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*')"""
_TOKEN = re.compile(
    rf"""(?P<space>\s+)
    |(?P<topic>(?<![^\s(!])(?:re:\S*[^\s:]
        |(?!\S*\[[^\s\]]*:|[0-9]+:)[^\s()"'`:!&|][^\s()"'`:]*):(?=\s|$))
    |(?P<time>[tT]{_STRING})
    |(?P<string>{_STRING})
    |(?P<number>\.?[0-9](?:[eE][+-](?=[0-9])|[0-9A-Za-z_.µμ])*)
    |(?P<path>[iI][nN](?=\[)|{_NAME}
        (?:\.(?:{_NAME}|[0-9]+)|\[\s*(?:[0-9]*\s*:\s*[0-9]*|[0-9]+|\*?)\s*\])*)
    |(?P<operator>==|!=|<=|>=|&&|\|\||!~|=~|[<>=~!()\[\],+-])""",
    re.VERBOSE | re.DOTALL,
)
_INTEGER = re.compile(r"0[xX][0-9a-fA-F]+|[0-9]+")
_FLOAT = re.compile(r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_ESCAPE = re.compile(r"\\.|\"", re.DOTALL)

Kind = Literal["path", "number", "time", "string", "operator", "topic", "end"]


class Token(NamedTuple):
    """One token.

    Attributes:
        kind: Its kind; `time` is a number of nanoseconds, a time or a duration.
        text: The text as written; of a string without its quotes, of a topic without its colon.
        position: Index of its first character.
        number: Value of a `number` or `time`.
        path: Parts of a `path`: names, ints for array elements, slices. `[]` and `[*]`,
            any element, add no part.
        keyword: A path in lower case, which may be a keyword, or an operator; empty for others.
    """

    kind: Kind
    text: str
    position: int
    number: int | float = 0
    path: Parts = ()
    keyword: str = ""


def is_filter(text: str) -> bool:
    """True if a text is a MongoDB filter rather than a predicate."""
    return text.lstrip().startswith("{")


def tokenize(text: str) -> list[Token]:
    """The tokens of a predicate, followed by an `end`."""
    if len(text) > MAX_TEXT:
        raise WhereError(
            f"the predicate has {len(text)} characters, at most {MAX_TEXT} are allowed"
        )
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise error_at(text, error.start, "the predicate is not valid Unicode") from None
    tokens: list[Token] = []
    at = 0
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise error_at(text, at, f"{text[at]!r} has no meaning here")
        if match.lastgroup != "space":
            tokens.append(_token(text, cast(Kind, match.lastgroup), match[0], at))
        at = match.end()
    return [*tokens, Token("end", "", len(text.rstrip()))]


def unescape(text: str, token: Token) -> str:
    """The value of a string token, with the escapes of JSON."""
    quoted = _ESCAPE.sub(lambda m: {"\\'": "'", '"': '\\"'}.get(m[0], m[0]), token.text)
    try:
        value = str(json.loads(f'"{quoted}"', strict=False))
        value.encode()
    except ValueError:
        problem = "the string has escapes that JSON has not; write \\\\ for a backslash"
        raise error_at(text, token.position, problem) from None
    return value


def _token(text: str, kind: Kind, word: str, at: int) -> Token:
    number: int | float = 0
    try:
        if kind == "time":
            number = parse_time(word[2:-1], start=None, end=None)
        elif kind == "number":
            number = _number(word)
    except TimeError as error:
        raise error_at(text, at, str(error)) from None
    if kind == "path":
        return Token(kind, word, at, path=_parts(text, at, word), keyword=word.lower())
    inner = {"string": word[1:-1], "topic": word[:-1]}.get(kind, word)
    return Token(kind, inner, at, number, keyword=word if kind == "operator" else "")


def _number(word: str) -> int | float:
    """A number, or a duration in nanoseconds."""
    if len(word) > 400:
        raise TimeError("the number has more than 400 characters")
    if _INTEGER.fullmatch(word):
        return int(word, 16 if word[:2] in {"0x", "0X"} else 10)
    if not _FLOAT.fullmatch(word):
        return parse_duration(word)
    if math.isinf(float(word)):
        raise TimeError("the number is too large for a double; write inf if that is meant")
    return float(word)


def _parts(text: str, begin: int, word: str) -> Parts:
    """The parts of a path."""
    parts: list[str | int | Slice] = []
    of_any = False
    for match in _PART.finditer(word):
        name, digits, at = match["name"], match["digits"] or match["index"], begin + match.start()
        if name is None and of_any:
            raise error_at(
                text,
                at,
                "any element can be asked only of named fields: write x[0][1], x[0][1:3] or x[*].y",
            )
        of_any = name is None and digits is None
        if any(len(match[number] or "") > 9 for number in ("digits", "index", "begin", "end")):
            raise error_at(text, at, "the index is too large")
        if name is not None:
            plain = name.strip("`")
            # MongoDB treats a number as an index in an array.
            is_place = parts and plain.isascii() and plain.isdecimal() and len(plain) < 10
            parts.append(int(plain) if is_place and str(int(plain)) == plain else plain)
        elif digits is not None:
            parts.append(int(digits))
        elif match["colon"]:
            found = Slice(int(match["begin"] or 0), int(match["end"]) if match["end"] else None)
            if found.end is not None and found.end <= found.begin:
                problem = "the slice is empty: its end is the element after the last one"
                raise error_at(text, at, problem)
            parts.append(found)
    return tuple(parts)


# Regular expressions of RE2: every match takes linear time and bounded memory.


class RegexError(ValueError):
    """The reason why a pattern is refused."""


Regex: TypeAlias = "re.Pattern[str]"
"""A compiled pattern, which has `search` and `fullmatch` as one of Python has."""


@lru_cache(maxsize=256)
def compile_regex(pattern: str, max_length: int = MAX_LENGTH) -> Regex:
    """Compile a pattern in RE2's syntax, of at most so many characters."""
    if len(pattern) > max_length:
        raise RegexError(f"longer than {max_length} characters")
    import re2

    options = re2.Options()
    options.max_mem = _MAX_BYTES
    options.log_errors = False
    try:
        pattern.encode()
        return re2.compile(pattern, options)  # type: ignore[no-any-return]
    except UnicodeEncodeError:
        raise RegexError("is not valid Unicode") from None
    except re2.error as error:
        told = error.args[0]  # such as `missing ): (a`
        text = told.decode(errors="replace") if isinstance(told, bytes) else str(told)
        shown = "".join(char if char.isprintable() else "?" for char in text)
        raise RegexError(
            f"{shown}; patterns have RE2's syntax, without looking around and back references"
        ) from None


MAX_DEPTH = 50
"""Maximum nesting of brackets and negations."""

_ORDERS: dict[str, Order] = {
    "==": "==",
    "=": "==",
    "!=": "!=",
    "<": "<",
    "<=": "<=",
    ">": ">",
    ">=": ">=",
}
_TURNED: dict[Order, Order] = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}
_VALUE_WORDS: dict[str, Value | None] = {
    "true": True,
    "false": False,
    "null": None,
    "none": None,
    "inf": math.inf,
    "infinity": math.inf,
    "nan": math.nan,
}
_ENDS = frozenset({")", "and", "&&", "or", "||"})
"""Keywords behind a topic of which any message will do."""


def parse(text: str) -> Predicate:
    """Parse a predicate."""
    if not isinstance(text, str):
        raise WhereError(f"a predicate is text, not {type(text).__name__}")
    if is_filter(text):
        raise WhereError("MongoDB filters are not possible here: write a predicate, such as x > 1")
    return _parsed(text)


@lru_cache(maxsize=128)  # for a small topic, parsing takes as long as the answer
def _parsed(text: str) -> Predicate:
    return _Parser(text).parse()


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens = tokenize(text)
        self._at = 0
        self._depth = 0
        self._is_of_topic = False

    def parse(self) -> Predicate:
        if self._peek().kind == "end":
            raise WhereError("the predicate is empty; write for example: ranges.min < 0.5")
        root = self._or()
        if self._peek().kind != "end":
            raise self._fail(self._peek(), "expected 'and', 'or' or the end here")
        return Predicate(root, self._text)

    def _or(self) -> Node:
        return self._joined(Or, ("or", "||"), self._and)

    def _and(self) -> Node:
        return self._joined(And, ("and", "&&"), self._factor)

    def _joined(
        self, join: type[And | Or], words: tuple[str, str], item: Callable[[], Node]
    ) -> Node:
        """One item or several; those about another topic end before the next topic."""
        found = [item()]
        while not (self._is_of_topic and self._ends_topic()) and self._take(*words):
            found.append(item())
        return found[0] if len(found) == 1 else join(tuple(found))

    def _ends_topic(self) -> bool:
        at = self._at + 1
        while at < len(self._tokens) and self._tokens[at].keyword in {"not", "!", "("}:
            at += 1
        return at < len(self._tokens) and self._tokens[at].kind == "topic"

    def _factor(self) -> Node:
        token = self._peek()
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise self._fail(token, f"nested deeper than {MAX_DEPTH}")
        found: Node
        if token.kind == "topic":
            found = self._near(token)
        elif self._take("not", "!"):
            found = Not(self._factor())
        elif self._take("("):
            found = self._or()
            self._close(")")
        else:
            found = self._condition()
        self._depth -= 1
        return found

    def _near(self, token: Token) -> Near:
        if self._is_of_topic:
            raise self._fail(token, "a condition on another topic cannot stand behind this one")
        self._at += 1
        item: Node = ALWAYS
        if self._peek().kind != "end" and self._peek().keyword not in _ENDS:
            self._is_of_topic = True
            item = self._or()
            self._is_of_topic = False
        return Near(token.text, item)

    def _condition(self) -> Node:
        token = self._peek()
        if token.kind == "path" and token.keyword not in _VALUE_WORDS:
            return self._of_field(self._field())
        is_signed = token.keyword in {*_VALUE_WORDS, "+", "-"}
        if not is_signed and token.kind not in {"number", "time", "string"}:
            raise self._fail(token, "expected a condition here, such as: x < 5")
        # `0 < x`, `0 < x < 5`
        value = self._value()
        order = self._order()
        if order is None:
            raise self._fail(self._peek(), "expected a comparison here")
        field = self._field()
        turned = _TURNED.get(order, order)
        first = _compare(self._text, field, turned, value, token.position)
        second_order = self._order() if order in _TURNED else None
        if second_order is None:
            return first
        if second_order not in _TURNED:
            raise self._fail(self._peek(), "only <, <=, > and >= can follow here")
        return And((first, self._comparison(field, second_order)))

    def _of_field(self, field: Field) -> Node:
        token = self._peek()
        if (order := self._order()) is not None:
            behind = self._peek()
            if behind.kind != "path" or behind.keyword in _VALUE_WORDS:
                return self._comparison(field, order)
            other = self._field()
            compared = Condition(field, order, other=other, position=behind.position)
            return And((compared, Condition(other, "exists")))
        if self._take("~", "=~", "!~"):
            return self._match(field, negated=token.text == "!~")
        if self._take("exists", "missing"):
            return Condition(field, "exists" if token.keyword == "exists" else "missing")
        if self._take("in", "not"):
            if token.keyword == "not" and not self._take("in"):
                raise self._fail(self._peek(), "expected 'in' after 'not' here")
            return self._member(field, token, negated=token.keyword == "not")
        raise self._fail(
            token,
            "expected an operator here: ==, !=, <, <=, >, >=, in, not in, ~, !~, exists "
            "or missing (of a bool: field == true)",
        )

    def _comparison(self, field: Field, order: Order) -> Condition:
        position = self._peek().position
        return _compare(self._text, field, order, self._value(), position)

    def _member(self, field: Field, token: Token, *, negated: bool) -> Node:
        if not self._take("["):
            raise self._fail(self._peek(), "expected a list here: [1, 2]")
        values = [self._value()]
        while self._take(","):
            values.append(self._value())
        self._close("]")
        known = tuple(value for value in values if value is not None)
        op: Op = "not in" if negated else "in"
        found = Condition(field, op, known, position=token.position)
        if len(known) < len(values) and not negated:
            return Or((Condition(field, "missing"), found))
        return found

    def _match(self, field: Field, *, negated: bool) -> Node:
        token = self._peek()
        if token.kind != "string":
            raise self._fail(token, 'expected a pattern in quotes here: ~ "^base_"')
        self._at += 1
        # Backslashes stay: "\d+" means digits.
        pattern = token.text.replace('\\"', '"').replace("\\'", "'")
        try:
            compile_regex(pattern)
        except RegexError as error:
            raise self._fail(token, f"the pattern is refused: {error}") from None
        return Condition(field, "!~" if negated else "~", (pattern,), position=token.position)

    def _field(self) -> Field:
        token = self._peek()
        if token.kind != "path":
            raise self._fail(token, "expected the name of a field here")
        self._at += 1
        if token.keyword == "abs" and self._take("("):
            found = self._field()
            self._close(")")
            return replace(found, is_absolute=True)
        return Field(token.path, position=token.position)

    def _value(self) -> Value | None:
        sign = {"-": -1, "+": 1}.get(self._peek().keyword, 0)
        self._at += bool(sign)
        token = self._peek()
        self._at += 1
        if token.kind in {"number", "time"}:
            return -token.number if sign < 0 else token.number
        if token.keyword in {"inf", "infinity"}:
            return -math.inf if sign < 0 else math.inf
        if sign:
            raise self._fail(token, "expected a number here")
        if token.kind == "string":
            return unescape(self._text, token)
        if token.keyword in _VALUE_WORDS:
            return _VALUE_WORDS[token.keyword]
        if token.kind == "path":
            raise self._fail(token, "expected a value here (strings need quotes)")
        raise self._fail(token, "expected a value here")

    def _order(self) -> Order | None:
        order = _ORDERS.get(self._peek().keyword)
        self._at += order is not None
        return order

    def _peek(self) -> Token:
        return self._tokens[self._at]

    def _take(self, *words: str) -> bool:
        """Consume the next token if it is one of these words or operators."""
        is_one = self._peek().keyword in words
        self._at += is_one
        return is_one

    def _close(self, bracket: str) -> None:
        if not self._take(bracket):
            raise self._fail(self._peek(), f"expected '{bracket}' here")

    def _fail(self, token: Token, message: str) -> WhereError:
        return error_at(self._text, token.position, message)


def _compare(
    text: str, field: Field, order: Order, value: Value | None, position: int
) -> Condition:
    is_order = order not in {"==", "!="}
    if value is None and not is_order:
        return Condition(field, "missing" if order == "==" else "exists")
    if value is None or (is_order and isinstance(value, bool)):
        raise error_at(text, position, "only numbers, times and strings have an order")
    if is_order and isinstance(value, float) and math.isnan(value):
        raise error_at(text, position, "nothing is less or greater than nan; write == nan")
    return Condition(field, order, (value,), position=position)
