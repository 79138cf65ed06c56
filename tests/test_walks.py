"""Questions to an open store enter few modules, and seldom one that stands above its caller."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import cache
from types import FrameType
from typing import Any, Final

import pytest

import hybridlog as hl
from benchmarks.simulator.write import write_bag
from tests.imports import imports_of, modules

MODULES: Final = modules()
Question = Callable[[hl.Store], Any]
WALKS: Final[dict[str, tuple[int, int, Question]]] = {
    "a topic to pandas": (30, 2, lambda s: s.topic("odom").to_pandas()),
    "a count by predicate": (22, 2, lambda s: s.topic("scan").where("ranges.min < 0.5").count()),
    "a second as bytes": (25, 0, lambda s: [m.raw for m in s.topic("scan").between("+1s", "+2s")]),
    "align": (37, 5, lambda s: s.align(s.topic("imu/data"), [s.topic("odom")]).to_pandas()),
    "a count in SQL": (10, 0, lambda s: s.sql("select count(*) from odom").rows()),
}
"""Greatest numbers of own modules and of climbs. They only fall."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    base = tmp_path_factory.mktemp("walks")
    write_bag(base / "robot.bag", duration_s=3.0, topics=["/odom", "/base/scan", "/imu/data"])
    with hl.open(base / "store", create=True, mongo="none") as opened:
        opened.record(base / "robot.bag")
        yield opened.snapshot()


@cache
def height(module: str) -> int:
    """The longest way down from a module, by imports."""
    found = {one.module for one in imports_of(MODULES[module], module)} - {module}
    own = (one for one in found & {*MODULES} if not module.startswith(f"{one}."))
    return 1 + max(map(height, own), default=0)


@pytest.mark.parametrize("name", WALKS)
def test_a_question_enters_few_modules(store: hl.Store, name: str) -> None:
    most_modules, most_climbs, ask = WALKS[name]
    for _ in range(2):
        ask(store)  # what is cached from now on
    entered: set[str] = set()
    climbs: set[tuple[str, str]] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        here = frame.f_globals.get("__name__", "")
        if event != "call" or frame.f_code.co_name == "<module>" or here not in MODULES:
            return
        entered.add(here)
        back = frame.f_back
        while back is not None and back.f_globals.get("__name__") not in MODULES:
            back = back.f_back
        if back is not None and height(here) > height(back.f_globals["__name__"]):
            climbs.add((back.f_globals["__name__"], here))

    sys.setprofile(note)
    try:
        ask(store)
    finally:
        sys.setprofile(None)
    assert len(entered) <= most_modules, sorted(entered)
    assert len(climbs) <= most_climbs, sorted(climbs)
