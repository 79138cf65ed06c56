"""Inputs of the speed and micro benchmarks, made once a session."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

Make = Callable[[Path], None]
Inputs = Callable[[str, Make], Path]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--quick", action="store_true", help="small inputs, rough ratios")


def pytest_configure() -> None:
    os.environ.setdefault("HYBRIDLOG_MONGOD_LINGER_S", "0.2")
    for name in ("HYBRIDLOG_STORE", "HYBRIDLOG_MONGO_URI"):
        os.environ.pop(name, None)


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Gives a file by its name; made when it is asked for first."""
    directory = tmp_path_factory.mktemp("inputs")

    def give(name: str, make: Make) -> Path:
        path = directory / name
        if not path.exists():
            make(path)
        return path

    return give


@pytest.fixture(scope="session")
def size(request: pytest.FixtureRequest) -> Callable[[int, int], int]:
    """Chooses between the size of a full and of a quick run."""
    quick = bool(request.config.getoption("--quick"))
    return lambda full, few: few if quick else full
