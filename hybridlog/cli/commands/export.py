"""`hybridlog export`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import click

from hybridlog.cli import output
from hybridlog.cli.answers import check_room, form_of, latched, write_answer, write_bytes
from hybridlog.cli.options import (
    Forced,
    Latched,
    Options,
    Topics,
    argument,
    command,
    option,
)
from hybridlog.cli.output import Bar
from hybridlog.formats import OUTPUTS, formats_of, suffixes_of
from hybridlog_storage.errors import (
    DefinitionError,
    HybridlogError,
    PayloadError,
    TimeError,
    UsageError,
)

if TYPE_CHECKING:
    from hybridlog.formats.slices import Front
    from hybridlog.query.query import Query
    from hybridlog.store import Store


_LOGS = formats_of("log")
_FILES = formats_of("table", "lines", "video")
"""Formats with a file a topic."""


_LEROBOT: Final = "lerobot"


_option: Final = partial(option, needs=(f"form={_LEROBOT}",), section="With lerobot")


class _Training(Options):
    """Options of training sets."""

    features: Path | None = _option("Topics and fields, in YAML.", "FILE", name="--map")
    propose_map: bool = _option(
        "Write a map for the topics that are there to OUTPUT, and nothing else."
    )
    fps: int = _option("Frames a second.", "N", type=click.IntRange(1, 1000), default=30)
    episodes_by: str = _option(
        "An episode for each `recording`, `mark`, or interval of a predicate.",
        "HOW",
        default="recording",
    )
    task: str = _option("What the robot does, in words.", "TEXT", default="")
    task_topic: str | None = _option(
        "A topic of texts that say it, at the begin of each episode.", "TOPIC"
    )
    vcodec: Literal["h264", "av1"] = _option(
        "Codec of the video.", type=click.Choice(["h264", "av1"]), default="h264"
    )
    on_gap: Literal["refuse", "drop", "hold"] = _option(
        "Refuse an episode with a gap, cut it there, or keep the last value.",
        type=click.Choice(["refuse", "drop", "hold"]),
        default="refuse",
    )
    depth_scale: tuple[float, float] | None = _option(
        "Metres at 0 and at 255 in pictures of depth, which need it.",
        "NEAR FAR",
        nargs=2,
        type=float,
    )


class _Export(Topics, Latched, Forced, _Training):
    target: Path = argument(
        "File (mcap, bag) or directory (rosbag2, lerobot, mp4, tables).", "OUTPUT"
    )
    form: str | None = option(
        f"Without: by the suffix ({', '.join(suffixes_of(_LOGS))}). One of "
        f"{', '.join([*_LOGS, _LEROBOT, *_FILES])}.",
        "FORMAT",
        name="--format",
        short="-F",
        type=click.Choice([*_LOGS, _LEROBOT, *_FILES]),
    )
    no_attachments: bool = option("Leave out attachments; they are in MCAP files only.")
    split: str | None = option(
        "A file for each `recording`, each `mark`, or each interval in which a predicate "
        "holds: 'odom: twist.twist.linear.x > 0.1'. Their names follow that of the output.",
        "HOW",
        name="--split-by",
    )
    storage: str = option(
        "For rosbag2: the storage of the bag.",
        type=click.Choice(["mcap", "sqlite3"]),
        default="mcap",
        needs=("form=rosbag2",),
    )

    @property
    def front(self) -> Front:
        """The messages from before the range."""
        from hybridlog.formats.slices import Front

        return Front(latched=not self.no_latched, original_times=self.original_times)


@command(_Export)
def export_command(given: _Export) -> None:
    """Export whole recordings; tables get one file a topic.

    `lerobot` makes a training set for robot learning.
    """
    target, split = given.target, given.split
    if str(target) == "-":
        raise UsageError("export writes files; for a pipe: `hybridlog fetch '**' -F mcap -o -`.")
    form = given.form or form_of(target, suffixes_of(_LOGS))
    with given.opened(snapshot=True) as store:
        query = given.query(store)
        if not query.topics:
            raise UsageError(store.session.when_empty)
        if form == _LEROBOT:
            if split is not None:
                raise UsageError("lerobot has --episodes-by in place of --split-by.")
            _export_set(store, query, target, given)
            return
        parts = [(target, query)] if split is None else _pieces(query, split, target)
        for path, _ in parts if form in _LOGS else ():
            check_room(path, force=given.force)
        for path, one in parts:
            if form in _LOGS:
                _write_log(one, form, path, given)
            else:
                _write_tables(store, one, form, path, given)
            output.remarks(one.completeness().sentences)


def _write_log(query: Query, form: str, path: Path, given: _Export) -> None:
    from hybridlog.attachments import extras_of

    extras = extras_of(query.source.now(), query.question)
    if given.no_attachments:
        extras = extras._replace(attachments=[], left_out=0)
    settings = {"storage": given.storage} if form == "rosbag2" else {}
    write_answer(query, form, path, front=given.front, extras=extras, settings=settings)
    _print_written(path, query)
    if form == "mcap" or settings.get("storage") == "mcap":
        if extras.left_out:
            left_out = output.counted(extras.left_out, "attachment")
            output.note(f"{left_out} from behind the time range: left out.")
    elif extras.attachments or extras.metadata:
        output.note("A bag has no attachments and metadata records of the log; an MCAP file has.")


def _write_tables(store: Store, query: Query, form: str, directory: Path, given: _Export) -> None:
    """Write one file a topic, except topics that do not fit or have no message in the range."""
    from hybridlog.formats.writing import failures
    from hybridlog.query.planner import resolved
    from hybridlog.query.query import narrowed

    resolved(query.source.now(), query.question)  # refuses a range without any message
    topics: Sequence[str] = query.topics
    if OUTPUTS[form].content == "video":
        from hybridlog.arrays.message_arrays import IMAGES

        found = given.recordings_in(store).topics(*IMAGES)
        topics = [topic for topic in topics if topic in found]
        if not topics:
            raise UsageError("There is no topic of images or of video.")
    suffix = OUTPUTS[form].suffixes[0]
    paths = {topic: directory / f"{name}{suffix}" for topic, name in _names(topics).items()}
    for path in paths.values():
        check_room(path, force=given.force)
    left_out: list[HybridlogError] = []
    with failures(str(directory)):
        directory.mkdir(parents=True, exist_ok=True)
    for topic, path in paths.items():
        one = narrowed(query, topic)
        try:
            write_answer(one, form, path, front=given.front)
        except (DefinitionError, PayloadError, TimeError, UsageError) as error:
            output.note(f"{topic}: {error}")
            left_out.append(error)
            continue
        _print_written(path, one, topic)
        query.counters.add(one.counters)
    if len(left_out) == len(paths):
        with suppress(OSError):  # there are files in it
            directory.rmdir()
        raise left_out[0]


def _names(topics: Iterable[str]) -> dict[str, str]:
    """A name of a file for each topic; names that differ in their case alone get a number."""
    from hybridlog_storage.mongo.index_documents import collection_of

    found, seen = {}, Counter[str]()
    for topic in topics:
        name = collection_of(topic)
        seen[name.casefold()] += 1
        number = seen[name.casefold()]
        found[topic] = name if number == 1 else f"{name}~{number}"
    return found


def _print_written(path: Path, query: Query, topic: str = "") -> None:
    """Print a line about a file."""
    files = path.iterdir() if path.is_dir() else [path]
    size = output.size(sum(one.stat().st_size for one in files))
    many = output.counted(query.counters.messages - query.counters.reduced, "message")
    of = f" of {topic}" if topic else ""
    output.remarks([f"{path}: {many}{of}{latched(query.counters)}, {size}"])


def _pieces(query: Query, how: str, target: Path) -> list[tuple[Path, Query]]:
    """The parts of an answer that have messages, and where to write each; says which have none."""
    from hybridlog.query.pieces import pieces as split

    found: list[tuple[Path, Query]] = []
    for piece in split(query, how):
        with suppress(TimeError):  # the range is outside
            if piece.query.count():
                path = target.with_name(f"{target.stem}-{piece.name}{target.suffix}")
                found.append((path, piece.query))
                continue
        output.note(f"{piece.name}: no messages, so no file.")
    if not found:
        output.note("No messages, so no file.")
    return found


def _export_set(store: Store, query: Query, target: Path, given: _Export) -> None:
    """Write a training set, or propose a map for one."""
    if given.propose_map:
        from hybridlog.training.episodes import proposed

        check_room(target, force=given.force)
        write_bytes(target, proposed(query).to_yaml().encode())
        output.remarks([f"{target}: look at it, then add --map {target}."])
        return
    if given.features is None:
        raise UsageError(
            "Name a map with --map FILE. `hybridlog export map.yaml --format lerobot "
            "--propose-map` writes one to begin with."
        )
    done, counted = 0, output.counted
    with Bar(target.name) as bar:

        def tell(name: str, frames: int) -> None:
            nonlocal done
            done += frames
            bar(done, f"{name}: {counted(done, 'frame')}")

        report = store.to_lerobot(
            query,
            given.features,
            target,
            fps=given.fps,
            episodes_by=given.episodes_by,
            task=given.task,
            task_topic=given.task_topic,
            codec=given.vcodec,
            on_gap=given.on_gap,
            depth_scale=given.depth_scale,
            progress=tell,
        )
    about = (
        f"{target}: {counted(report.episodes, 'episode')}, "
        f"{counted(report.frames, 'frame')} at {given.fps} Hz, {output.size(report.bytes)}"
    )
    output.remarks([about])
    said = {
        "with a value older than usual": report.held,
        "left out, where a topic has a gap": report.dropped,
        "with an earlier picture, since its own cannot be shown": report.missing,
    }
    output.notes(f"{counted(number, 'frame')} {what}." for what, number in said.items() if number)
    if report.left_out:
        depths = ", ".join(report.left_out)
        output.note(f"Pictures of depth are left out without --depth-scale NEAR FAR: {depths}.")
    if report.lost:
        lost = f"{counted(report.lost, 'message')} of these topics are lost in the episodes"
        output.note(f"{lost}; meta/hybridlog.json says in which.")
