"""Completion of predicates: fields, topics and words that fit at a place."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from hybridlog.frames.names import is_summary
from hybridlog.query.predicate.tokens import Token, tokenize
from hybridlog.query.predicate.types import STATS
from hybridlog_storage.errors import WhereError

Kind = Literal["field", "topic", "word"]

_WORD: Final = re.compile(r"""[^\s()!&|<>=~,"'{}]*\Z""")
_COMPARISONS: Final = frozenset({"==", "=", "!=", "<", "<=", ">", ">=", "~", "=~", "!~"})
_BEHIND: Final = ("and", "or", "between", "exists", "in", "missing", "not in")
_VALUES: Final = ("false", "inf", "nan", "null", "true")
_BEGINS: Final = frozenset({"and", "&&", "or", "||", "not", "!", "("})
_PLAIN: Final = re.compile(r"[^\W\d]\w*")
_META: Final = ("_meta.t", "_meta.pub", "_meta.seq", "_meta.rec", "_meta.topic")

Fields = Callable[[str | None], Mapping[str, str] | None]
"""Types of the fields by path: of a topic, or of the message itself. None if unknown."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A text that may stand at a place.

    Attributes:
        text: As it is written.
        kind: Field, topic or word.
        type: Type of a field, empty for others.
    """

    text: str
    kind: Kind
    type: str = ""


@dataclass(frozen=True, slots=True)
class Completion:
    """The candidates for the word that ends at a place.

    Attributes:
        begin: Index of the first character of the word.
        candidates: Those that begin with the word, then those that contain it.
    """

    begin: int
    candidates: tuple[Candidate, ...]


def complete(
    text: str, place: int, topics: Collection[str], fields: Fields, *, most: int = 50
) -> Completion:
    """Candidates for completing a predicate at a place.

    Args:
        text: The predicate.
        place: Index of the character that is typed next.
        topics: Other topics that may be asked.
        fields: Gives the fields of a topic, by its name as written.
        most: Greatest number of candidates.
    """
    before = text[:place]
    found = _WORD.search(before)
    begin = place if found is None else found.start()
    try:
        known = tokenize(before[:begin])[:-1]
    except WhereError:  # in a string, for example
        return Completion(place, ())
    offered = [*_offered(known, topics, fields)]
    folded = before[begin:].casefold()
    fitting = [one for one in offered if folded in one.text.casefold()]
    fitting.sort(key=lambda one: not one.text.casefold().startswith(folded))
    return Completion(begin, tuple(fitting[:most]))


def _offered(known: list[Token], topics: Collection[str], fields: Fields) -> Iterator[Candidate]:
    last = known[-1] if known else None
    word = _word(last) if last is not None else "("
    if word in _COMPARISONS:
        yield from (Candidate(word, "word") for word in _VALUES)
    elif word in _BEGINS or (last is not None and last.kind == "topic"):
        yield from _fields_of(fields(_topic_at(known)))
        yield Candidate("not", "word")
        yield from (Candidate(f"{topic}: ", "topic") for topic in sorted(topics))
    else:
        yield from (Candidate(word, "word") for word in _BEHIND)


def _word(token: Token) -> str:
    """An operator, or a word that may be a keyword; empty for others."""
    return token.text if token.kind == "operator" else token.keyword


def _fields_of(types: Mapping[str, str] | None) -> Iterator[Candidate]:
    known = types or {}
    for path, kind in known.items():
        yield Candidate(_spelled(path), "field", kind)
        for name in STATS:
            if is_summary(f"{path}.{name}", known):
                yield Candidate(_spelled(f"{path}.{name}"), "field", "summary")
    yield from (Candidate(path, "field") for path in _META)


def _spelled(path: str) -> str:
    """A path as a predicate takes it: names that are no identifiers in backquotes."""
    if "`" in path:
        return path  # as it is observed in messages
    return ".".join(_quoted(part) for part in path.split("."))


def _quoted(part: str) -> str:
    name, bracket, rest = part.partition("[")
    return part if _PLAIN.fullmatch(name) else f"`{name}`{bracket}{rest}"


def _topic_at(known: list[Token]) -> str | None:
    """The topic that a predicate behind some tokens is about; None for the message itself."""
    outer: list[str | None] = []
    topic: str | None = None
    for token in known:
        if token.kind == "topic":
            topic = token.text.removesuffix(":")
        elif _word(token) == "(":
            outer.append(topic)
        elif _word(token) == ")" and outer:
            topic = outer.pop()
    return topic
