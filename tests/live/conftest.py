"""What the tests of live recording share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    """An empty store."""
    with hl.open(tmp_path / "store", create=True, require_database=True) as opened:
        yield opened
