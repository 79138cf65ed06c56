"""At how many points each command is disturbed, at least."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from tests.faults.steps import Fault

How = tuple[Fault, bool]
"""A fault, and whether the step is done first."""

FAULTS: Final[Mapping[str, How]] = {
    "killed": ("die", False),
    "killed in the middle": ("torn", False),
    "full disk": ("ENOSPC", False),
    "failing disk": ("EIO", True),
    "no database": ("database", False),
    "database fails late": ("database", True),
    "interrupted": ("INT", False),
    "ended": ("TERM", True),
}
CHANGES: Final = {
    "rm": 80,
    "rename": 45,
    "tag": 27,
    "mark": 60,
    "import": 70,
    "repair": 220,
}
INDEX: Final = {
    "reindex": 290,
    "reindex one": 145,
    "record": 250,
}
OPENINGS: Final = {
    "open after a crash": 170,
    "open after a crash in the index": 125,
    "open with an unlisted segment": 40,
    "open while removing": 65,
    "open after removing": 55,
    "open without a segment": 125,
}
BESIDE: Final = {
    "rm": 24,
    "rename": 20,
    "mark": 25,
    "import": 30,
    "repair": 70,
    "reindex": 120,
    "record": 100,
}
"""Steps before which another process asks, with a store that was open and one that is not."""
