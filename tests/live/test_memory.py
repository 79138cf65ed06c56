"""Memory of a recorder: its budget, and what the garbage collector leaves alone."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

from benchmarks.simulator.write import write_bag
from hybridlog.live import recorder
from tests.calls import Calls
from tests.cli.within import answer as run


class Knot:
    """Refers to itself: only the collector can take it away."""

    def __init__(self) -> None:
        self.itself = self


def test_what_was_there_before_a_recorder_is_not_collected(tmp_path: Path, calls: Calls) -> None:
    def look(*_: object) -> None:
        later = weakref.ref(Knot())
        gc.collect()
        found.append((knot() is not None, later() is None))

    found: list[tuple[bool, bool]] = []
    calls(recorder.Recorder, "start", look)
    write_bag(tmp_path / "a.bag", duration_s=1)
    gc.disable()
    try:
        knot = weakref.ref(Knot())
        run("record", "--replay", tmp_path / "a.bag", "--speed", "100", store=tmp_path / "s")
    finally:
        gc.enable()
    assert found == [(True, True)]
    gc.collect()
    assert knot() is None
