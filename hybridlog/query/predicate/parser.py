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
greater than anything. `== null` finds a stored null, not a missing field.

The pattern of `~` is found anywhere in the string unless anchored; its backslashes have no
escaping of their own. It has RE2's syntax and takes linear time.

`TOPIC: expression` holds for a message if another one, of that topic and near in time,
satisfies the expression. A space follows the colon. Conditions behind a topic are about it, up to
the next topic or the end of the brackets. Those that `and` joins are about one message of it.

`x.min`, `x.max`, `x.mean` and `x.n` of an array are its least and greatest finite element,
their mean, and the number of elements. Where the types of the fields are unknown, a
field of that name in an element takes precedence. An order holds for an array if it
holds for any finite element.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import groupby
from operator import itemgetter
from typing import TypeAlias

from msgspec.structs import replace

from hybridlog.query.predicate.tokens import (
    RegexError,
    Token,
    compile_regex,
    error_at,
    is_filter,
    tokenize,
    unescape,
)
from hybridlog.query.predicate.tree import (
    ALWAYS,
    And,
    Condition,
    Field,
    Near,
    Node,
    Not,
    Or,
    Order,
    Predicate,
    Value,
)
from hybridlog_storage.errors import WhereError

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
_VALUE_WORDS: dict[str, Value] = {
    "true": True,
    "false": False,
    "null": None,
    "none": None,
    "inf": math.inf,
    "infinity": math.inf,
    "nan": math.nan,
}
_ENDS = frozenset({"", ")", "and", "&&", "or", "||"})
"""Keywords behind a topic of which any message will do."""
_ONLY_INDEXED = frozenset({"inserted_at", "error", "ref"})
"""Fields of `_meta` that index documents have and messages do not."""

_OWN, _MIXED = 0, -1
_About: TypeAlias = tuple[int, Node]
"""A condition, and the number of the topic it is about: `_OWN`, or `_MIXED` of several."""


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
        self._topics = [""]  # as written, in their order; the message itself is the first
        self._topic = _OWN

    def parse(self) -> Predicate:
        if self._peek().kind == "end":
            raise WhereError("the predicate is empty; write for example: ranges.min < 0.5")
        root = self._whole(*self._or())
        if self._peek().kind != "end":
            raise self._fail(self._peek(), "expected 'and', 'or' or the end here")
        return Predicate(root, self._text)

    def _or(self) -> _About:
        return self._joined(Or, ("or", "||"), self._and)

    def _and(self) -> _About:
        return self._joined(And, ("and", "&&"), self._factor)

    def _joined(
        self, join: type[And | Or], words: tuple[str, str], item: Callable[[], _About]
    ) -> _About:
        """One item or several; neighbours about one topic are about one message of it."""
        found = [item()]
        while self._take(*words):
            found.append(item())
        alike = [(topic, [one for _, one in own]) for topic, own in groupby(found, itemgetter(0))]
        joined = [(topic, own[0] if len(own) == 1 else join(tuple(own))) for topic, own in alike]
        if len(joined) == 1:
            return joined[0]
        return _MIXED, join(tuple(self._whole(*one) for one in joined))

    def _whole(self, topic: int, node: Node) -> Node:
        """A condition as one on the message itself."""
        return Near(self._topics[topic], node) if topic > _OWN else node

    def _factor(self) -> _About:
        token, topic = self._peek(), self._topic
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise self._fail(token, f"nested deeper than {MAX_DEPTH}")
        if token.kind == "topic":
            found = self._near(token)
        elif self._take("not", "!"):
            about, node = self._factor()
            found = (
                (about, Not(node)) if about == topic else (_MIXED, Not(self._whole(about, node)))
            )
        elif self._take("("):
            found = self._or()
            if not self._take(")"):
                raise self._fail(self._peek(), "expected ')' here")
            self._topic = topic
        else:
            found = topic, self._condition()
        self._depth -= 1
        return found

    def _near(self, token: Token) -> _About:
        self._at += 1
        self._topics.append(token.text)
        self._topic = topic = len(self._topics) - 1
        behind = self._peek()
        if behind.kind in {"operator", "path", "end"} and behind.keyword in _ENDS:
            return topic, ALWAYS
        about, node = self._factor()
        if about != topic:
            raise self._fail(token, "a condition on another topic cannot stand behind this one")
        return topic, node

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
        return And((first, self._compare(field, second_order)))

    def _of_field(self, field: Field) -> Node:
        token = self._peek()
        if (order := self._order()) is not None:
            behind = self._peek()
            if behind.kind != "path" or behind.keyword in _VALUE_WORDS:
                return self._compare(field, order)
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
        if token.keyword == "[":
            problem = "write an element as x[3], a slice as x[3:8]; both count from 0"
            raise self._fail(token, problem)
        raise self._fail(
            token,
            "expected an operator here: ==, !=, <, <=, >, >=, in, not in, ~, !~, exists "
            "or missing (of a bool: field == true)",
        )

    def _compare(self, field: Field, order: Order) -> Condition:
        position = self._peek().position
        value = self._value()
        return _compare(self._text, field, order, value, position)

    def _member(self, field: Field, token: Token, *, negated: bool) -> Node:
        closing = {"[": "]", "(": ")"}.get(self._peek().keyword)
        if closing is None:
            raise self._fail(self._peek(), "expected a list here: [1, 2]")
        self._at += 1
        values: list[Value] = []
        while not self._take(closing):
            if values and not self._take(","):
                raise self._fail(self._peek(), f"expected ',' or '{closing}' here")
            if values and self._take(closing):
                break
            values.append(self._value())
        if not values:
            raise self._fail(token, "the list is empty")
        return Condition(
            field, "not in" if negated else "in", tuple(values), position=token.position
        )

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
            if not self._take(")"):
                raise self._fail(self._peek(), "expected ')' here")
            return replace(found, is_absolute=True)
        if token.path[0] == "_meta" and not _ONLY_INDEXED.isdisjoint(token.path[1:2]):
            path = Field(token.path).path
            problem = (
                f'only MongoDB has {path}; ask with a filter: {{"{path}": {{"$exists": true}}}}'
            )
            raise self._fail(token, problem)
        return Field(token.path, position=token.position)

    def _value(self) -> Value:
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
            raise self._fail(
                token,
                "expected a value here (strings need quotes)",
            )
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

    def _fail(self, token: Token, message: str) -> WhereError:
        return error_at(self._text, token.position, message)


def _compare(text: str, field: Field, order: Order, value: Value, position: int) -> Condition:
    if order not in {"==", "!="}:
        if value is None or isinstance(value, bool):
            raise error_at(text, position, "only numbers, times and strings have an order")
        if isinstance(value, float) and math.isnan(value):
            raise error_at(text, position, "nothing is less or greater than nan; write == nan")
    return Condition(field, order, (value,), position=position)
