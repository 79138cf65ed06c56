"""A store, and a recording of many chunks in it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import hybridlog as hl
from tests.query.test_intervals import recorded

PADDING = "a" * 60  # about ten messages fill a chunk


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    place = tmp_path_factory.mktemp("query") / "store"
    with hl.open(place, create=True, mongo="none") as opened:
        yield opened


@pytest.fixture
def many(store: hl.Store) -> hl.Store:
    """200 messages, a second apart, in about twenty chunks."""
    rows = [(n, "/state", {"s": 0, "n": n, "name": PADDING}) for n in range(200)]
    recorded(store, {"a": rows})
    return store
