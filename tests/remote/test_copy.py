"""Copies into a bucket: at the end of a chain of places, cut anywhere, fields first."""

from __future__ import annotations

from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.disk import files
from hybridlog_storage.errors import UsageError
from hybridlog_storage.remote.bucket import Bucket
from tests import places
from tests.copies import bring
from tests.copying.conftest import (
    STATES,
    all_answers,
    robots,  # noqa: F401 - a fixture
    sshd,  # noqa: F401 - a fixture
)


def test_a_bucket_answers_like_the_robot(
    robots: Path,  # noqa: F811
    address: str,
    tmp_path: Path,
) -> None:
    """Recordings in all states, there and back again."""
    right = all_answers(robots)
    with hl.open(robots, mongo="none") as store:
        assert not store.copy(address).refused
        again = store.copy(address)
    assert (again.copied, sorted(again.known)) == ([], sorted(STATES))
    files.mounted.clear()
    assert all_answers(Path(address)) == right
    with hl.open(address) as store, pytest.raises(UsageError, match="this very store"):
        store.copy(f"{address}/")
    with hl.open(tmp_path / "back", mongo="none", create=True) as back:
        assert sorted(bring(back, address).copied) == sorted(STATES)
        assert not back.verify().findings
    objects = {one.name for one in Bucket(address).objects("recordings")}
    listed = {
        f"recordings/{one.id}/{name}"
        for one in (places.manifest(robots, label) for label in STATES)
        for name in (file.name for file in one.files if file.is_here)
    }
    assert objects == listed  # none was sent twice
