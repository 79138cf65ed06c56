"""`hybridlog tf`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from hybridlog.cli.answers import SCREEN, Tabular
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.completion import complete_frame
from hybridlog.cli.options import Strict, Topics, Verbose, topics
from hybridlog.cli.output import remarks, short_duration
from hybridlog.cli.render import Column, numbers, print_table
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import IncompleteError, UsageError

_MAX_TIMES = 10_000_000

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.query.times import TimeLike
    from hybridlog.tf.tree import FrameTree


@dataclass(frozen=True, kw_only=True)
class _Given(Strict, Verbose, Topics, Tabular):
    words: ClassVar[tuple[str, ...]] = ()  # type: ignore[misc]
    target: str | None = argument(
        "The frame of the results.", "[TARGET]", shell_complete=complete_frame
    )
    source: str | None = argument(
        "The frame to transform from; with -t, without, that of the topic's messages.",
        "[SOURCE]",
        shell_complete=complete_frame,
    )
    at: tuple[str, ...] = option(
        "At this time.", "TIME", needs=("target",), excludes=("step", "topic", "between")
    )
    step: str | None = option(
        "At regular times, such as 100ms.", "DURATION", needs=("target",), excludes=("topic",)
    )
    topic: tuple[str, ...] = topics(
        "At the header stamps of this topic, or the log times of one without."
    )
    extrapolate: str | None = option(
        "So long before its first and after its last, a transform holds; without, it does not.",
        "DURATION",
    )


@command(_Given)
def tf_command(given: _Given) -> None:
    """Show coordinate frames, or transforms between them.

    Without frames, the tree: how often each frame moves, and where its longest gap is. With
    two, where SOURCE is in TARGET: translation in m, rotation as quaternion and as roll,
    pitch and yaw in rad; by default at the latest time that has a transform. Rows of times
    without one are empty, and the reasons are printed.
    """
    target, source, topic = given.target, given.source, given.topic
    between = given.span if given.step or topic else given.between
    if target is None and (topic or between):
        raise UsageError("Times are those of a transform: name its TARGET and SOURCE frames.")
    from hybridlog.tf.reader import frames_and_stamps

    with given.opened(snapshot=True) as store:
        chosen = given.recordings_in(store)
        tree = store.tf(chosen.ids or None)
        if given.strict and tree.remarks:
            raise IncompleteError(" ".join(tree.remarks))
        if target is None:
            _show_tree(tree, given)
            return
        if not topic:
            stamps = _times(tree, given, between)
        else:
            query = given.bounded(chosen.topic(*topic))
            if len(query.topics) > 1:
                raise UsageError(f"Times are those of one topic, not of {listed(query.topics)}.")
            frames, stamps = frames_and_stamps(query.session, query.question, query.counters)
            if source is None and len(frames) == 1:
                source = frames[0]
        if source is None:
            raise UsageError("A transform has two frames: name TARGET and SOURCE.")
        found = tree.lookup(target, source, stamps, extrapolate=given.extrapolate)
        if len(found) == 1 and found.missing:
            tree.transform(target, source, int(stamps[0]), extrapolate=given.extrapolate)
        given.answer([found.to_arrow()])
        sys.stdout.flush()
        times = ((counted(n, "time"), why) for why, n in found.missing.items())
        missing = (f"{many} without a transform: {why}." for many, why in times)
        remarks((*missing, *tree.remarks))


def _times(
    tree: FrameTree, given: _Given, between: tuple[TimeLike, TimeLike | None] | None
) -> NDArray[np.int64]:
    """The times that are wanted, ns."""
    import numpy as np

    from hybridlog.query.times import parse_duration, parse_range, parse_time

    start, end = tree.span
    target, step = given.target or "", given.step
    if step is not None:
        low, high = parse_range(*(between or (None, None)), start=start, end=end)
        length = parse_duration(step)
        if not length or (high - low) // length >= _MAX_TIMES:
            raise UsageError(f"--step {step} would be more than {_MAX_TIMES:,} times.")
        return np.arange(low, high, length, dtype=np.int64)
    if between is not None:
        raise UsageError("--between needs --step or --topic.")
    if given.at:
        return np.array([parse_time(one, start=start, end=end) for one in given.at], np.int64)
    return np.array([tree.latest(target, given.source or target)], np.int64)


def _show_tree(tree: FrameTree, given: _Given) -> None:
    if given.to_form != SCREEN:
        given.answer([tree.to_arrow()])
        return
    names = ("transforms", "Hz", "longest gap", "from")
    rows = []
    for name, depth in tree.walk():
        row: dict[str, object] = {**dict.fromkeys(names), "frame": "  " * depth + name}
        if (frame := tree.frames.get(name)) is not None:
            row["transforms"] = "static" if frame.is_static else len(frame.stamps)
            row["Hz"] = None if frame.rate_hz is None else f"{frame.rate_hz:.2f}"
            if (gap := frame.longest_gap()) is not None:
                row["longest gap"] = short_duration(gap[1] - gap[0])
                row["from"] = f"{(gap[0] - tree.span[0]) / 1e9:+.3f}s"
        rows.append(row)
    print_table([Column("frame", side="whole"), *numbers(*names)], rows)
    remarks([*tree.problems(), *tree.remarks])
