"""Memory of a recorder: its budget, and what the garbage collector leaves alone."""

from __future__ import annotations

import gc
import os
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.live import memory as module
from hybridlog.live.memory import FrozenObjects
from hybridlog.live.recorder import RecorderOptions
from hybridlog.live.recording import LiveOptions

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


@pytest.fixture
def frozen(monkeypatch: pytest.MonkeyPatch) -> Iterator[FrozenObjects]:
    """A context of this test alone, which other tests cannot hold open."""
    own = FrozenObjects()
    monkeypatch.setattr("hybridlog.live.recording.frozen_objects", own)
    gc.unfreeze()
    yield own
    assert gc.get_freeze_count() == 0


class Knot:
    """Refers to itself: only the collector can take it away."""

    def __init__(self) -> None:
        self.itself = self


def test_objects_are_frozen_until_the_last_has_left(frozen: FrozenObjects) -> None:
    knot = weakref.ref(Knot())
    with frozen:
        with frozen:
            assert gc.get_freeze_count() > 1000
        gc.collect()
        assert knot() is not None
        later = weakref.ref(Knot())
        gc.collect()
        assert later() is None
    gc.collect()
    assert knot() is None


def test_what_a_process_has_frozen_itself_stays_frozen(frozen: FrozenObjects) -> None:
    gc.freeze()
    try:
        with frozen:
            pass
        assert gc.get_freeze_count() > 1000
    finally:
        gc.unfreeze()


@pytest.mark.usefixtures("frozen")
def test_they_are_frozen_as_long_as_something_is_recorded(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("first"):
            with store.start("second"):
                pass
            assert gc.get_freeze_count() > 1000
        assert gc.get_freeze_count() == 0
        third = store.start("third")
        assert gc.get_freeze_count() > 1000
        third.abort()
