"""Memory of a recorder: its budget, and what the garbage collector leaves alone."""

from __future__ import annotations

import gc
import os
import weakref
from pathlib import Path

import pytest

from benchmarks.simulator.write import write_bag
from hybridlog.live import policy as module
from hybridlog.live import recorder
from hybridlog.live.recorder import RecorderOptions
from hybridlog.live.recording import LiveOptions
from tests.calls import Calls
from tests.cli.within import answer as run

MACHINE = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def groups(root: Path, name: str, limits: dict[str, str]) -> tuple[Path, Path]:
    """Control groups as Linux shows them, and what names one's own."""
    for group, limit in limits.items():
        (root / "groups" / group).mkdir(parents=True, exist_ok=True)
        (root / "groups" / group / "memory.max").write_text(limit)
    own = root / "own"
    own.write_text(f"12:cpu:/elsewhere\n0::{name}\n")
    return root / "groups", own


def test_a_limit_counts_wherever_it_is_set(tmp_path: Path) -> None:
    limits = {"a/b": "max\n", "a": f"{1 << 20}\n", "other": "7\n"}
    assert module.memory_bytes(*groups(tmp_path, "/a/b", limits)) == 1 << 20


def test_no_limit_is_the_machine(tmp_path: Path) -> None:
    assert module.memory_bytes(*groups(tmp_path, "/a", {"a": "max\n"})) == MACHINE
    assert module.memory_bytes(*groups(tmp_path, "/gone", {})) == MACHINE
    assert module.memory_bytes(*groups(tmp_path, "/../..", {})) == MACHINE
    assert module.memory_bytes(tmp_path / "none", tmp_path / "nowhere") == MACHINE


@pytest.mark.parametrize(
    ("memory", "want"),
    [(512 << 20, 64 << 20), (8 << 30, 512 << 20), (24 << 30, 1536 << 20), (1 << 40, 2 << 30)],
)
def test_a_sixteenth(monkeypatch: pytest.MonkeyPatch, memory: int, want: int) -> None:
    monkeypatch.setattr(module, "memory_bytes", lambda: memory)
    module.default_budget.cache_clear()
    try:
        assert module.default_budget() == want
        assert LiveOptions().budget_bytes == RecorderOptions().budget_bytes == want
    finally:
        monkeypatch.undo()
        module.default_budget.cache_clear()


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
