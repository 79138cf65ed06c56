"""When a run says more of the machine than of the system that was measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hybridlog_storage.threads import processors

TAKEN_SHARE = 0.05
"""A host that takes more of the processors' time away than this disturbs a run."""

MAX_RUNS = 3
"""So often a disturbed run is done altogether."""


def share_taken(values: Mapping[str, Any]) -> float:
    """Share of all processors' time that the host of this machine took during a run.

    0 where the system does not tell.
    """
    taken, wall = values.get("steal_s"), values.get("wall_s")
    if not isinstance(taken, int | float) or not isinstance(wall, int | float) or wall <= 0:
        return 0.0
    return taken / (wall * processors())


def is_disturbed(values: Mapping[str, Any]) -> bool:
    """Whether a run lost something, and the machine may be why.

    A run that kept everything kept it in spite of the machine.
    """
    lost = values.get("published") != values.get("persisted")
    return lost and share_taken(values) > TAKEN_SHARE
