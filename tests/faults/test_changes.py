from __future__ import annotations

import pytest

from tests.faults import points
from tests.faults.cases import Bench, try_everything
from tests.faults.scenarios import scenario


@pytest.mark.exhaustive
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", points.CHANGES)
def test_what_is_interrupted_is_finished_or_taken_back(bench: Bench, name: str) -> None:
    assert try_everything(bench, scenario(bench, name)) >= points.CHANGES[name]


def test_there_are_enough_points() -> None:
    parts = (points.CHANGES, points.INDEX, points.OPENINGS, points.BESIDE)
    assert sum(sum(part.values()) for part in parts) >= 2000
