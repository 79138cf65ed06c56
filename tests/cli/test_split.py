"""`--split-by`: every part is the file that a question of its own writes."""

from __future__ import annotations

from pathlib import Path

import pytest

import hybridlog as hl
from benchmarks.simulator.topics import RobotConfig
from benchmarks.simulator.write import write_bag

from .running import run

TOPICS = {"mp4": "front/image_raw"}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings `one` and `two`, four seconds each; `two` has three marks."""
    folder = tmp_path_factory.mktemp("split")
    config = RobotConfig(image_size=(16, 12), scan_beams=18, cloud_columns=6)
    write_bag(folder / "robot.bag", duration_s=4, config=config)
    with hl.open(folder / "store", create=True, mongo="none") as opened:
        opened.record(folder / "robot.bag", name="one")
        opened.record(folder / "robot.bag", name="two", again=True)
        opened.mark("two", "+1s", "carpet", until="+2s")
        opened.mark("two", "+2.5s", "lap 1")
        opened.mark("two", "+3s", "lap/2")
    return folder / "store"


def contents(path: Path) -> dict[str, bytes]:
    if path.is_file():
        return {"": path.read_bytes()}
    return {str(one.relative_to(path)): one.read_bytes() for one in path.rglob("*.*")}


@pytest.mark.parametrize("form", ["mcap", "csv", "mp4"])
def test_by_recording(store: Path, tmp_path: Path, form: str) -> None:
    words = ("-t", TOPICS.get(form, "scan"), "-F", form)
    said = run("export", tmp_path / "all", *words, "--split-by", "recording", store=store).err
    assert {one.name for one in tmp_path.iterdir()} == {"all-one", "all-two"}
    for label in ("one", "two"):
        part, alone = tmp_path / f"all-{label}", tmp_path / f"alone-{label}"
        assert str(part) in said
        run("export", alone, *words, "-r", label, store=store)
        assert contents(part) == contents(alone)


def test_by_mark_and_by_predicate(store: Path, tmp_path: Path) -> None:
    """A mark of a moment lasts until the next one of a moment."""
    export = ("export", "-r", "two", "-t", "scan", "-F", "mcap")
    run(*export, tmp_path / "m.mcap", "--split-by", "mark", store=store)
    spans = {
        "001-carpet": ("+1s", "+2s"),
        "002-lap-1": ("+2.5s", "+3s"),
        "003-lap-2": ("+3s", "end"),
    }
    assert {one.name for one in tmp_path.iterdir()} == {f"m-two-{name}.mcap" for name in spans}
    for name, span in spans.items():
        alone = tmp_path / "alone.mcap"
        run(*export, alone, "--between", *span, "-f", store=store)
        assert (tmp_path / f"m-two-{name}.mcap").read_bytes() == alone.read_bytes()
    with hl.open(store, mongo="none") as opened:
        found = (
            opened.recordings("two").topic("odom").where("twist.twist.linear.x > 0.1").intervals()
        )
    how = ("--split-by", "odom: twist.twist.linear.x > 0.1")
    run("export", tmp_path / "p.mcap", "-r", "two", *how, store=store)
    parts = sorted(tmp_path.glob("p-two-*.mcap"))
    assert len(parts) == len(found) > 0
    run("export", tmp_path / "t", "-r", "two", "-F", "csv", "-t", "odom", *how, store=store)
    assert [one.name for one in sorted((tmp_path / "t-two-001").iterdir())] == ["odom.csv"]


def test_nothing_leaves_no_file(store: Path, tmp_path: Path) -> None:
    export = ("export", tmp_path / "x.mcap", "-t", "scan")
    for how in ("mark", "odom: twist.twist.linear.x > 1e9"):
        said = run(*export, "-r", "one", "--split-by", how, store=store).err
        assert "No messages, so no file." in said
    assert not [*tmp_path.iterdir()]
    (tmp_path / "x-two.mcap").write_text("mine")
    assert "exists" in run(*export, "--split-by", "recording", store=store, code=2).err
    assert [one.name for one in tmp_path.iterdir()] == ["x-two.mcap"]
    wrong = ("-t", "odom", "--split-by", "ranges.min < 1")
    assert "Name the topic of the predicate" in run(*export, *wrong, store=store, code=2).err


def test_a_first_question_about_a_mark_tells_no_damage(store: Path) -> None:
    run("mark", "x", "-r", "one", "--at", "+1s", store=store)
    for _ in range(2):
        assert "damaged" not in run("fetch", "-t", "marks", "--count", store=store).err
