"""The size of the embedded MongoDB's cache: who says it, and what mongod gets."""

from __future__ import annotations

from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.errors import StoreError, UsageError
from hybridlog_storage.settings import read_settings
from tests.many_topics import mongod_of
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")


@pytest.fixture(autouse=True)
def no_linger(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYBRIDLOG_MONGOD_LINGER_S", "0")


def cache_gb(store: hl.Store) -> float:
    """The size that mongod was started with; ends mongod."""
    process = mongod_of(store)
    words = (process / "cmdline").read_text().split("\0")
    store.close()
    wait_for(lambda: not process.exists())
    return float(words[words.index("--wiredTigerCacheSizeGB") + 1])


def test_a_new_store_keeps_its_size_and_others_win_over_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "store"
    with hl.open(place, create=True, require_database=True, cache_mb=320) as store:
        assert cache_gb(store) == 320 / 1024
    assert read_settings(place).cache_mb == 320
    with hl.open(place, require_database=True) as store:
        assert cache_gb(store) == 320 / 1024
    monkeypatch.setenv("HYBRIDLOG_CACHE_SIZE", "384")
    with hl.open(place, require_database=True) as store:
        assert cache_gb(store) == 384 / 1024
    with hl.open(place, require_database=True, cache_mb=288) as store:
        assert cache_gb(store) == 288 / 1024
    assert read_settings(place).cache_mb == 320
    with hl.open(tmp_path / "other", create=True, require_database=True) as store:
        assert cache_gb(store) == 384 / 1024
    assert read_settings(tmp_path / "other").cache_mb is None


def test_a_store_from_elsewhere_gets_half_of_the_memory_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    StoreDirectory.create(tmp_path / "store", cache_mb=10_000_000)
    sizes = {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": (1 << 30) // 4096}
    monkeypatch.setattr("hybridlog.index.access.os.sysconf", sizes.__getitem__)
    with hl.open(tmp_path / "store", require_database=True) as store:
        assert cache_gb(store) == 0.5


@pytest.mark.parametrize("value", [255, 0, -1, 10_240_001, True])
def test_sizes_that_mongodb_refuses(tmp_path: Path, value: int) -> None:
    with pytest.raises(UsageError, match=r"from 256 to 10240000, not"):
        hl.open(tmp_path / "store", create=True, cache_mb=value)
    assert not (tmp_path / "store").exists()


def test_a_wrong_size_in_the_environment_or_the_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    StoreDirectory.create(tmp_path)
    for text in ("a lot", "1e3", "100"):
        monkeypatch.setenv("HYBRIDLOG_CACHE_SIZE", text)
        with pytest.raises(UsageError, match="HYBRIDLOG_CACHE_SIZE must be a number of MB"):
            hl.open(tmp_path)
    monkeypatch.delenv("HYBRIDLOG_CACHE_SIZE")
    settings = tmp_path / "hybridlog.toml"
    for value in ("'300'", "1", "300.5", "true"):
        settings.write_text(f"format = 4\nstore_id = 'x'\ncache_mb = {value}\n")
        with pytest.raises(StoreError, match=r"hybridlog.toml is malformed: .*cache_mb"):
            hl.open(tmp_path)
