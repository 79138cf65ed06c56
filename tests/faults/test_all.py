"""Each command is disturbed at all of its steps."""

from __future__ import annotations

import pytest

from tests.faults.cases import Bench, try_everything
from tests.faults.scenarios import SCENARIOS, scenario


@pytest.mark.exhaustive
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", SCENARIOS)
def test_what_is_interrupted_is_finished_or_taken_back(bench: Bench, name: str) -> None:
    assert try_everything(bench, scenario(bench, name)) >= 25
