r"""Predicates over message fields: `ranges.min < 0.5 and header.frame_id == "laser"`.

    expression  = term { ("or" | "||") term }
    term        = factor { ("and" | "&&") factor }
    factor      = ("not" | "!") factor | "(" expression ")" | condition | near
    near        = TOPIC ":" [ expression ]                  a message of another topic
    condition   = field ("==" | "=" | "!=" | "<" | "<=" | ">" | ">=") value
                | value order field [ order value ]             0 < x < 5
                | field [ "not" ] "in" "[" value { "," value } "]"
                | field ("~" | "=~" | "!~") string              a regular expression
                | field "between" value "and" value             half-open
                | field ("exists" | "missing")
    field       = name { "." name | "[" index "]" | "[" [ begin ] ":" [ end ] "]" | "[]" | "[*]" }
    value       = integer | 0xff | 1e-3 | inf | nan | "string" | true | false | null
                | t"2015-03-03T18:28:33.5Z" | 5ms | 1m30s

Keywords may be in any case; names are case-sensitive. A name that is no
identifier, or that is a keyword at the beginning of a condition, needs
backquotes: `` `a-b` ``. A path through an array (`status[].level`, `status.level`) means
*any* element. Different elements may satisfy several conditions on one array:
`0 < x < 5` means `0 < x and x < 5`. A slice `x[3:8]` is an array: the elements 3 to 7 of x,
as far as there are any. Times and durations are integer nanoseconds, as stored.

`!=`, `not in` and `!~` hold only where the field exists. For an array, they mean that no
element equals or matches the operand. `not (...)` is plain negation: it also holds where
the field is missing. Numbers are compared by value, whatever their type. A comparison of
different kinds (a number and a string) is false. NaN equals NaN and is neither less nor
greater than anything. `== null` finds a stored null, not a missing field.

The pattern of `~` is found anywhere in the string unless anchored; its backslashes have no
escaping of their own. It has RE2's syntax and takes linear time.

`TOPIC: expression` holds for a message if another one, of that topic and near in time,
satisfies the expression. That reaches to the next topic, or to the end of the brackets; what
joins it to the next topic is the last `and` or `or` before that. A space follows the colon.

`x.min`, `x.max`, `x.mean` and `x.n` of an array are its least and greatest finite element,
their mean, and the number of elements. Where the types of the fields are unknown, a
field of that name in an element takes precedence. An order holds for an array if it
holds for any finite element.
"""

from __future__ import annotations

import math
from functools import lru_cache

