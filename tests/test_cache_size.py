"""The size of the embedded MongoDB's cache is a setting of its store."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.errors import StoreError
from hybridlog_storage.settings import read_settings, write_settings
from tests.many_topics import mongod_of
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")


@pytest.mark.parametrize(("setting", "size"), [(None, 256), (320, 320), (10_000_000, 512)])
def test_a_store_says_its_size_and_gets_half_of_the_memory_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, setting: int | None, size: int
) -> None:
    monkeypatch.setenv("HYBRIDLOG_MONGOD_LINGER_S", "0")
    StoreDirectory.create(tmp_path)
    write_settings(tmp_path, replace(read_settings(tmp_path), cache_mb=setting))
    sizes = {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": (1 << 30) // 4096}
    monkeypatch.setattr("hybridlog.index.access.os.sysconf", sizes.__getitem__)
    with hl.open(tmp_path, require_database=True) as store:
        process = mongod_of(store)
        words = (process / "cmdline").read_text().split("\0")
    wait_for(lambda: not process.exists())
    assert float(words[words.index("--wiredTigerCacheSizeGB") + 1]) == size / 1024


@pytest.mark.parametrize("value", ["'300'", "1", "300.5", "true"])
def test_a_wrong_size(tmp_path: Path, value: str) -> None:
    StoreDirectory.create(tmp_path)
    settings = tmp_path / "hybridlog.toml"
    settings.write_text(f"format = 4\nstore_id = 'x'\ncache_mb = {value}\n")
    with pytest.raises(StoreError, match=r"hybridlog.toml is malformed: .*cache_mb"):
        hl.open(tmp_path)
