"""What the tests of live recording share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl


@pytest.fixture
def store(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[hl.Store]:
    """An empty store without MongoDB; a test that is marked `mongo` finds it connected."""
    is_indexed = request.node.get_closest_marker("mongo") is not None
    with hl.open(tmp_path / "store", create=True, require_database=is_indexed) as opened:
        yield opened
