"""Recordings that come from another store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import hybridlog as hl

if TYPE_CHECKING:
    from hybridlog.maintenance.copying import CopyReport


def bring(store: hl.Store, other: str | Path, *chosen: Any) -> CopyReport:
    """Copy recordings of another store into an open one."""
    with hl.open(other, mongo="none") as source:
        return source.copy(store.directory.place, *chosen)
