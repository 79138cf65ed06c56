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
from collections.abc import Callable, Collection, Sequence

from hybridlog.query.predicate.parser import RegexError, compile_regex, is_filter
from hybridlog.schema.text import repaired_text
from hybridlog.wording import listed, meant
from hybridlog_storage.errors import TopicError

_LONGEST_PATTERN = 1_000
_LONGEST_REGEX = 200


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


def fitting(pattern: str, known: Collection[str]) -> list[str]:
    """The topics that a pattern matches; of a name that fits none, those in another case."""
    if pattern in known:
        return [pattern]
    fits = _matches(pattern)
    found = [topic for topic in known if fits(topic)]
    if found or not _is_plain(pattern):
        return found
    fits = _matches(pattern.casefold())
    return [topic for topic in known if fits(topic.casefold())]


def _resolve_one(pattern: str, known: list[str]) -> list[str]:
    found = fitting(pattern, known)
    if not found:
        nothing = "there is no topic" if _is_plain(pattern) else "no topic matches"
        raise TopicError(f"{nothing} {_shown(pattern)}; {meant(pattern, known)}")
    if len(found) > 1 and _is_plain(pattern):
        names = listed(_shown(name, quote=not name.isprintable()) for name in found)
        raise TopicError(
            f"{_shown(pattern)} is ambiguous, it may be {names}; write more of the name, or a glob "
            "to take all of them"
        )
    return found


def _matches(pattern: str) -> Callable[[str], bool]:
    """A test for one full topic name."""
    if not pattern.strip("/") or len(pattern) > _LONGEST_PATTERN:
        raise TopicError(
            f"{_shown(pattern)} is not a topic pattern: it must have 1 to {_LONGEST_PATTERN} "
            "characters"
        )
    if _is_plain(pattern):
        tail = "/" + pattern
        is_whole = pattern.startswith("/")
        return lambda topic: topic == pattern or (not is_whole and topic.endswith(tail))
    try:
        if pattern.startswith("re:"):
            compiled = compile_regex(pattern.removeprefix("re:"), _LONGEST_REGEX)
        else:
            compiled = compile_regex(_glob(repaired_text(pattern)), 100 * _LONGEST_PATTERN)
    except RegexError as error:
        raise TopicError(f"the expression {_shown(pattern)} is refused: {error}") from None
    return lambda topic: topic == pattern or compiled.fullmatch(repaired_text(topic)) is not None


def _is_plain(pattern: str) -> bool:
    return not pattern.startswith("re:") and not any(char in pattern for char in "*?[")


def _glob(pattern: str) -> str:
    """A glob as a regular expression; what `[!ab]` takes is no slash."""
    found = ["(?s)" if pattern.startswith("/") else "(?s)(?:.*/)?"]
    for text in re.findall(r"\*\*|\[[!^]?.[^]]*]|.", pattern, re.DOTALL):
        if text == "[":
            raise TopicError(f"the glob {_shown(pattern)} has a '[' that is not closed")
        if text.startswith("["):
            body = text[1:-1].removeprefix("!").removeprefix("^")
            inner = "".join(char if char == "-" else re.escape(char) for char in body)
            found.append(f"[^/{inner}]" if text[1] in "!^" else f"[{inner}]")
        else:
            found.append({"**": ".*", "*": "[^/]*", "?": "[^/]"}.get(text) or re.escape(text))
    return "".join(found)


def _shown(text: str, *, quote: bool = True) -> str:
    # Names come from files: control characters must not reach a terminal.
    text = text if len(text) <= 100 else text[:99] + "…"
    return repr(text) if quote else text
