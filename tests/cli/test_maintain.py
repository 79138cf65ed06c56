"""`hybridlog index rebuild`, `verify`, `rm`, and stores that cannot be opened."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests import places
from tests.damage import flip
from tests.other_user import User, needs_root, open_place

from .running import run


def test_verify_lists_what_is_off(fresh: Path) -> None:
    flip(places.segment(fresh, "small", 1), 1 / 2)
    done = run("verify", store=fresh, code=1)
    findings = done.lines[:-1]
    assert any("000001.mcap byte" in line for line in findings)
    assert done.lines[-1].endswith(": 1 problem")
    found = run("verify", "--json", store=fresh, code=1).json["findings"]
    assert len(found) == len(findings)
    assert run("verify", "--quiet", store=fresh, code=1).lines == findings


def test_recording_into_something_else(logs: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "other").mkdir()
    (tmp_path / "other/file").write_text("x")
    for name in ("file", "other"):
        run("record", logs / "odd.mcap", store=tmp_path / name, code=5)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "file", "other"]


def test_a_newer_store(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "s"
    run("record", logs / "odd.mcap", "-q", store=store)
    settings = store / "hybridlog.toml"
    settings.write_text(settings.read_text().replace("format = 4", "format = 99"))
    for command in (("ls",), ("record", logs / "small.bag"), ("fetch", "-t", "x")):
        done = run(*command, store=store, code=5)
        assert "format 99" in done.err
        assert "Use the hybridlog that wrote it" in done.err


@needs_root
def test_a_store_that_another_user_cannot_write(logs: Path) -> None:
    with open_place() as place:
        store = place / "store"
        run("record", logs / "small.bag", "-q", store=store)
        shutil.copy(logs / "odd.mcap", place)
        user, where = User(place), ("--store", store)
        done = user.run("record", place / "odd.mcap", *where, code=5)
        assert "read-only" in done.err
        assert user.run("rm", "-y", "small", *where, code=None).code in {5, 6}
        count = ("fetch", "-t", "/imu/data", "--count", "-q", *where)
        assert user.run(*count).out == run(*count).out
        assert places.names(store) == ["small"]
        (store / "catalog.sqlite").unlink()
        for folder in (store, store / "tables", places.root(store)):
            folder.chmod(0o777)
        assert user.run(*count).out == run(*count).out


def test_the_default_store_is_in_the_working_directory(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run("record", logs / "odd.mcap", "-q")
    assert places.names(tmp_path / "hybridlog-store") == ["odd"]
    assert "odd" in run("ls").out
