"""Names of columns: built-in columns and fields.

Every table has `log_time`. Tables of several topics also have `topic`, and tables of
several recordings `recording`. A field of one of these names always gets a trailing
underscore. The other built-in columns are present on request; a field of that name gets an
underscore then.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from hybridlog.schema.definition_text import NUMBERS, element_of

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

RESERVED: Final = ("log_time", "recording", "topic")
"""Columns that are always present."""
OPTIONAL: Final = ("publish_time", "stamp", "seq", "sequence")
"""Columns that are present on request: publish time, header stamp, arrival number in
the recording, and the sender's sequence number."""
FIELD: Final = b"hybridlog.field"
"""Arrow metadata of a column that was renamed: the path of its field."""
SUMMARIES = ("n", "min", "max", "mean")


def own_columns(requested: Sequence[str] | None, defined: Collection[str]) -> list[str]:
    """The built-in columns among the requested names; None requests all fields.

    A name in the definitions of the topics is the field, unless it is reserved.
    """
    names = dict.fromkeys(requested or ())
    return [n for n in names if n in RESERVED or (n in OPTIONAL and n not in defined)]


def is_own(name: str) -> bool:
    """True if a name that is no field is a built-in column."""
    return name in RESERVED or name in OPTIONAL


def free_name(path: str, taken: Collection[str]) -> str:
    """The name of a field's column: its path, with underscores added until it is unique."""
    while path in RESERVED or path in taken:
        path += "_"
    return path


def arranged(names: Sequence[str], fields: Sequence[str] | None) -> list[str]:
    """Column names in the order in which their fields were requested; None for all.

    Columns that were not requested come first: log time, topic, recording.
    """
    if fields is None:
        return list(names)
    requested = [path.replace("[]", "") for path in fields]

    def place(name: str) -> int:
        # A field with the name of a built-in column has an extra underscore.
        plain = name.rstrip("_")
        same = {name, plain} if is_own(plain) else {name}
        exact = (number for number, path in enumerate(requested) if path in same)
        near = (number for number, path in enumerate(requested) if is_part(name, path))
        return next(exact, next(near, -1))

    return sorted(names, key=place)


def is_part(name: str, path: str) -> bool:
    """True if one of two paths is a part of the other, or they are equal."""
    return f"{name}.".startswith(f"{path}.") or path.startswith(f"{name}.")


def summary_of(path: str) -> tuple[str, str] | None:
    """The array and the summary that a path may mean: `ranges.min`."""
    array, dot, what = path.rpartition(".")
    return (array, what) if dot and what in SUMMARIES else None


def is_summary(path: str, known: Mapping[str, str]) -> bool:
    """True if a path is a summary of an array or of bytes, and no field."""
    found = summary_of(path)
    if found is None or path in known:
        return False
    kind = known.get(found[0], "")
    element = element_of(kind)
    if found[1] == "n":
        return element is not None or kind == "bytes"
    return element == "bool" or element in NUMBERS
