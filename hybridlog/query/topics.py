"""Topic names in the forms that people write them.

A pattern is one of:

* the full name: `/base/scan`;
* a short name: whole parts at the end of a name, `scan` or `camera/image_raw`;
* a glob: `*` and `?` stay within a part, `**` crosses parts, `[ab]`, `[!ab]` and `[a-z]`
  are one character. With a leading slash it is compared with the whole name; without,
  with every run of whole parts at the end, so `*_scan` finds `/base/left_scan` and
  `camera/*` finds `/front/camera/image_raw`;
* `re:` and a regular expression in RE2's syntax, which must match the whole name; at most
  200 characters.

The full name of an existing topic always means that topic, whatever characters it has.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Sequence

from hybridlog.query.predicate.regex import Regex, RegexError, compile_regex
from hybridlog.query.predicate.tokens import is_filter
from hybridlog.schema.text import repaired_text
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError

_MAX_NAMES = 10
_LONGEST_PATTERN = 1_000
_LONGEST_REGEX = 200
_SPAN = re.compile("(.)-(.)|(.)", re.DOTALL)
_NOTHING = r"[^\x00-\x{10FFFF}]"


def resolve(patterns: Sequence[str], topics: Collection[str]) -> list[str]:
    """The topics that the patterns match, in the order of the patterns, without duplicates.

    A short name is compared with case first, then without, and must match one topic. A glob or
    `re:` returns all its topics in alphabetical order. Without patterns there are none.
    """
    known = sorted(set(topics))
    found: dict[str, None] = {}
    for pattern in patterns:
        found.update(dict.fromkeys(_resolve_one(pattern, known)))
    return list(found)


def split_topic(text: str) -> tuple[str, str]:
    """The topic before the first colon that a space follows, and the rest: `TOPIC: PREDICATE`.

    A text without such a colon is a topic alone; a MongoDB filter has no topic.
    """
    if is_filter(text):
        return "", text
    topic, _, rest = text.partition(": ")
    return topic.strip().removesuffix(":"), rest.strip()


def namesakes(patterns: Iterable[str], topics: Collection[str]) -> tuple[str, ...]:
    """Further topics that end with a short name which is the whole name of one topic."""
    found = {topic for pattern in patterns for topic in _namesakes(pattern, topics)}
    return tuple(sorted(found))


def _namesakes(pattern: str, topics: Collection[str]) -> list[str]:
    if pattern.startswith("/") or pattern in topics or not _is_plain(pattern):
        return []
    for fold in (str, str.casefold):
        wanted = "/" + fold(pattern)
        if any(fold(topic) == wanted for topic in topics):
            return [t for t in topics if fold(t).endswith(wanted) and fold(t) != wanted]
    return []


class TopicMatcher:
    """Tests each topic as it appears, if the topics are not known in advance.

    A short name matches every topic that ends with it, case-sensitively. No pattern to `include`
    means all topics; those to `exclude` are left out of the included ones.
    """

    def __init__(self, include: Sequence[str] = (), exclude: Sequence[str] = ()) -> None:
        self._include = {pattern: _matches(pattern) for pattern in include}
        self._exclude = {pattern: _matches(pattern) for pattern in exclude}
        self._used: set[str] = set()

    def __call__(self, topic: str) -> bool:
        """True if the topic is wanted."""
        included = self._any(self._include, topic) or not self._include
        excluded = self._any(self._exclude, topic)
        return included and not excluded

    def unused(self) -> list[str]:
        """The patterns that have matched no topic so far, as given."""
        patterns = dict.fromkeys((*self._include, *self._exclude))
        return [pattern for pattern in patterns if pattern not in self._used]

    def _any(self, table: dict[str, Callable[[str], bool]], topic: str) -> bool:
        # Every pattern is tested, which makes `unused` complete.
        hits = [pattern for pattern, matches in table.items() if matches(topic)]
        self._used.update(hits)
        return bool(hits)


def matcher(include: Sequence[str] = (), exclude: Sequence[str] = ()) -> TopicMatcher:
    """A `TopicMatcher` for these patterns."""
    return TopicMatcher(include, exclude)


def later(patterns: Sequence[str]) -> Callable[[str], bool]:
    """A test for topics that appear later: globs and `re:` take them, names do not."""
    open_ones = [pattern for pattern in patterns if not _is_plain(pattern)]
    return TopicMatcher(open_ones) if open_ones else lambda _: False


def _resolve_one(pattern: str, known: list[str]) -> list[str]:
    if pattern in known:
        return [pattern]
    if not _is_plain(pattern):
        matches = _matches(pattern)
        hits = [topic for topic in known if matches(topic)]
        if not hits:
            raise TopicError(f"no topic matches {_shown(pattern)}; {_there_are(known)}")
        return hits
    _check_length(pattern)
    if not pattern.strip("/"):
        raise TopicError(f"{_shown(pattern)} is not a topic; {_there_are(known)}")
    for fold in (str, str.casefold):
        wanted = fold(pattern)
        whole = [topic for topic in known if fold(topic) in {wanted, "/" + wanted}]
        hits = whole or [topic for topic in known if fold(topic).endswith("/" + wanted)]
        # A leading slash marks a full name.
        if pattern.startswith("/"):
            hits = whole
        if len(hits) == 1:
            return hits
        if hits:
            raise TopicError(
                f"{_shown(pattern)} is ambiguous, it may be {_listed(hits)}; write more of "
                f"the name, or a glob to take all of them"
            )
    raise TopicError(_unknown(pattern, known))


def _matches(pattern: str) -> Callable[[str], bool]:
    """A test for one full topic name."""
    _check_length(pattern)
    if pattern.startswith("re:"):
        compiled = _regex(pattern)
        return lambda topic: (
            topic == pattern or compiled.fullmatch(repaired_text(topic)) is not None
        )
    if _is_plain(pattern):
        tail = pattern if pattern.startswith("/") else "/" + pattern
        if pattern.startswith("/"):
            return lambda topic: topic == pattern
        return lambda topic: topic == pattern or topic.endswith(tail)
    compiled = _glob(repaired_text(pattern))
    return lambda topic: topic == pattern or compiled.fullmatch(repaired_text(topic)) is not None


def _is_plain(pattern: str) -> bool:
    return not pattern.startswith("re:") and not any(char in pattern for char in "*?[")


def _check_length(pattern: str) -> None:
    if not pattern or len(pattern) > _LONGEST_PATTERN:
        raise TopicError(
            f"{_shown(pattern)} is not a topic pattern: it must have 1 to {_LONGEST_PATTERN} "
            "characters"
        )


def _regex(pattern: str) -> Regex:
    text = pattern.removeprefix("re:")
    try:
        return compile_regex(text, _LONGEST_REGEX)
    except RegexError as error:
        raise TopicError(f"the expression {_shown(text)} is refused: {error}") from None


def _glob(pattern: str) -> Regex:
    """A glob as a regular expression; the class of a bracket has no slash."""
    found = ["(?s)" if pattern.startswith("/") else "(?s)(?:.*/)?"]
    at = 0
    while at < len(pattern):
        if pattern[at] == "[":
            text, at = _glob_class(pattern, at)
        else:
            text = "**" if pattern.startswith("**", at) else pattern[at]
            at += len(text)
            text = {"**": ".*", "*": "[^/]*", "?": "[^/]"}.get(text) or re.escape(text)
        found.append(text)
    return compile_regex("".join(found), 100 * _LONGEST_PATTERN)


def _glob_class(pattern: str, at: int) -> tuple[str, int]:
    """The class of a `[...]` that opens at `at`, and the index after it."""
    close = pattern.find("]", at + (3 if pattern[at + 1 : at + 2] in {"!", "^"} else 2))
    if close < 0:
        raise TopicError(f"the glob {_shown(pattern)} has a '[' that is not closed")
    body = pattern[at + 1 : close]
    negated = body[:1] in {"!", "^"}
    spans = [(low or one, high or one) for low, high, one in _SPAN.findall(body[negated:])]
    if negated:
        spans.append(("/", "/"))
    else:
        spans = [
            cut for low, high in spans for cut in ((low, min(high, ".")), (max(low, "0"), high))
        ]
    text = "".join(f"\\x{{{ord(a):x}}}-\\x{{{ord(b):x}}}" for a, b in spans if a <= b)
    return (f"[^{text}]" if negated else f"[{text}]" if text else _NOTHING), close + 1


def _unknown(pattern: str, known: list[str]) -> str:
    import difflib

    # Compared by parts and in lower case, too: `/scna` is near `/base/scan`.
    wanted = pattern.casefold().strip("/")
    last = wanted.rsplit("/", 1)[-1]

    def is_near(topic: str) -> bool:
        whole = topic.casefold().strip("/")
        names = {whole, *whole.split("/")}
        close = (difflib.get_close_matches(word, names) for word in (wanted, last))
        return bool(last and last in whole) or any(close)

    nearest = [topic for topic in known if is_near(topic)]
    if nearest:
        return f"there is no topic {_shown(pattern)}; did you mean {_listed(nearest)}?"
    return f"there is no topic {_shown(pattern)}; {_there_are(known)}"


def _there_are(known: list[str]) -> str:
    if not known:
        return "there are no topics"
    return f"there {'is' if len(known) == 1 else 'are'} {_listed(known)}"


def _listed(topics: Iterable[str]) -> str:
    return listed((_shown(name, quote=False) for name in topics), _MAX_NAMES)


def _shown(text: str, *, quote: bool = True) -> str:
    if len(text) > 100:
        text = text[:99] + "…"
    # Names come from files: control characters must not reach a terminal.
    return repr(text) if quote or not text.isprintable() else text
