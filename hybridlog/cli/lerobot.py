"""`hybridlog export --format lerobot`: training sets."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import click

from hybridlog.cli import output
from hybridlog.cli.answers import check_room, write_bytes
from hybridlog.cli.binder import option
from hybridlog.cli.completion import complete_topic
from hybridlog.cli.progress import Bar
from hybridlog.cli.signals import if_stopped
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.store import Store
    from hybridlog.training.lerobot import LerobotReport

LEROBOT: Final = "lerobot"
_FPS: Final = 30


def _option(help: str, metavar: str | None = None, **settings: Any) -> Any:  # noqa: A002
    return option(help, metavar, needs=(f"form={LEROBOT}",), **settings)


@dataclass(frozen=True, kw_only=True)
class Training:
    """Options of training sets."""

    features: Path | None = _option("Topics and fields, in YAML.", "FILE", name="--map")
    propose_map: bool = _option(
        "Write a map for the topics that are there to OUTPUT, and nothing else."
    )
    fps: int | None = _option(
        f"Frames a second; without, {_FPS}.", "N", type=click.IntRange(1, 1000)
    )
    episodes_by: str | None = _option(
        "An episode for each `recording`, `mark`, or interval of a predicate.", "HOW"
    )
    task: str | None = _option("What the robot does, in words.", "TEXT")
    task_topic: str | None = _option(
        "A topic of texts that say it, at the begin of each episode.",
        "TOPIC",
        shell_complete=complete_topic,
    )
    vcodec: Literal["h264", "av1"] | None = _option(
        "Without, h264.", type=click.Choice(["h264", "av1"])
    )
    on_gap: Literal["refuse", "drop", "hold"] | None = _option(
        "Refuse an episode with a gap (the default), cut it there, or keep the last value.",
        type=click.Choice(["refuse", "drop", "hold"]),
    )


def export_set(store: Store, query: Query, target: Path, given: Training, *, force: bool) -> None:
    """Write a training set, or propose a map for one, with rare topics in comments."""
    from hybridlog.query.query import narrowed
    from hybridlog.training.feature_map import nearly_empty, proposed

    if given.propose_map:
        check_room(target, force=force)
        empty = nearly_empty(narrowed(query, *proposed(query).topics))
        left_out = (
            f"# left out: {topic} has {output.counted(count, 'message')}\n"
            for topic, count in empty.items()
        )
        write_bytes(target, "".join([proposed(query, empty).to_yaml(), *left_out]).encode())
        output.remarks([f"{target}: look at it, then add --map {target}."])
        return
    if given.features is None:
        raise UsageError(
            "Name a map with --map FILE. `hybridlog export map.yaml --format lerobot "
            "--propose-map` writes one to begin with."
        )
    if force and target.is_dir() and (target / "meta" / "info.json").exists():
        shutil.rmtree(target)
    done = 0
    again = "The same command goes on with the episodes that are not finished."
    with if_stopped(lambda: again), Bar(target.name, None) as bar:

        def tell(name: str, frames: int) -> None:
            nonlocal done
            done += frames
            bar(done, f"{name}: {output.counted(done, 'frame')}")

        report = store.to_lerobot(
            query,
            given.features,
            target,
            fps=given.fps or _FPS,
            episodes_by=given.episodes_by or "recording",
            task=given.task or "",
            task_topic=given.task_topic,
            codec=given.vcodec or "h264",
            on_gap=given.on_gap or "refuse",
            progress=tell,
        )
    _print_report(report, given.fps)


def _print_report(report: LerobotReport, fps: int | None) -> None:
    counted = output.counted
    resumed = f", {report.resumed} of them from before" if report.resumed else ""
    about = (
        f"{report.path}: {counted(report.episodes, 'episode')}{resumed}, "
        f"{counted(report.frames, 'frame')} at {fps or _FPS} Hz, {output.size(report.bytes)}"
    )
    output.remarks([about])
    said = {
        "with a value older than usual": report.held,
        "left out, where a topic has a gap": report.dropped,
        "with an earlier picture, since its own cannot be shown": report.missing,
    }
    output.notes(f"{counted(number, 'frame')} {what}." for what, number in said.items() if number)
    if report.lost:
        lost = f"{counted(report.lost, 'message')} of these topics are lost in the episodes"
        output.note(f"{lost}; meta/hybridlog.json says in which.")
