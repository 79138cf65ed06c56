"""The tokens of a predicate: field paths, numbers, strings, times, operators.

Text that forms no token raises `WhereError` with a caret under the place. The length of
the text is limited before it is processed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from hybridlog.query.predicate.tree import Parts, Slice
from hybridlog.query.times import parse_duration, parse_time
from hybridlog_storage.errors import TimeError, WhereError

MAX_TEXT = 10_000
"""Maximum length of a predicate, characters."""
MAX_TOKENS = 2_000
_WINDOW = 100

_PART = r"[^\W\d]\w*|`[^`]*`"
_FIRST = re.compile(_PART)
_DIGITS = "0123456789"
_NEXT = re.compile(
    rf"""\.(?P<name>{_PART}|[0-9]+)
    |\[\s*(?:(?P<begin>[0-9]*)\s*(?P<colon>:)\s*(?P<end>[0-9]*)|(?P<index>[0-9]+|\*)?)\s*\]""",
    re.VERBOSE,
)
_NUMBER_WORD = re.compile(r"\.?[0-9](?:[eE][+-](?=[0-9])|[0-9A-Za-z_.µμ])*")
_HEX = re.compile(r"0[xX][0-9a-fA-F]+")
_INTEGER = re.compile(r"[0-9]+")
_FLOAT = re.compile(r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_TOPIC = re.compile(
    r"""(?<![^\s(!])(?:re:\S*[^\s:]"""
    r"""|(?!\S*\[[^\s\]]*:|[0-9]+:)[^\s()"'`:!&|][^\s()"'`:]*):(?=\s|$)"""
)
"""The name of another topic with its colon."""
_OPERATOR = re.compile(r"==|!=|<=|>=|&&|\|\||!~|=~|[<>=~!()\[\],+-]")
_HINTS = {
    "&": "; write and",
    "|": "; write or",
    ":": "; behind the name of another topic a space follows: /odom: x > 1",
}
_STRING = re.compile(
    r"""(?P<quote>["'])(?P<body>(?:\\.|(?!(?P=quote))[^\\])*)(?P=quote)""", re.DOTALL
)
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|(.))", re.DOTALL)
_ESCAPES = {
    '"': '"',
    "'": "'",
    "\\": "\\",
    "/": "/",
    "n": "\n",
    "t": "\t",
    "r": "\r",
    "b": "\b",
    "f": "\f",
    "0": "\0",
}

Kind = Literal["path", "number", "time", "string", "operator", "topic", "end"]


@dataclass(frozen=True, slots=True)
class Token:
    """One token.

    Attributes:
        kind: Its kind; `time` is a number of nanoseconds, a time or a duration.
        text: The text as written; for a string, without its quotes.
        position: Index of its first character.
        number: Value of a `number` or `time`.
        path: Parts of a `path`: names, ints for array elements, slices. `[]` and `[*]`,
            any element, add no part.
        keyword: A path of one plain name, in lower case; empty for all others.
    """

    kind: Kind
    text: str
    position: int
    number: int | float = 0
    path: Parts = ()
    keyword: str = ""

    @property
    def end(self) -> int:
        """Index behind its last character."""
        return self.position + len(self.text) + 2 * (self.kind == "string")


def is_filter(text: str) -> bool:
    """True if a text is a MongoDB filter rather than a predicate."""
    return text.lstrip().startswith("{")


def error_at(text: str, position: int, message: str) -> WhereError:
    """The error: the message, the line of the text, a caret under the place."""
    begin = text.rfind("\n", 0, position) + 1
    finish = text.find("\n", position)
    line = text[begin : len(text) if finish < 0 else finish]
    column = position - begin
    if len(line) > _WINDOW:
        cut = max(0, column - _WINDOW // 2)
        line, column = line[cut : cut + _WINDOW], column - cut
    # One column per character, without control characters.
    line = "".join(char if char.isprintable() else "?" for char in line)
    return WhereError(f"{message}\n  {line}\n  {' ' * column}^")


def tokenize(text: str) -> list[Token]:
    """The tokens of a predicate, followed by an `end`."""
    if len(text) > MAX_TEXT:
        raise WhereError(
            f"the predicate has {len(text)} characters, at most {MAX_TEXT} are allowed"
        )
    tokens: list[Token] = []
    at = 0
    while True:
        while at < len(text) and text[at].isspace():
            at += 1
        if at >= len(text):
            tokens.append(Token("end", "", len(text.rstrip())))
            return tokens
        token, at = _next(text, at)
        tokens.append(token)
        if len(tokens) > MAX_TOKENS:
            raise error_at(text, token.position, f"the predicate has more than {MAX_TOKENS} words")


def unescape(text: str, token: Token) -> str:
    """The value of a string token."""

    def replace(match: re.Match[str]) -> str:
        if match[1]:
            return chr(int(match[1], 16))
        if match[2] in _ESCAPES:
            return _ESCAPES[match[2]]
        place = token.position + 1 + match.start()
        raise error_at(text, place, f"there is no escape \\{match[2]}; write \\\\ for a backslash")

    value = _ESCAPE.sub(replace, token.text)
    try:
        # Pairs of surrogates become one character.
        return value.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        raise error_at(text, token.position, "the string has half a surrogate pair") from None


def regex_text(token: Token) -> str:
    r"""The pattern of a string token, with its backslashes: `"\d+"` means digits."""
    return token.text.replace('\\"', '"').replace("\\'", "'")


def _next(text: str, at: int) -> tuple[Token, int]:
    char = text[at]
    if topic := _TOPIC.match(text, at):
        return Token("topic", topic[0], at), topic.end()
    if char in "\"'":
        return _string(text, at)
    if char in "tT" and text[at + 1 : at + 2] in {'"', "'"}:
        return _time(text, at)
    if word := _NUMBER_WORD.match(text, at):
        return _number(text, word)
    if first := _FIRST.match(text, at):
        return _path(text, first)
    if operator := _OPERATOR.match(text, at):
        return Token("operator", operator[0], at), operator.end()
    hint = _HINTS.get(char, "")
    raise error_at(text, at, f"{char!r} has no meaning here{hint}")


def _string(text: str, at: int) -> tuple[Token, int]:
    match = _STRING.match(text, at)
    if match is None:
        raise error_at(text, at, "the string is not closed")
    if any(0xD800 <= ord(char) <= 0xDFFF for char in match["body"]):
        raise error_at(text, at, "the string is not valid Unicode")
    return Token("string", match["body"], at), match.end()


def _time(text: str, at: int) -> tuple[Token, int]:
    inner, end = _string(text, at + 1)
    try:
        ns = parse_time(inner.text, start=None, end=None)
    except TimeError as error:
        raise error_at(text, at, str(error)) from None
    return Token("time", text[at:end], at, number=ns), end


def _number(text: str, word: re.Match[str]) -> tuple[Token, int]:
    written, at = word[0], word.start()
    kind: Kind = "number"
    value: int | float
    if len(written) > 400:
        raise error_at(text, at, "the number has more than 400 characters")
    if _HEX.fullmatch(written) or _INTEGER.fullmatch(written):
        value = int(written, 16 if written[:2] in {"0x", "0X"} else 10)
    elif _FLOAT.fullmatch(written):
        value = float(written)
        if value == float("inf"):
            problem = "the number is too large for a double; write inf if that is meant"
            raise error_at(text, at, problem)
    else:
        kind = "time"
        try:
            value = parse_duration(written)
        except TimeError:
            raise error_at(
                text, at, f"{written!r} is neither a number nor a duration such as 500ms"
            ) from None
    return Token(kind, written, at, number=value), word.end()


def _path(text: str, first: re.Match[str]) -> tuple[Token, int]:
    at = first.start()
    parts: list[str | int | Slice] = [_name(text, at, first[0])]
    end = first.end()
    # `in[1, 2]` is the operator and a list, not an element of a field.
    is_in = first[0].lower() == "in"
    of_any = False
    while (match := _NEXT.match(text, end)) and not (is_in and text[end] == "["):
        name, is_slice = match["name"], match["colon"] is not None
        is_element = name is None or name[0] in _DIGITS
        if is_element and of_any:
            raise error_at(
                text,
                end,
                "any element can be asked only of named fields: write x[0][1], x[0][1:3] or x[*].y",
            )
        of_any = is_slice or (name is None and match["index"] in {None, "*"})
        if name is not None:
            parts.append(_index(text, end, name) if is_element else _part(text, end + 1, name))
        elif is_slice:
            parts.append(_slice(text, end, match["begin"], match["end"]))
        elif not of_any:
            parts.append(_index(text, end, match["index"]))
        end = match.end()
    if text[end : end + 1] == "[" and not is_in:
        raise error_at(text, end, "write an element as x[3], a slice as x[3:8]; both count from 0")
    if text[end : end + 1] == ".":
        raise error_at(text, end, "the field's name does not end")
    plain = end == first.end() and not first[0].startswith("`")
    keyword = first[0].lower() if plain else ""
    return Token("path", text[at:end], at, path=tuple(parts), keyword=keyword), end


def _name(text: str, at: int, name: str) -> str:
    """A part of a path, without its backquotes."""
    plain = name.strip("`")
    if not plain or "." in plain or "\0" in plain or plain.startswith("$"):
        raise error_at(text, at, "a name must not be empty, hold '.' or NUL, or begin with '$'")
    if any(0xD800 <= ord(char) <= 0xDFFF for char in plain):
        raise error_at(text, at, "the name is not valid Unicode")
    return plain


def _part(text: str, at: int, name: str) -> str | int:
    """A name after another; MongoDB treats a number as an index in an array."""
    plain = _name(text, at, name)
    is_place = plain.isascii() and plain.isdecimal() and str(int(plain[:10])) == plain
    return int(plain) if is_place else plain


def _index(text: str, at: int, digits: str) -> int:
    if len(digits) > 9:
        raise error_at(text, at, "the index is too large")
    return int(digits)


def _slice(text: str, at: int, begin: str, end: str) -> Slice:
    found = Slice(_index(text, at, begin or "0"), _index(text, at, end) if end else None)
    if found.end is not None and found.end <= found.begin:
        raise error_at(text, at, "the slice is empty: its end is the element after the last one")
    return found
