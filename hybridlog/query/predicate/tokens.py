"""The tokens of a predicate: topics, field paths, numbers, times, strings, operators.

Text that forms no token raises `WhereError` with a caret under the place. The length of
the text is limited before it is processed.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Literal, NamedTuple, TypeAlias, cast

from hybridlog.query.predicate.tree import Parts, Slice
from hybridlog.query.times import parse_duration, parse_time
from hybridlog_storage.errors import TimeError, WhereError

MAX_LENGTH = 1_000
"""Maximum length of a pattern, characters."""
_MAX_BYTES = 8 << 20  # of a compiled pattern; Arrow has the same limit
_REGEX_ESCAPE = re.compile(r"\\Q.*?(?:\\E|\Z)|\\(.)", re.DOTALL)
MAX_TEXT = 10_000
"""Maximum length of a predicate, characters."""
_WINDOW = 100

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
_HINTS = {
    "&": "; write and",
    "|": "; write or",
    ":": "; a slice is x[3:8], and a space follows the name of another topic: /odom: x > 1",
    ".": "; the field's name does not end",
    "'": "; the string is not closed",
    '"': "; the string is not closed",
    "`": "; a name must not be empty, hold '.' or NUL, or begin with '$'",
}
_INTEGER = re.compile(r"0[xX][0-9a-fA-F]+|[0-9]+")
_FLOAT = re.compile(r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|(.))", re.DOTALL)
_ESCAPES = dict(zip("\"'\\/ntrbf0", "\"'\\/\n\t\r\b\f\0", strict=True))

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
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise error_at(text, error.start, "the predicate is not valid Unicode") from None
    tokens: list[Token] = []
    at = 0
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise error_at(text, at, f"{text[at]!r} has no meaning here{_HINTS.get(text[at], '')}")
        if match.lastgroup != "space":
            tokens.append(_token(text, cast(Kind, match.lastgroup), match[0], at))
        at = match.end()
    return [*tokens, Token("end", "", len(text.rstrip()))]


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


def _token(text: str, kind: Kind, word: str, at: int) -> Token:
    if kind == "path":
        return Token(kind, word, at, path=_parts(text, at, word), keyword=word.lower())
    if kind == "number":
        return _number(text, word, at)
    if kind == "time":
        try:
            return Token(kind, word, at, parse_time(word[2:-1], start=None, end=None))
        except TimeError as error:
            raise error_at(text, at, str(error)) from None
    if kind == "operator":
        return Token(kind, word, at, keyword=word)
    return Token(kind, word[1:-1] if kind == "string" else word[:-1], at)


def _number(text: str, word: str, at: int) -> Token:
    if len(word) > 400:
        raise error_at(text, at, "the number has more than 400 characters")
    if _INTEGER.fullmatch(word):
        return Token("number", word, at, int(word, 16 if word[:2] in {"0x", "0X"} else 10))
    if _FLOAT.fullmatch(word):
        if float(word) == float("inf"):
            problem = "the number is too large for a double; write inf if that is meant"
            raise error_at(text, at, problem)
        return Token("number", word, at, float(word))
    try:
        return Token("time", word, at, parse_duration(word))
    except TimeError:
        problem = f"{word!r} is neither a number nor a duration such as 500ms"
        raise error_at(text, at, problem) from None


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
    """Compile a pattern in RE2's syntax.

    Args:
        pattern: The pattern as the user wrote it.
        max_length: Maximum length of the pattern, characters.
    """
    if len(pattern) > max_length:
        raise RegexError(f"longer than {max_length} characters")
    if any(escape[1] == "C" for escape in _REGEX_ESCAPE.finditer(pattern)):
        raise RegexError("\\C matches a byte, and strings are characters")
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
