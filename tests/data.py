"""Where the real logs lie; tests that need them skip loudly when they are absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATA = Path(
    os.environ.get("HYBRIDLOG_TEST_DATA", Path(__file__).parents[1].parent / "shared" / "data")
)

needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"the real logs are not at {DATA}; set HYBRIDLOG_TEST_DATA"
)
