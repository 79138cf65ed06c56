"""Objects of a process are hidden from the garbage collector while it records."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.live import recording
from hybridlog.live.memory import FrozenObjects


@pytest.fixture(autouse=True)
def frozen(monkeypatch: pytest.MonkeyPatch) -> Iterator[FrozenObjects]:
    """A context of this test alone, which other tests cannot hold open."""
    own = FrozenObjects()
    monkeypatch.setattr(recording, "frozen_objects", own)
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
