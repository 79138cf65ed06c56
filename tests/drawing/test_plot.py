"""`hybridlog plot`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hybridlog.drawing.figure import MAX_LINES, Line, figure, lines
from hybridlog.drawing.series import Series
from hybridlog_storage.errors import MissingDependencyError, TopicError, UsageError
from tests.calls import Calls
from tests.cli.within import Answer, answer

from .conftest import BASE, Drive


def plot(drive: Drive, *arguments: object, code: int = 0) -> Answer:
    return answer("plot", *arguments, store=drive.directory, code=code)


def made(times: list[float], values: list[float], field: str = "x", topic: str = "/a") -> Line:
    at = np.array([BASE + round(time * 1e9) for time in times], np.int64)
    numbers = np.array(values, np.float64)
    return Line(topic, "one", BASE, Series(field, at, numbers, numbers, True))


def test_lines_are_by_topic_and_recording(drive: Drive) -> None:
    query = drive.store.topic("drive", "loose")
    found = lines(query, ["linear.z", "w"], pixels=3000)
    assert [(x.topic, x.recording, x.series.field) for x in found] == [
        ("/drive", "drive", "linear.z"),
        ("/loose", "drive", "w"),
    ]
    assert {x.start for x in found} == {BASE}
    assert query.counters.messages == 5100
    with pytest.raises(TopicError, match="nothing"):
        lines(drive.store.topic("drive"), ["y", "nothing"], pixels=9)
    with pytest.raises(UsageError, match=f"at most {MAX_LINES} lines"):
        lines(drive.store.topic("drive"), [f"wide[{n}]" for n in range(MAX_LINES + 1)], pixels=9)
    with pytest.raises(UsageError, match="Name a field"):
        lines(drive.store.topic("drive"), [], pixels=9)


@pytest.mark.parametrize("form", ["png", "svg", "pdf"])
def test_files(drive: Drive, tmp_path: Path, form: str) -> None:
    path = tmp_path / f"speed.{form}"
    ask = ("-t", "drive", "--fields", "linear.z,y", "-o", path)
    assert "of payload" not in plot(drive, *ask).err
    content = path.read_bytes()
    if form == "png":
        with Image.open(path) as picture:
            assert picture.size == (1200, 400)
            colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
        for colour in ((31, 119, 180), (255, 127, 14)):  # blue and orange
            assert (np.abs(colours.astype(int) - colour).max(axis=1) < 20).sum() > 200
    elif form == "svg":
        text = content.decode()
        assert all(f">{name}<" in text for name in ("linear.z", "y", "/drive"))
        assert "seconds since 2025-06-03T08:00:00Z, drive" in text
        assert len(content) < 200_000
        again = tmp_path / "again.svg"
        plot(drive, *ask[:-1], again)
        assert again.read_bytes() == content
    else:
        assert content.startswith(b"%PDF")
    plot(drive, *ask, code=2)
    assert path.read_bytes() == content
    if form == "png":  # topics without such a field take no room
        for names, height in (("y", 400), ("y,w", 800)):
            plot(drive, "-t", "*", "--fields", names, "-o", tmp_path / f"{names}.png")
            with Image.open(tmp_path / f"{names}.png") as picture:
                assert picture.size == (1200, height)
    plot(drive, *ask, "--force", "--between", "+1s", "+2s")
    assert path.read_bytes() != content
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith("speed")] == [path.name]


def curves_of(found: list[Line]) -> str:
    return figure(found, size=(500, 300), form="svg").decode()


def test_names_are_no_formulas_and_letters_may_lack() -> None:
    names = ["$x", "_hidden", "a$b^$\\frac", "\x1b[31m", "日本 \U0001f916"]
    found = [made([0, 1], [0, 1], name, "$\\topic$") for name in names]
    text = curves_of(found)
    assert "$\\topic$" in text
    for name in names:
        want = name.replace("\x1b", "\N{REPLACEMENT CHARACTER}")
        assert f">{want}<" in text.replace("&amp;", "&")
    assert "$x" in curves_of(found[:1])
    assert figure(found, size=(500, 300), form="png").startswith(b"\x89PNG")


def test_without_matplotlib(drive: Drive, tmp_path: Path, calls: Calls) -> None:
    calls.missing("matplotlib")
    ask = ("-t", "drive", "--fields", "y")
    with pytest.raises(MissingDependencyError, match=r"pip install 'hybridlog\[plot\]'"):
        figure([], size=(500, 300), form="png")
    plot(drive, *ask, "-o", tmp_path / "y.png", code=MissingDependencyError.exit_code)
    told = plot(drive, *ask, "-o", tmp_path / "y.gif", code=2).err
    assert "end it in .png, .svg, .pdf." in told
    assert [*tmp_path.iterdir()] == []
