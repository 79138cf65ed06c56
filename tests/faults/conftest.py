"""One mongod and one process that forks for all cases of a module."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.conftest import DATABASES
from tests.faults.cases import Bench
from tests.faults.steps import Stepper
from tests.faults.stores import Server


@pytest.fixture(scope="module")
def bench(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    server = Server(pytestconfig.stash[DATABASES])
    with server.client, Stepper() as stepper:
        yield Bench(server, stepper, tmp_path_factory.mktemp("faults"))