from hybridlog.query.predicate.regex import RegexError, compile_regex
from hybridlog.query.predicate.tokens import (
    Token,
    error_at,
    is_filter,
    regex_text,
    tokenize,
    unescape,
)
from hybridlog.query.predicate.tree import (
    And,
    Compare,
    Exists,
    Field,
    Match,
    Member,
    Near,
    Node,
    Not,
    Or,
    Order,
    Predicate,
    Value,
    nodes,
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


_ONLY_INDEXED = frozenset({"inserted_at", "error", "ref"})
"""Fields of `_meta` that index documents have and messages do not."""


def names_topics(text: str) -> bool:
    """True if a predicate has conditions on other topics; a MongoDB filter has none."""
    if ":" not in text or is_filter(text):
        return False
    return any(isinstance(node, Near) for node in nodes(parse(text, across=True).root))


def parse(text: str, *, across: bool = False) -> Predicate:
    """Parse a predicate.

    Args:
        text: The predicate.
        across: It may have conditions on other topics.
    """
    if not isinstance(text, str):
        raise WhereError(f"a predicate is text, not {type(text).__name__}")
    if is_filter(text):
        raise WhereError("MongoDB filters are not possible here: write a predicate, such as x > 1")
    return _parsed(text, across)


@lru_cache(maxsize=128)  # for a small topic, parsing takes as long as the answer
def _parsed(text: str, across: bool) -> Predicate:  # noqa: FBT001
    found = _Parser(text, across=across).parse()
    for condition in found.conditions():
        name = condition.field.path.split(".")
        if name[0] == "_meta" and not _ONLY_INDEXED.isdisjoint(name[1:2]):
            path = condition.field.path
            raise error_at(
                text,
                condition.field.position,
                f'only MongoDB has {path}; ask with a filter: {{"{path}": {{"$exists": true}}}}',
            )
    return found


class _Parser:
    def __init__(self, text: str, *, across: bool) -> None:
        self._text = text
        self._tokens = tokenize(text)
        self._at = 0
        self._depth = 0
        self._takes_topics = across
        self._is_of_topic = False  # what is parsed is about another topic
        self._has_or = False  # what was parsed last is joined by `or`, without brackets
        self._groups = self._find_groups()

    def parse(self) -> Predicate:
        if self._peek().kind == "end":
            raise WhereError("the predicate is empty; write for example: ranges.min < 0.5")
        root = self._or()
        if self._peek().kind != "end":
            raise self._fail(self._peek(), "expected 'and', 'or' or the end here")
        return Predicate(root, self._text)

    def _or(self) -> Node:
        items = [self._and()]
        while not self._is_at_topic() and self._take("or", "||"):
            items.append(self._and())
        self._has_or = len(items) > 1
        return items[0] if len(items) == 1 else Or(tuple(items))

    def _and(self) -> Node:
        items = [self._factor()]
        while not self._is_at_topic() and self._take("and", "&&"):
            items.append(self._factor())
        return items[0] if len(items) == 1 else And(tuple(items))

    def _factor(self) -> Node:
        token = self._peek()
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise self._fail(token, f"nested deeper than {MAX_DEPTH}")
        node: Node
        if self._take("not", "!"):
            node = Not(self._factor())
        elif self._take("("):
            node = self._or()
            if not self._take(")"):
                raise self._fail(self._peek(), "expected ')' here")
            self._has_or = False
        else:
            node = self._near() if token.kind == "topic" else self._condition()
        self._depth -= 1
        return node

    def _find_groups(self) -> set[int]:
        """Places of opening brackets with a topic inside."""
        found: set[int] = set()
        opened: list[int] = []
        for place, token in enumerate(self._tokens):
            if token.kind == "topic":
                found.update(opened)
            elif token.kind == "operator" and token.text == "(":
                opened.append(place)
            elif token.kind == "operator" and token.text == ")" and opened:
                opened.pop()
        return found

    def _is_at_topic(self) -> bool:
        """True where a topic ends what is about another one: behind the next `and` or `or`."""
        place = self._at + 1
        if not self._is_of_topic or self._peek().kind == "end":
            return False
        while (self._tokens[place].keyword or self._tokens[place].text) in {"not", "!"}:
            place += 1
        return self._tokens[place].kind == "topic" or place in self._groups

    def _near(self) -> Near:
        topic, first = self._tokens[self._at : self._at + 2]
        if self._is_of_topic or not self._takes_topics:
            raise self._fail(topic, "a condition on another topic cannot stand here")
        before = self._tokens[self._at - 1] if self._at else topic
        self._at += 1
        name = topic.text.removesuffix(":")
        is_any = first.kind == "end" or first.text == ")" or first.keyword in {"and", "or"}
        if is_any or first.text in {"&&", "||"}:
            return Near(name, "")
        self._is_of_topic = True
        self._or()
        self._is_of_topic = False
        beside = {(token.keyword or token.text) for token in (before, self._peek())}
        if self._has_or and not beside.isdisjoint({"and", "&&"}):
            raise self._fail(
                topic,
                "`or` stands beside `and`: put brackets around what belongs together, such as "
                "/odom: (a > 1 or b > 1) and /imu: c > 1",
            )
        return Near(name, self._text[first.position : self._tokens[self._at - 1].end])

    def _condition(self) -> Node:
        token = self._peek()
        if token.kind == "path" and token.keyword not in _VALUE_WORDS:
            return self._of_field(self._field())
        if not self._is_value(token):
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
            return self._compare(field, order)
        if self._take("~", "=~", "!~"):
            return self._match(field, negated=token.text == "!~")
        if self._take("exists", "missing"):
            return Exists(field, present=token.keyword == "exists")
        if self._take("in", "not"):
            if token.keyword == "not" and not self._take("in"):
                raise self._fail(self._peek(), "expected 'in' after 'not' here")
            return self._member(field, token, negated=token.keyword == "not")
        if self._take("between"):
            return self._between(field)
        raise self._fail(
            token,
            "expected an operator here: ==, !=, <, <=, >, >=, in, not in, ~, !~, between, "
            "exists or missing (of a bool: field == true)",
        )

    def _compare(self, field: Field, order: Order) -> Compare:
        position = self._peek().position
        value = self._value()
        return _compare(self._text, field, order, value, position)

    def _between(self, field: Field) -> Node:
        position = self._peek().position
        low = self._compare(field, ">=")
        if not self._take("and"):
            raise self._fail(self._peek(), "expected 'and' here: between a and b")
        high = self._compare(field, "<")
        a, b = low.value, high.value
        if isinstance(a, int | float) and isinstance(b, int | float) and not a < b:
            raise error_at(self._text, position, "the range is empty (its end is not part of it)")
        return And((low, high))

    def _member(self, field: Field, token: Token, *, negated: bool) -> Node:
        closing = {"[": "]", "(": ")"}.get(self._peek().text if self._is_operator() else "")
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
        return Member(field, tuple(values), negated, token.position)

    def _match(self, field: Field, *, negated: bool) -> Node:
        token = self._peek()
        if token.kind != "string":
            raise self._fail(token, 'expected a pattern in quotes here: ~ "^base_"')
        self._at += 1
        pattern = regex_text(token)
        try:
            compile_regex(pattern)
        except RegexError as error:
            raise self._fail(token, f"the pattern is refused: {error}") from None
        return Match(field, pattern, negated, token.position)

    def _field(self) -> Field:
        token = self._peek()
        if token.kind != "path":
            raise self._fail(token, "expected the name of a field here")
        self._at += 1
        return Field(token.path, token.position)

    def _value(self) -> Value:
        sign = 0
        if self._is_operator() and self._peek().text in {"-", "+"}:
            sign = -1 if self._peek().text == "-" else 1
            self._at += 1
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
                "expected a value here (strings need quotes; two fields cannot be compared)",
            )
        raise self._fail(token, "expected a value here")

    def _order(self) -> Order | None:
        if self._is_operator() and self._peek().text in _ORDERS:
            self._at += 1
            return _ORDERS[self._tokens[self._at - 1].text]
        return None

    def _is_value(self, token: Token) -> bool:
        return token.kind in {"number", "time", "string"} or (
            token.keyword in _VALUE_WORDS or (token.kind == "operator" and token.text in {"+", "-"})
        )

    def _is_operator(self) -> bool:
        return self._peek().kind == "operator"

    def _peek(self) -> Token:
        return self._tokens[self._at]

    def _take(self, *words: str) -> bool:
        """Consume the next token if it is one of these words or operators."""
        token = self._peek()
        if (token.text if token.kind == "operator" else token.keyword or None) in words:
            self._at += 1
            return True
        return False

    def _fail(self, token: Token, message: str) -> WhereError:
        return error_at(self._text, token.position, message)


def _compare(text: str, field: Field, order: Order, value: Value, position: int) -> Compare:
    if order not in {"==", "!="}:
        if value is None or isinstance(value, bool):
            raise error_at(text, position, "only numbers, times and strings have an order")
        if isinstance(value, float) and math.isnan(value):
            raise error_at(text, position, "nothing is less or greater than nan; write == nan")
    return Compare(field, order, value, position)
