"""Parses `.msg`, `.srv` and `.action` definitions into unresolved fields.

Each line is one field, so lines are matched one by one. As in genmsg, only a newline ends a
line or a comment. `definition.py` resolves the type names of the result. Text without a wire
form (comments, constants, defaults, annotations) is dropped here.

The parser of rosbags is not used: it refuses CRLF, a byte order mark, services and missing
newlines, reads prose as fields, and takes 3 s for 20,000 blank lines.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from msgspec import Struct

from hybridlog_storage.errors import DefinitionError

if TYPE_CHECKING:
    from collections.abc import Collection

MAX_NAME = 255
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")

_HEADER = r"\s*(MSG|IDL|SRV|ACTION):[^\S\n]*(\S+)[^\S\n]*(?:\n|\Z)"
_FIRST_LINE = re.compile(_HEADER)
# A line of `=`, or a rule in front of a header where the newlines around it are missing.
_RULE = re.compile(rf"^={{20,}}[^\S\n]*(?:\n|\Z)|(?<!=)={{80,}}(?={_HEADER})", re.MULTILINE)
_PARTS = re.compile(r"^[^\S\n]*---[^\S\n]*$", re.MULTILINE)
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][A-Za-z0-9_/]*)"
    r"(?:<=(?P<text_bound>[0-9]{1,10}))?"
    r"(?P<array>\[(?P<at_most><=)?(?P<count>[0-9]{0,10})\])?"
    r"[ \t]+(?P<name>[A-Za-z0-9_]+)(?=[ \t=#]|\Z)"
    r"[ \t]*(?P<rest>.*)\Z"
)


class RawField(Struct, frozen=True):
    """An unresolved field; its type is a name.

    Attributes:
        name: Field name, not yet checked.
        type: A primitive by its ROS name, or a message by its canonical or bare name.
        width: Number of elements of a fixed array.
        bound: Largest number of elements of a bounded sequence.
        text_bound: Largest length of a bounded string.
    """

    name: str
    type: str
    array: bool = False
    width: int | None = None
    bound: int | None = None
    text_bound: int | None = None


def canonical(name: str) -> str:
    """The canonical spelling of a type: `pkg/Name`, `pkg/srv/Name`.

    The part `msg` is dropped; only ROS 2 uses it.
    """
    parts = name.replace("::", "/").strip("/").split("/")
    if len(parts) > 2 and parts[-2] == "msg":
        del parts[-2]
    return "/".join(parts)


def split_sections(text: str) -> list[tuple[str, str, str]]:
    """Split a concatenation of definitions at its lines of `=`, each followed by a header line.

    The newlines around such a line may be missing. Returns type, kind (`MSG`, `IDL`, `SRV` or
    `ACTION`) and text of each definition; type and kind are empty for a first one without header.
    """
    text = text.removeprefix("\ufeff")
    rules = [*_RULE.finditer(text)]
    begins, ends = [0, *(one.end() for one in rules)], [*(one.start() for one in rules), len(text)]
    sections: list[tuple[str, str, str]] = []
    for part in (text[begin:end] for begin, end in zip(begins, ends, strict=True)):
        header = _FIRST_LINE.match(part)
        if header is not None:
            sections.append((header[2], header[1], part[header.end() :]))
        elif part.strip() or (part and not sections):
            sections.append(("", "", part))
    return sections or [("", "", "")]


def parse_msg(name: str, text: str, *, defaults: bool) -> list[RawField]:
    """Parse the fields of one `.msg` text, in order; with `defaults`, values may follow (ROS 2)."""
    fields: list[RawField] = []
    for number, raw_line in enumerate(text.split("\n"), 1):
        line = raw_line.strip()
        if not line or line[0] in "#@":
            continue
        match = _FIELD.match(line)
        if match is None:
            raise DefinitionError(f"{name}: line {number} is not a field: {line[:80]!r}")
        rest = match["rest"]
        if rest.startswith("="):
            continue
        if rest and not rest.startswith("#") and not defaults:
            raise DefinitionError(f"{name}: line {number} is not a field: {line[:80]!r}")
        count = int(match["count"]) if match["count"] else None
        at_most = match["at_most"] is not None
        if at_most and count is None:
            raise DefinitionError(f"{name}: line {number} has a bound without a number")
        fields.append(
            RawField(
                name=match["name"],
                type=match["type"],
                array=match["array"] is not None,
                width=None if at_most else count,
                bound=count if at_most else None,
                text_bound=int(match["text_bound"]) if match["text_bound"] else None,
            )
        )
    return fields


def _event(stem: str) -> list[RawField]:
    return [
        RawField("info", "service_msgs/ServiceEventInfo"),
        RawField("request", f"{stem}_Request", array=True, bound=1),
        RawField("response", f"{stem}_Response", array=True, bound=1),
    ]


def interface_of(name: str) -> str:
    """The service or action of a derived type: `pkg/srv/Name` of `pkg/srv/Name_Event`."""
    return _PART_SUFFIX.sub("", name)


_PART_SUFFIX = re.compile(
    r"(?:_(?:SendGoal|GetResult))?_(?:Event|Request|Response)\Z|_(?:Goal|Result|Feedback|FeedbackMessage)\Z"
)


def parse_parts(name: str, text: str) -> dict[str, list[RawField]]:
    """Fields of types derived from a `.srv` (two parts) or `.action` (three parts) text.

    ROS 2 records services and actions as messages of derived types such as `pkg/srv/Name_Event`,
    and stores the text of the service or action with them. `name` is the canonical name of any of
    these, or of the interface itself.
    """
    parts = _PARTS.split(text)
    if len(parts) not in {2, 3}:
        raise DefinitionError(f"{name}: {len(parts)} parts; a service has 2 and an action 3")
    stem = interface_of(name)
    names = _SERVICE if len(parts) == 2 else _ACTION
    found = {
        f"{stem}{part}": parse_msg(name, inner, defaults=True)
        for part, inner in zip(names, parts, strict=True)
    }
    return found | derived_from(stem, found)


_SERVICE = ("_Request", "_Response")
_ACTION = ("_Goal", "_Result", "_Feedback")


def derived_from(stem: str, known: Collection[str]) -> dict[str, list[RawField]]:
    """Types that ROS 2 derives from the parts of a service or an action, if all are known."""
    if all(f"{stem}{part}" in known for part in _SERVICE):
        return {f"{stem}_Event": _event(stem)}
    if not all(f"{stem}{part}" in known for part in _ACTION):
        return {}
    goal_id = RawField("goal_id", "unique_identifier_msgs/UUID")
    return {
        f"{stem}_FeedbackMessage": [goal_id, RawField("feedback", f"{stem}_Feedback")],
        f"{stem}_SendGoal_Request": [goal_id, RawField("goal", f"{stem}_Goal")],
        f"{stem}_SendGoal_Response": [
            RawField("accepted", "bool"),
            RawField("stamp", "builtin_interfaces/Time"),
        ],
        f"{stem}_SendGoal_Event": _event(f"{stem}_SendGoal"),
        f"{stem}_GetResult_Request": [goal_id],
        f"{stem}_GetResult_Response": [
            RawField("status", "int8"),
            RawField("result", f"{stem}_Result"),
        ],
        f"{stem}_GetResult_Event": _event(f"{stem}_GetResult"),
    }


def has_parts(text: str) -> bool:
    """True if a text is that of a service or an action."""
    return bool(_PARTS.search(text))
