"""Lint, formatting and types, as tests: what CI would refuse is seen before."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest

from tests.imports import ROOT

CHECKS = {
    "ruff check": ("ruff", "check", "."),
    "ruff format": ("ruff", "format", "--check", "."),
    "mypy": ("mypy",),
}


@pytest.mark.parametrize("name", sorted(CHECKS))
def test_style(name: str) -> None:
    module, *arguments = CHECKS[name]
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed, so {name} was NOT run: pip install -e .[dev]")
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{name}:\n{done.stdout[-6000:]}{done.stderr[-2000:]}"
