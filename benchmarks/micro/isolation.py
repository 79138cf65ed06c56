"""One source at a time: what is imported comes from the revision that is measured.

An editable install puts a checkout on the path of every process. A package or module
that the measured revision lacks would be found there, and measured in its place.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

SOURCE = "HYBRIDLOG_MICRO_SOURCE"
"""Environment variable with the directory that holds the measured source."""
INPUTS = "HYBRIDLOG_MICRO_INPUTS"
"""Environment variable with the directory that holds the inputs."""
OUTCOME = "HYBRIDLOG_MICRO_OUTCOME"
"""Environment variable with the file that takes what the benchmarks do not time."""

PACKAGES = ("hybridlog", "hybridlog_storage")


def source() -> Path | None:
    """Where the measured source must lie; None when any will do."""
    text = os.environ.get(SOURCE)
    return Path(text).resolve() if text else None


def leave_path(root: Path) -> None:
    """Take other sources of hybridlog off `sys.path`.

    Args:
        root: Directory of the source that stays.
    """
    sys.path[:] = [entry for entry in sys.path if not _is_other_source(Path(entry), root)]


def strangers(root: Path) -> list[str]:
    """Modules of hybridlog that were loaded from elsewhere, each with its file."""
    found = []
    for name, module in sorted(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.partition(".")[0] in PACKAGES and file is not None:
            path = Path(file).resolve()
            if not path.is_relative_to(root):
                found.append(f"{name}: {path}")
    return found


def file_of(package: str) -> str | None:
    """From where a package is imported; None when it is not to be had."""
    try:
        return import_module(package).__file__
    except ModuleNotFoundError:
        return None


def need(module: str, *names: str) -> SimpleNamespace:
    """Things of the measured source; a benchmark of what it lacks is skipped.

    Args:
        module: Where they are.
        names: What is wanted.
    """
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in PACKAGES:
            raise
        pytest.skip(f"there is no module {error.name}")
    for name in names:
        if not hasattr(found, name):
            pytest.skip(f"{module} has no {name}")
    return SimpleNamespace(**{name: getattr(found, name) for name in names})


def _is_other_source(entry: Path, root: Path) -> bool:
    if entry.name in {"site-packages", "dist-packages"}:
        return False
    holds = any((entry / package / "__init__.py").is_file() for package in PACKAGES)
    return holds and not entry.resolve().is_relative_to(root)
