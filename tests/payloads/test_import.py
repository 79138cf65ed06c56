"""A copy of a recording with files of rows: what is listed, and nothing else."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from tests import places
from tests.copies import bring
from tests.payloads.logs import recording_of
from tests.payloads.test_expiry import expire

NOWHERE = "mongodb://127.0.0.1:9/x?serverSelectionTimeoutMS=50&connectTimeoutMS=50"


@pytest.fixture(scope="module")
def thin(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store whose scans and clouds have expired."""
    path = tmp_path_factory.mktemp("thin") / "store"
    shutil.copytree(plain, path)
    expire(path, [0, 1])
    return path


@pytest.fixture
def source(thin: Path, tmp_path: Path) -> Path:
    shutil.copytree(thin, tmp_path / "source")
    return tmp_path / "source"


@pytest.fixture
def mine(tmp_path: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "mine", mongo=NOWHERE, create=True) as store:
        yield store


def files_of(store: Path) -> dict[str, int]:
    """Sizes of the segments and files of rows of the recording."""
    recording = recording_of(store)
    found = [*recording.glob("*.mcap"), *recording.glob("*.rows.parquet")]
    return {str(path.relative_to(recording)): path.stat().st_size for path in found}


def fields_of(store: hl.Store) -> list[tuple[object, ...]]:
    return [(m.topic, m.log_time_ns, m.seq, m.state, m.fields) for m in store.all_topics()]


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


@pytest.mark.parametrize("fault", [flip, cut, Path.unlink])
@pytest.mark.parametrize("name", ["000001.rows.parquet", "000001.1.rows.parquet", "000000.mcap"])
def test_a_source_that_was_mended_is_imported(
    source: Path, mine: hl.Store, thin: Path, name: str, fault: Callable[[Path], None]
) -> None:
    path = next(recording_of(source).glob(name))
    whole = path.read_bytes()
    fault(path)
    for _ in range(2):
        (why,) = bring(mine, source).refused.values()
        assert re.search(r"damaged|incomplete|[Nn]o such file", why)
        assert not mine.recordings()
    path.write_bytes(whole)
    assert bring(mine, source).copied == ["log"]
    assert mine.recordings()[0].status == "complete"
    assert files_of(mine.directory.path) == files_of(thin)
    with hl.open(thin, mongo=NOWHERE) as store:
        assert fields_of(mine) == fields_of(store)


def test_only_what_is_listed_is_copied(source: Path, mine: hl.Store, thin: Path) -> None:
    recording = recording_of(source)
    for name in ("secret", "000000.mcap.old", "000000.rows.parquet"):
        (recording / name).write_bytes(b"not listed")
    (recording / "link").symlink_to("/etc/passwd")
    report = bring(mine, source)
    assert report.copied == ["log"]
    assert report.bytes_copied == sum(files_of(thin).values())
    assert files_of(mine.directory.path) == files_of(thin)
    names = {path.name for path in recording_of(mine.directory.path).iterdir()}
    assert names - {"manifest.lock"} == {"writer.lock", *files_of(thin)}
    assert mine.recordings()[0].status == "complete"
    assert not mine.verify().findings


def test_what_an_earlier_import_left_is_checked(source: Path, mine: hl.Store, thin: Path) -> None:
    with hl.open(source, mongo=NOWHERE) as store:
        hidden = places.root(mine.directory.path) / store.recordings()[0].id
    shutil.copytree(recording_of(source), hidden)
    for name in ("manifest.lock", "manifest.old"):
        (hidden / name).unlink()  # they come when all else is whole
    shutil.copy(hidden / "000000.mcap", hidden / "000077.mcap")
    (hidden / "000000.rows.parquet").write_bytes(b"stale")
    flip(hidden / "000001.1.rows.parquet")
    cut(hidden / "000001.rows.parquet")
    assert bring(mine, source).copied == ["log"]
    assert files_of(mine.directory.path) == files_of(thin)
    assert mine.recordings()[0].status == "complete"
    assert not mine.verify().findings
