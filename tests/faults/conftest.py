"""One mongod and one process that forks for all cases of a module."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.faults.cases import Bench
from tests.faults.steps import Stepper
from tests.faults.stores import Server


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    path = tmp_path_factory.mktemp("faults")
    with Server(path / "mongod") as server, Stepper() as stepper:
        yield Bench(server, stepper, path)
