"""`hybridlog fetch --format png|jpg`."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hybridlog.formats.pictures import suffix_of
from hybridlog_storage.errors import PayloadError, UsageError
from tests.cli.within import Answer, answer

from .conftest import BASE, FILES, MS, SEEN, Drive


def fetch(drive: Drive, *arguments: object, code: int = 0) -> Answer:
    return answer("fetch", *arguments, store=drive.directory, code=code)


def index_of(directory: Path) -> list[dict[str, Any]]:
    lines = (directory / "index.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def test_raw_images_become_png(drive: Drive, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    done = fetch(drive, "-t", "front", "-F", "png", "-o", out, "-v")
    assert "1 message is left out; the first: an image has rows of 18 bytes" in done.err
    assert "4 messages, " in done.err
    assert sorted(p.name for p in out.iterdir()) == ["front", "index.jsonl"]
    names = [f"{BASE + n * MS}.png" for n in (0, 2, 3)]
    assert sorted(p.name for p in (out / "front").iterdir()) == names
    for name, pixels in zip(names, SEEN[[0, 2, 3]], strict=True):
        with Image.open(out / "front" / name) as picture:
            assert np.array_equal(np.asarray(picture), pixels)
    first = index_of(out)[0]
    assert first["file"] == f"front/{names[0]}"
    assert (first["topic"], first["media_type"]) == ("/front", "image/png")
    assert (first["log_time_ns"], first["publish_time_ns"]) == (BASE, BASE)
    assert first["length"] == (out / first["file"]).stat().st_size


def test_raw_images_become_jpeg(drive: Drive, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    fetch(drive, "-t", "front", "-n", "1", "-F", "jpg", "-o", out)
    (path,) = out.glob("front/*")
    assert path.name == f"{BASE}.jpg"
    with Image.open(path) as picture:
        assert (picture.format, picture.size) == ("JPEG", (6, 4))


@pytest.mark.parametrize("form", ["png", "jpg"])
def test_compressed_images_as_they_came(drive: Drive, tmp_path: Path, form: str) -> None:
    out = tmp_path / "pictures"
    fetch(drive, "-t", "rear/*", "-F", form, "-o", out)
    # Two of the same nanosecond have names of their own.
    names = [f"{BASE}.jpg", f"{BASE}-1.webp", f"{BASE + 1}.jpg"]
    assert [row["file"] for row in index_of(out)] == [f"rear__compressed/{n}" for n in names]
    assert [(out / row["file"]).read_bytes() for row in index_of(out)] == FILES


def test_one_image(drive: Drive, tmp_path: Path) -> None:
    front = ("-t", "front", "--at", "+2.5ms", "-o")
    for name in ("x.png", "x.jpg", "x.JPEG"):
        fetch(drive, *front, tmp_path / name)
        with Image.open(tmp_path / name) as picture:
            assert picture.format == ("PNG" if name == "x.png" else "JPEG")
    with Image.open(tmp_path / "x.png") as picture:
        assert np.array_equal(np.asarray(picture), SEEN[2])
    rear = ("-t", "rear/compressed", "-n", "1", "-o")
    fetch(drive, *rear, tmp_path / "y.jpg")
    assert (tmp_path / "y.jpg").read_bytes() == FILES[0]
    refused = fetch(drive, *rear, tmp_path / "y.png", code=2)
    assert refused == Answer("", "", 2)
    assert not (tmp_path / "y.png").exists()
    fetch(drive, "-t", "front", "-o", tmp_path / "z.png", code=2)
    fetch(drive, "-t", "front", "--limit", 0, "-o", tmp_path / "z.png", code=2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.JPEG", "x.jpg", "x.png", "y.jpg"]


def test_an_image_on_standard_output(drive: Drive) -> None:
    from click.testing import CliRunner

    from hybridlog.cli.app import app

    arguments = ["fetch", "-t", "front", "-n", "1", "-F", "png", "-q"]
    environment = {"HYBRIDLOG_STORE": str(drive.directory)}
    done = CliRunner().invoke(app, arguments, env=environment)
    with Image.open(io.BytesIO(done.stdout_bytes)) as picture:
        assert np.array_equal(np.asarray(picture), SEEN[0])


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("-t", "drive"), UsageError.exit_code),
        (("-t", "broken"), PayloadError.exit_code),
        (("-t", "front", "--tags", "robot"), UsageError.exit_code),
    ],
)
def test_no_pictures_leave_nothing(
    drive: Drive, tmp_path: Path, arguments: tuple[str], code: int
) -> None:
    fetch(drive, *arguments, "-F", "png", "-o", tmp_path / "x", code=code)
    assert [*tmp_path.iterdir()] == []


def test_only_our_directories_are_overwritten(drive: Drive, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    ask = ("-t", "rear/*", "-F", "png", "-o", out)
    fetch(drive, *ask)
    fetch(drive, *ask, code=2)
    fetch(drive, *ask, "--force", "-n", 1)
    assert len([*out.glob("*/*")]) == 1
    (out / "rear__compressed" / "notes.txt").write_text("mine")
    fetch(drive, *ask, "--force", code=2)
    (tmp_path / "file").write_text("mine")
    fetch(drive, "-t", "rear/*", "-F", "png", "-f", "-o", tmp_path / "file", code=2)
    assert (tmp_path / "file").read_text() == "mine"


def test_suffixes() -> None:
    assert suffix_of("a/b.JPEG") == ".jpg"
    assert suffix_of("b.tiff") == ".tif"
    assert suffix_of("pictures") is None
    assert suffix_of("2025-06-03T08.00.00") is None
