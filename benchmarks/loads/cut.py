"""The beginning of a load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.loads import truth
from benchmarks.loads.base import Load


def cut(load: Load, seconds: float) -> Load:
    """Keep what is due in the first seconds, and save that in the place of the whole.

    Args:
        load: It lies where its payload file does. A truth beside it goes: it is one of
            the whole load.
        seconds: What is due as late or later is left out. At least the first message stays.
    """
    directory = load.payloads.parent
    (directory / truth.NAME).unlink(missing_ok=True)
    rows = slice(max(1, int(np.searchsorted(load.due, round(seconds * 1e9)))))
    columns = {
        name: getattr(load, name)[rows]
        for name in ("channel", "due", "log_time", "offset", "length")
    }
    shorter = replace(load, **columns)
    shorter.save(directory)
    return shorter
