"""Completion of predicates: fields, topics and words that fit at a place."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Final, Literal, NamedTuple

from hybridlog.frames.names import is_summary
from hybridlog.query.predicate.tokens import Token, tokenize
from hybridlog.query.predicate.types import STATS
from hybridlog_storage.errors import WhereError

Kind = Literal["field", "topic", "word"]

_WORD: Final = re.compile(r"""[^\s()!&|<>=~,"'{}]*\Z""")
_COMPARISONS: Final = frozenset({"==", "=", "!=", "<", "<=", ">", ">=", "~", "=~", "!~"})
_BEHIND: Final = ("and", "or", "exists", "in", "missing", "not in")
_VALUES: Final = ("false", "inf", "nan", "null", "true")
_BEGINS: Final = frozenset({"and", "&&", "or", "||", "not", "!", "("})
_PLAIN: Final = re.compile(r"[^\W\d]\w*")
_META: Final = ("_meta.t", "_meta.pub", "_meta.seq", "_meta.rec", "_meta.topic")

Fields = Callable[[str | None], Mapping[str, str] | None]
"""Types of the fields by path: of a topic, or of the message itself. None if unknown."""


class Candidate(NamedTuple):
    """A text that may stand at a place, with its kind, and with its type if it is a field."""

    text: str
    kind: Kind
    type: str = ""


def complete(
    text: str, topics: Collection[str], fields: Fields, *, most: int = 50
) -> tuple[int, list[Candidate]]:
    """The place at which the last word of a text begins, and words to complete it.

    Args:
        text: The beginning of a predicate.
        topics: Other topics that may be asked.
        fields: Gives the fields of a topic, by its name as written.
        most: Greatest number of candidates.
    """
    begin = len(text) - len(_WORD.findall(text)[0])
    try:
        known = tokenize(text[:begin])[:-1]
    except WhereError:  # in a string, for example
        return len(text), []
    folded = text[begin:].casefold()
    fitting = [one for one in _offered(known, topics, fields) if folded in one.text.casefold()]
    fitting.sort(key=lambda one: not one.text.casefold().startswith(folded))
    return begin, fitting[:most]


def _offered(known: list[Token], topics: Collection[str], fields: Fields) -> Iterator[Candidate]:
    word = known[-1].keyword if known else "("
    if word in _COMPARISONS:
        yield from (Candidate(word, "word") for word in _VALUES)
    elif word in _BEGINS or known[-1].kind == "topic":
        yield from _fields_of(fields(_topic_at(known)))
        yield Candidate("not", "word")
        yield from (Candidate(f"{topic}: ", "topic") for topic in sorted(topics))
    else:
        yield from (Candidate(word, "word") for word in _BEHIND)


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
    topics: list[str | None] = [None]
    for token in known:
        if token.kind == "topic":
            topics[-1] = token.text
        elif token.keyword == "(":
            topics.append(topics[-1])
        elif token.keyword == ")" and len(topics) > 1:
            topics.pop()
    return topics[-1]
