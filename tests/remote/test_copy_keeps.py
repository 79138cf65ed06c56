"""A copy into a bucket never takes the place of more than it brings, and proves what it sent."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.maintenance.copying import CopyOptions
from hybridlog_storage.disk import files
from hybridlog_storage.remote.bucket import Object
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.remote.conftest import BEGIN, SCAN
from tests.remote.server import Proxy

THEN = CopyOptions(then_expire=True)
COUNT = 60


@pytest.fixture
def robot(tmp_path: Path) -> hl.Store:
    """A store with a recording of three groups, with a log each besides the first one."""
    store = hl.open(tmp_path / "robot", mongo="none", create=True)
    noise = np.random.default_rng(1)
    settings = SegmentSettings(chunk_size=4096, segment_size=45_000)
    with store.start("run", settings=settings) as run:
        for number in range(COUNT):
            scan = struct.pack("<II", number, 500) + noise.random(500, np.float32).tobytes()
            run.write(SCAN, scan, log_time=BEGIN + number * 10**8)
    assert store.entry("run").segments == 6
    return store


def states(address: str | Path) -> dict[str, int]:
    files.mounted.clear()
    with hl.open(address) as store:
        return dict(Counter(str(one.state) for one in store.topic("scan")))


@pytest.mark.parametrize("has_digests", [True, False])
def test_what_did_not_arrive_as_sent(
    robot: hl.Store,
    address: str,
    proxy: Proxy,
    monkeypatch: pytest.MonkeyPatch,
    has_digests: bool,
) -> None:
    """Payloads stay here; also if the tags of the server are no digests of what it got."""
    if not has_digests:
        monkeypatch.setattr(Object, "has_md5_of", lambda *_: False)

    def spoil(number: int) -> str:
        method, path, _ = proxy.requests[number - 1]
        return "flip" if method == "PUT" and "000001.mcap" in path else ""

    proxy.spoil = spoil
    report = robot.copy(address, options=THEN)
    assert "000001.mcap did not arrive" in report.refused["run"]
    assert states(robot.directory.path) == {"whole": COUNT}
    proxy.reset()
    report = robot.copy(address, options=THEN)
    assert (report.copied, report.problems) == (["run"], [])
    read = [path for method, path, _ in proxy.requests if method == "GET" and ".mcap" in path]
    assert has_digests or read
    assert states(address) == {"whole": COUNT}
