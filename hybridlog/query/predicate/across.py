r"""Predicates with conditions on other topics: `/odom: v > 0.5 and not /battery: level < 0.2`.

    expression  = term { ("or" | "||") term }
    term        = factor { ("and" | "&&") factor }
    factor      = ("not" | "!") factor | "(" expression ")" | [ TOPIC ":" ] predicate

`TOPIC: predicate` holds for a message if another one, of that topic and near in time,
satisfies the predicate. The predicate reaches to the next topic, or to the end of the
brackets; what joins it to the next topic is the last `and` or `or` before that. A colon
is followed by a space. Without a topic, a predicate is about the message itself.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from hybridlog.query.predicate.parser import MAX_DEPTH
from hybridlog.query.predicate.tokens import MAX_TEXT, MAX_TOKENS, error_at, is_filter
from hybridlog_storage.errors import WhereError


@dataclass(frozen=True, slots=True)
class Own:
    """A predicate about the message itself."""

    predicate: str


@dataclass(frozen=True, slots=True)
class Near:
    """A message of another topic near in time.

    Attributes:
        topic: As written.
        predicate: What it satisfies; empty for any message.
    """

    topic: str
    predicate: str


@dataclass(frozen=True, slots=True)
class All:
    """All of some conditions."""

    parts: tuple[Condition, ...]


@dataclass(frozen=True, slots=True)
class AnyOf:
    """At least one of some conditions."""

    parts: tuple[Condition, ...]


@dataclass(frozen=True, slots=True)
class NoneOf:
    """The opposite of a condition."""

    part: Condition


Condition: TypeAlias = Own | Near | All | AnyOf | NoneOf

_TOKEN = re.compile(
    r"""(?P<string>"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|`[^`]*`)
    |(?P<topic>(?<![^\s(!])(?:re:\S*[^\s:]
        |(?!\S*\[[^\s\]]*:|[0-9]+:)[^\s()"'`:!&|][^\s()"'`:]*):(?=\s|$))
    |(?P<word>[^\W\d][\w.]*)
    |(?P<mark>&&|\|\||!(?![=~])|[()])
    |(?P<space>\s+)
    |(?P<other>.)""",
    re.VERBOSE | re.DOTALL,
)
_KINDS = {"and": "and", "&&": "and", "or": "or", "||": "or", "not": "not", "!": "not"}


class Token(NamedTuple):
    """A part of a predicate with conditions on other topics.

    Attributes:
        kind: `topic`, `(`, `)`, `and`, `or`, `not`, `text`, or `end`.
        text: As written; a topic without its colon.
        begin: Index of its first character.
        end: Index behind its last character.
    """

    kind: str
    text: str
    begin: int
    end: int


def names_topics(text: str) -> bool:
    """True if a predicate has conditions on other topics; a MongoDB filter has none."""
    if is_filter(text):
        return False
    return ":" in text and any(token.kind == "topic" for token in tokens(text))


def parse_across(text: str) -> Condition:
    """The conditions of a predicate.

    Raises:
        WhereError: too long, too deep, a bracket or a connection is missing, or `and` and
            `or` stand side by side without brackets around a topic's conditions.
    """
    if len(text) > MAX_TEXT:
        raise WhereError(
            f"the predicate has {len(text)} characters, at most {MAX_TEXT} are allowed"
        )
    return _Parser(text).parse()


def tokens(text: str) -> list[Token]:
    """The parts of a predicate, whether it can be parsed or not; spaces are left out."""
    found = []
    for match in _TOKEN.finditer(text):
        kind, word = match.lastgroup, match[0]
        if kind == "space":
            continue
        if kind == "topic":
            word = word.removesuffix(":")
        elif kind == "mark":
            kind = _KINDS.get(word, word)
        else:
            kind = _KINDS.get(word.lower(), "text") if kind == "word" else "text"
        found.append(Token(str(kind), word, match.start(), match.end()))
    return found


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens = [*tokens(text), Token("end", "", len(text), len(text))]
        if len(self._tokens) > MAX_TOKENS * 4:
            raise WhereError(f"the predicate has more than {MAX_TOKENS} words")
        self._at = 0
        self._depth = 0
        self._groups = self._find_groups()

    def parse(self) -> Condition:
        found = self._either()
        if self._now.kind != "end":
            raise self._error("the predicate should end here")
        return found

    @property
    def _now(self) -> Token:
        return self._tokens[self._at]

    def _error(self, message: str) -> WhereError:
        return error_at(self._text, self._now.begin, message)

    def _find_groups(self) -> set[int]:
        """Opening brackets with a topic inside."""
        found: set[int] = set()
        opened: list[int] = []
        for number, token in enumerate(self._tokens):
            if token.kind == "(":
                opened.append(number)
            elif token.kind == ")" and opened:
                opened.pop()
            elif token.kind == "topic":
                found.update(opened)
        return found

    def _begins(self, place: int) -> bool:
        """True where a condition on another topic begins, or brackets with one."""
        while self._tokens[place].kind == "not":
            place += 1
        return self._tokens[place].kind == "topic" or place in self._groups

    def _either(self) -> Condition:
        parts = [self._both()]
        while self._now.kind == "or":
            self._at += 1
            parts.append(self._both())
        return parts[0] if len(parts) == 1 else AnyOf(tuple(parts))

    def _both(self) -> Condition:
        parts = [self._factor()]
        while self._now.kind == "and":
            self._at += 1
            parts.append(self._factor())
        return parts[0] if len(parts) == 1 else All(tuple(parts))

    def _factor(self) -> Condition:
        if not self._begins(self._at):
            return self._one("")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise self._error(f"brackets are nested deeper than {MAX_DEPTH}")
        token = self._now
        self._at += 1
        if token.kind == "not":
            found: Condition = NoneOf(self._factor())
        elif token.kind == "topic":
            found = self._one(token.text)
        else:
            found = self._either()
            if self._now.kind != ")":
                raise self._error("a closing bracket is missing")
            self._at += 1
        self._depth -= 1
        return found

    def _one(self, topic: str) -> Condition:
        """A predicate up to the next topic, the end of the brackets, or the end."""
        begin, depth = self._at, 0
        joins: set[str] = set()
        while True:
            token = self._now
            if token.kind == "end" or (token.kind == ")" and not depth):
                break
            if not depth and token.kind in {"and", "or"}:
                if self._begins(self._at + 1):
                    break
                joins.add(token.kind)
            elif self._begins(self._at) and (depth or token.kind != "not" or self._at > begin):
                raise self._error("`and` or `or` is missing before a topic")
            depth += {"(": 1, ")": -1}.get(token.kind, 0)
            self._at += 1
        before = self._tokens[begin - 1 - bool(topic)].kind if begin > bool(topic) else ""
        if "or" in joins and "and" in {before, self._now.kind}:
            raise self._error(
                "`or` stands beside `and`: put brackets around what belongs together, such as "
                "/odom: (a > 1 or b > 1) and /imu: c > 1"
            )
        if begin == self._at:
            if topic:
                return Near(topic, "")
            raise self._error("a condition is missing")
        predicate = self._text[self._tokens[begin].begin : self._tokens[self._at - 1].end]
        return Near(topic, predicate) if topic else Own(predicate)
