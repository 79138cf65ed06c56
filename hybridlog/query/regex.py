"""A cheap check that a regular expression given by a user cannot run away.

Backtracking engines (Python's `re`, MongoDB's PCRE) take exponential time on patterns
that repeat a group which itself repeats or branches, such as `(a+)+` or `(a|b)*`. Those
are refused by their form; nothing is executed.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator

_REPEAT = re.compile(r"[*+?]|\{(?P<low>[0-9]*)(?P<comma>,?)(?P<high>[0-9]*)\}")
_VERBOSE = re.compile(r"\(\?[A-Za-z]*x")
_FORBIDDEN_GROUPS = ("(?P=", "(?(", "(?R", "(?&", "(?P>", "(*")
_MOST_REPEATS = 100


class UnsafeRegexError(ValueError):
    """Why a pattern is refused.

    Attributes:
        position: Index of the character at fault.
    """

    def __init__(self, reason: str, position: int = 0) -> None:
        super().__init__(reason)
        self.position = position


def check_regex(pattern: str, *, max_length: int, max_unbounded: int) -> None:
    """Refuse a pattern that is malformed, too long, or may run without bound.

    Args:
        pattern: What the user wrote.
        max_length: Longest pattern, characters.
        max_unbounded: How many `*`, `+` or `{n,}` it may have; matching takes at most
            about the subject's length to this power.

    Raises:
        UnsafeRegexError: With the reason and the place.
    """
    if len(pattern) > max_length:
        raise UnsafeRegexError(f"longer than {max_length} characters", max_length)
    if "\0" in pattern:
        raise UnsafeRegexError("has a NUL character", pattern.index("\0"))
    _check_form(pattern, max_unbounded)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            re.compile(pattern)
    except (re.error, RecursionError, OverflowError) as error:
        place = error.pos if isinstance(error, re.error) else None
        raise UnsafeRegexError(f"not a regular expression: {error}", place or 0) from None


def _check_form(pattern: str, max_unbounded: int) -> None:
    # One entry a group that is open: whether something in it repeats or branches.
    groups = [False]
    closed = False  # the atom before is a group that repeats or branches
    unbounded = 0
    for kind, at, repeat in _tokens(pattern):
        if repeat is not None:
            endless = _is_endless(repeat, at)
            if endless and closed:
                raise UnsafeRegexError(
                    "repeats a group that itself repeats or branches, which can take forever",
                    at,
                )
            unbounded += endless
            if unbounded > max_unbounded:
                raise UnsafeRegexError(f"more than {max_unbounded} unbounded repetitions", at)
            groups[-1] = True
            continue
        closed = False
        if kind == "(":
            groups.append(False)
        elif kind == ")" and len(groups) > 1:
            closed = groups.pop()
            groups[-1] = groups[-1] or closed
        elif kind == "|":
            groups[-1] = True


def _tokens(pattern: str) -> Iterator[tuple[str, int, re.Match[str] | None]]:
    """Kind, place and, for a quantifier, its match; escapes and classes are one atom."""
    at = 0
    while at < len(pattern):
        char = pattern[at]
        start = at
        repeat = None
        if char == "\\":
            if pattern[at + 1 : at + 2].isdigit() and pattern[at + 1] != "0":
                raise UnsafeRegexError("back references are not allowed", at)
            at += 2
        elif char == "[":
            at = _class_end(pattern, at)
        elif char == "(":
            at = _group_start(pattern, at)
        elif (repeat := _REPEAT.match(pattern, at)) is not None:
            at = repeat.end()
            if pattern[at : at + 1] in {"?", "+"}:  # lazy, possessive
                at += 1
        else:
            at += 1
        yield char, start, repeat


def _group_start(pattern: str, at: int) -> int:
    """Index after a bracket and the marks behind it, which repeat nothing."""
    if pattern.startswith(_FORBIDDEN_GROUPS, at):
        raise UnsafeRegexError("back references, conditions and recursion are not allowed", at)
    if _VERBOSE.match(pattern, at):
        raise UnsafeRegexError("the flag x (blanks and comments) is not allowed", at)
    return at + 2 if pattern.startswith("(?", at) else at + 1


def _is_endless(repeat: re.Match[str], at: int) -> bool:
    """Whether a quantifier repeats often; `?` and `{3}` do not."""
    text = repeat[0]
    if text in "*+":
        return True
    if text == "?":
        return False
    low, high = repeat["low"], repeat["high"]
    if not low and not high:
        return False  # literal braces
    if max(int(low[:9] or 0), int(high[:9] or 0)) > _MOST_REPEATS:
        raise UnsafeRegexError(f"repeats more than {_MOST_REPEATS} times", at)
    return (bool(repeat["comma"]) and not high) or int(high or low) > 1


def _class_end(pattern: str, at: int) -> int:
    """Index after the bracket that closes the class opened at `at`."""
    at += 1
    if pattern[at : at + 1] == "^":
        at += 1
    if pattern[at : at + 1] == "]":
        at += 1
    while at < len(pattern) and pattern[at] != "]":
        at += 2 if pattern[at] == "\\" else 1
    return at + 1
