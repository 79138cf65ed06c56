"""A store's manifests, in a directory and in a bucket."""

from __future__ import annotations

from pathlib import Path

import pytest

from hybridlog_storage.manifests import DiskManifests, Manifests
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.remote.store import BucketStore
from tests.remote.conftest import address, moto, proxy, running_proxy

__all__ = ["address", "moto", "proxy", "running_proxy"]


@pytest.fixture(params=["disk", "bucket"])
def manifests(request: pytest.FixtureRequest, tmp_path: Path) -> Manifests:
    """Of an empty store."""
    if request.param == "disk":
        return DiskManifests(tmp_path)
    return BucketStore(Bucket(request.getfixturevalue("address"))).manifests
