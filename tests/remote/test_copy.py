"""Copies of recordings in all states into a bucket, cut after each file and resumed."""

from __future__ import annotations

from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.maintenance.copying import CopyOptions
from hybridlog_storage.disk import files
from hybridlog_storage.errors import UsageError
from tests.copying.conftest import STATES, answers, robots  # noqa: F401 - a fixture
from tests.remote.server import Proxy


def test_a_bucket_answers_like_the_robot(
    robots: Path,  # noqa: F811
    address: str,
    proxy: Proxy,
    tmp_path: Path,
) -> None:
    with hl.open(robots, mongo="none") as store:
        for number in range(4):  # of files that arrive in an attempt

            def cut(_label: str, _done: int, _total: int, left: list[int] = [number]) -> None:  # noqa: B006
                left[0] -= 1
                if left[0] < 0:
                    raise RuntimeError

            with pytest.raises(RuntimeError):
                store.copy(address, ["dropped"], progress=cut)
        report = store.copy(address)
        assert sorted(report.copied) == sorted(STATES)
        before = len(proxy.requests)
        again = store.copy(address)
        assert (again.copied, sorted(again.known)) == ([], sorted(STATES))
        assert len(proxy.requests) - before <= 3
        with pytest.raises(UsageError, match="as a whole"):
            store.copy(address, options=CopyOptions(only_fields=True))
    with hl.open(address) as store, pytest.raises(UsageError, match="this very store"):
        store.copy(f"{address}/")
    files.mounted.clear()
    for label in STATES:
        right = answers(robots, label)
        assert answers(Path(address), label) == right, label
    with hl.open(tmp_path / "back", mongo="none", create=True) as store:
        assert sorted(store.import_from(address).copied) == sorted(STATES)
        assert not store.verify().findings
