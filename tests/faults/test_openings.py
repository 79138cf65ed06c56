from __future__ import annotations

import pytest

from tests.faults import points
from tests.faults.cases import Bench, try_everything
from tests.faults.scenarios import scenario


@pytest.mark.exhaustive
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", points.OPENINGS)
def test_an_opening_that_is_interrupted_is_finished_by_the_next(bench: Bench, name: str) -> None:
    assert try_everything(bench, scenario(bench, name)) >= points.OPENINGS[name]
