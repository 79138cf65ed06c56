"""HTML of stores, recordings, queries and messages, for notebooks.

All text is escaped, since names and values come from logs. Work and output are bounded.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import islice
from typing import TYPE_CHECKING, Any

from hybridlog.query.times import format_duration, format_time
from hybridlog.wording import listed

if TYPE_CHECKING:
    from hybridlog_storage.summary import RecordingSummary

MAX_ROWS = 20
_MAX_TEXT = 100  # characters of a cell
_MAX_ITEMS = 8  # elements of an array


def shown(text: object, most: int = _MAX_TEXT) -> str:
    """Text of any length in short, on one line."""
    cut = str(text)[: most + 1]
    line = " ".join(cut.split())
    return line if len(cut) <= most else f"{line[:most]}…"


def recordings_html(title: str, recordings: Sequence[RecordingSummary]) -> str:
    """A table of recordings, the latest of them."""
    columns = ("recording", "start", "duration", "topics", "messages", "tags")
    rows = (_recording_row(one) for one in recordings[-MAX_ROWS:])
    more = len(recordings) - MAX_ROWS
    note = f"and {more} earlier ones" if more > 0 else ""
    return _titled(title, _table(columns, rows), note)


def _recording_row(one: RecordingSummary) -> list[str]:
    start = duration = "-"
    if one.span is not None:
        first, last = one.span
        start, duration = format_time(first - first % 10**9), format_duration(last - first)
    tags = listed(f"{key}={value}" for key, value in sorted(one.tags.items())) if one.tags else ""
    return [one.name, start, duration, str(one.topic_count), str(one.messages), tags]


def properties_html(title: str, properties: Mapping[str, object]) -> str:
    """A table of names and values."""
    return _titled(title, _table((), [[name, str(v)] for name, v in properties.items()]))


def message_html(
    title: str, fields: Mapping[str, object] | None, problem: str, picture: bytes
) -> str:
    """The fields of a message, nested ones with dots in their names.

    Fields are None if it cannot be read, and the problem says why. The picture is a thumbnail as
    PNG; empty for none.
    """
    image = ""
    if picture:
        data = b64encode(picture).decode("ascii")
        image = f'<img alt="thumbnail" src="data:image/png;base64,{data}">'
    if fields is None:
        return _titled(title, image, problem)
    leaves = list(islice(_leaves("", fields), MAX_ROWS + 1))
    rows = [[name, _value(value)] for name, value in leaves[:MAX_ROWS]]
    note = "and more fields" if len(leaves) > MAX_ROWS else ""
    return _titled(title, image + _table((), rows), note)


def _leaves(prefix: str, fields: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    for name, value in fields.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(f"{prefix}{name}.", value)
        else:
            yield f"{prefix}{name}", value


def _value(value: object) -> str:
    if isinstance(value, list):
        items: list[str] = []
        for item in value[:_MAX_ITEMS]:
            items.append(shown(item, 30))
            if sum(map(len, items)) > _MAX_TEXT // 2:
                break
        more = len(value) - len(items)
        return f"[{', '.join(items)}{f' and {more} more' if more else ''}]"
    return str(value)[: _MAX_TEXT + 1]


def _titled(title: str, body: str, note: str = "") -> str:
    below = f"<p>{escape(shown(note, 300))}</p>" if note else ""
    return f"<div><p><b>{escape(shown(title, 200))}</b></p>{body}{below}</div>"


def _table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    lines = [f"<thead><tr>{head}</tr></thead>"] if head else []
    for row in rows:
        cells = "".join(f"<td>{escape(shown(cell))}</td>" for cell in row)
        lines.append(f"<tr>{cells}</tr>")
    return f"<table>{''.join(lines)}</table>"
