"""How a backend looks in every figure and table: title, colour, marker, place.

The colours tell apart for people who see fewer, and on light and dark pages alike; a
marker says the same once more. The two ways of setting up one system share a hue.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple
from zlib import crc32

from hybridlog.cli.output import printable


class Look(NamedTuple):
    """How one backend is drawn.

    Attributes:
        title: For legends and tables.
        colour: Of its line and bars.
        marker: Of its points, as matplotlib calls them.
        dash: Of its line.
    """

    title: str
    colour: str
    marker: str
    dash: Literal["-", "--", "-.", ":"] = "-"


OURS = "hybridlog"

_LOOKS = {
    OURS: Look("hybridlog", "#d55e00", "o"),
    "hybridlog_recorder": Look("hybridlog (recorder)", "#b34700", "d", "--"),
    "hybridlog_api": Look("hybridlog (its own API)", "#d55e00", "H", "--"),
    "hybridlog_indexed": Look("hybridlog (indexed)", "#b34700", "8", "-."),
    "hybridlog_api_indexed": Look("hybridlog (its own API, indexed)", "#7a3300", "p", ":"),
    "mongo_json": Look("MongoDB", "#009e73", "s"),
    "mongo_json_indexed": Look("MongoDB (indexed)", "#009e73", "D", "--"),
    "mongo_json_batched": Look("MongoDB (batched)", "#00664b", "<", "-."),
    "postgres_autocommit": Look("PostgreSQL (autocommit)", "#56b4e9", "v"),
    "postgres_tuned": Look("PostgreSQL (tuned)", "#2f7ed8", "^"),
    "postgres_tuned_indexed": Look("PostgreSQL (tuned, indexed)", "#2f7ed8", ">", "--"),
    "sqlite_udf": Look("SQLite (Python functions)", "#cc79a7", "P"),
    "sqlite_json1": Look("SQLite (JSON1)", "#aa4499", "X"),
    "bagfile": Look("ROS bag", "#c79a00", "*"),
    "mcap": Look("plain MCAP", "#7f7f7f", "h", "-."),
    "nothing": Look("harness alone", "#9a9a9a", ".", ":"),
}

_SPARE = ("#882255", "#44aa99", "#999933", "#6699cc", "#ee8866")
_SPARE_MARKERS = ("<", "p", "d", "H", "8")


def look(backend: str) -> Look:
    """How a backend is drawn; one that we do not know always looks the same, too."""
    known = _LOOKS.get(backend)
    if known is not None:
        return known
    spare = crc32(backend.encode()) % len(_SPARE)
    return Look(printable(backend), _SPARE[spare], _SPARE_MARKERS[spare])


def title(backend: str) -> str:
    """A backend's name for people."""
    return look(backend).title


def ordered(backends: Iterable[str]) -> list[str]:
    """Backends in the order of every legend and table: ours, the paper's, the rest."""
    places = {name: place for place, name in enumerate(_LOOKS)}
    return sorted(set(backends), key=lambda name: (places.get(name, len(places)), name))


FLOORS = frozenset({"nothing", "mcap", "bagfile"})
"""Backends that are no databases: a file, or nothing at all."""


def databases(backends: Iterable[str]) -> list[str]:
    """The ones that can be asked and are not ours: what hybridlog is compared with."""
    others = (name for name in ordered(backends) if name not in FLOORS)
    return [name for name in others if not name.startswith(OURS)]
