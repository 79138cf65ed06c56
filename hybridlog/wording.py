"""Numbers, sizes and lists of names, as people write and read them."""

from __future__ import annotations

import difflib
import re
from collections import defaultdict
from collections.abc import Iterable
from typing import Any, TypeVar

from msgspec import Struct
from msgspec.structs import asdict

from hybridlog_storage.errors import UsageError

MAX_LISTED = 10
MAX_ROWS = 20
"""Rows of a table in a notebook."""
_MAX_TEXT = 100  # characters of a cell
_MAX_LIKE = 5
_PARTS = re.compile(r"[./]")
_T = TypeVar("_T", bound=Struct)
_UNITS = ("B", "kB", "MB", "GB", "TB")
_SIZE = re.compile(r"\s*(\d{1,15}(?:\.\d{1,15})?)\s*([kKmMgGtT]?)(i?)[bB]?\s*")


def listed(names: Iterable[str], most: int = MAX_LISTED) -> str:
    """Names with commas between them: `a, b and 4 more` if they are many; `none` without any."""
    known = list(names)
    # One name takes no more room than the words for it.
    if len(known) <= most + 1:
        return ", ".join(known) or "none"
    return f"{', '.join(known[:most])} and {len(known) - most} more"


def like(wanted: str, known: Iterable[str]) -> list[str]:
    """Names that are like one that does not exist, or a part of them is, the nearest first."""
    by_word: dict[str, list[str]] = defaultdict(list)
    for name in sorted({*known}):
        whole = name.casefold().strip("/")
        for word in {whole, *_PARTS.split(whole)}:
            by_word[word].append(name)
    whole = wanted.casefold().strip("/")
    near: dict[str, None] = {}
    for part in (whole, _PARTS.split(whole)[-1]):
        for word in difflib.get_close_matches(part, by_word, _MAX_LIKE):
            near.update(dict.fromkeys(by_word[word]))
    return [*near]


def meant(wanted: str, known: Iterable[str]) -> str:
    """A hint where a name does not exist: names like it, else those that there are."""
    names = sorted({*known})
    near = like(wanted, names)
    # Names come from files: control characters must not reach a terminal.
    shown = [name[:100] if name.isprintable() else repr(name[:100]) for name in near or names]
    if near:
        return f"did you mean {listed(shown, _MAX_LIKE)}?"
    return f"there {'is' if len(names) == 1 else 'are'} {listed(shown)}"


def file_name(text: str) -> str:
    """Text as the name of a file that needs no quotes."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-.")[:80] or "recording"


def counted(number: int, what: str) -> str:
    """`1 message`, `2 messages`."""
    return f"{number} {what if number == 1 else what + 's'}"


def unfit(messages: int) -> str:
    """A number of unreadable messages: `1 message does not fit its definition`."""
    verb = "does not fit its" if messages == 1 else "do not fit their"
    return f"{counted(messages, 'message')} {verb} definition"


def size(count: float) -> str:
    """Bytes for people: `12.3 MB`."""
    value = float(count)
    for unit in _UNITS:
        if value < 999.95 or unit == _UNITS[-1]:
            break
        value /= 1000
    return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"


def parse_size(text: str) -> int:
    """Bytes from `1MiB`, `500kB`, `65536`."""
    match = _SIZE.fullmatch(text)
    if match is None:
        raise UsageError(f"{text!r} is no size: write 65536, 500kB or 1MiB.")
    number, prefix, binary = match.groups()
    base = 1024 if binary else 1000
    power = " kmgt".index(prefix.lower()) if prefix else 0
    return int(float(number) * base**power)


class Rows(list[_T]):
    """Structs of one kind, which a notebook shows as a table."""

    def _repr_html_(self) -> str:
        rows: list[dict[str, Any]] = [asdict(one) for one in self[:MAX_ROWS]]
        heading = [*rows[0]] if rows else []
        return table_html(counted(len(self), "row"), [heading, *(one.values() for one in rows)])


def table_html(title: str, rows: Iterable[Iterable[object]]) -> str:
    """A table for a notebook; all text is escaped, since names and values come from logs."""
    cells = ("".join(f"<td>{_escaped(cell)}</td>" for cell in row) for row in rows)
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    return f"<p><b>{_escaped(title)}</b></p><table>{body}</table>"


def _escaped(value: object) -> str:
    from html import escape

    text = str(value)[: _MAX_TEXT + 1]
    return escape(text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}…")


def arrow_html(title: str, table: Any) -> str:
    """The first rows of an Arrow table for a notebook."""
    rows = zip(*(column.to_pylist() for column in table.slice(0, MAX_ROWS).columns), strict=True)
    return table_html(title, [table.column_names, *rows])
