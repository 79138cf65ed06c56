"""`hybridlog tf`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, ClassVar

from hybridlog.cli.answers import SCREEN, Tabular
from hybridlog.cli.options import (
    Strict,
    Topics,
    argument,
    command,
    option,
    tf_topic,
    topics,
)
from hybridlog.cli.output import Column, print_table, remarks
from hybridlog.query.times import parse_duration, parse_range, parse_time
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import IncompleteError, UsageError
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.query.query import Query
    from hybridlog.tf.reader import Trees
    from hybridlog.tf.tree import FrameTree


_MAX_TIMES = 10_000_000


class _Tf(Strict, Topics, Tabular):
    words: ClassVar[tuple[str, ...]] = ()  # type: ignore[misc]
    target: str | None = argument("The frame of the results.", "[TARGET]")
    source: str | None = argument(
        "The frame to transform from; with -t, without, that of the topic's messages.",
        "[SOURCE]",
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
    tf_topic: tuple[str, ...] = tf_topic()


@command(_Tf)
def tf_command(given: _Tf) -> None:
    """Show coordinate frames, or transforms between them.

    Without frames, the trees: how often each frame moves, and where its longest gap is. With
    two, where SOURCE is in TARGET: translation in m, rotation as quaternion and as roll,
    pitch and yaw in rad; by default at the latest time that has a transform. Rows of times
    without one are empty, and the reasons are printed.
    """
    if given.target is None and (given.topic or given.topic_type or given.between):
        raise UsageError("Times are those of a transform: name its TARGET and SOURCE frames.")
    from hybridlog.tf.reader import Trees

    with given.opened(snapshot=True) as store:
        chosen = given.recordings_in(store).check()
        topics = given.named(store)
        query = given.bounded(chosen.topic(*topics)) if topics else None
        if query is not None and len(query.topics) > 1:
            raise UsageError(f"Times are those of one topic, not of {listed(query.topics)}.")
        only = chosen.topic(*given.tf_topic).topics if given.tf_topic else ()
        trees = Trees(store.session, chosen.summaries, only)
        names = [topics[0] for topics in trees.topics.values()]
        if given.target is not None or not names:
            names = [] if query is None else [*query.topics]
        shown = {name: trees.tree(name) for name in names} or {"": trees.tree()}
        lacks = [*dict.fromkeys(text for tree in shown.values() for text in tree.remarks)]
        if given.strict and lacks:
            raise IncompleteError(" ".join(lacks))
        if given.target is None:
            _show_trees(shown, given)
        else:
            _show_transforms(given, given.target, trees, query)
        remarks(lacks)


def _show_transforms(given: _Tf, target: str, trees: Trees, query: Query | None) -> None:
    from hybridlog.tf.reader import frames_and_stamps

    source = given.source
    topic = None if query is None else query.topics[0]
    tree = trees.tree(topic)
    if query is None:
        stamps = _times(tree, given, target)
        log_time = 0 * stamps + END  # of the last epoch
    else:
        asked = query.source.now(), query.question, query.counters
        frames, stamps, log_time = frames_and_stamps(*asked)
        source = source or (frames[0] if len(frames) == 1 and frames[0] else None)
    if source is None:
        raise UsageError("A transform has two frames: name TARGET and SOURCE.")
    shown = slice(given.limit)  # reasons are about the rows that are given
    found = trees.lookup(topic, target, source, stamps[shown], log_time[shown])
    if len(stamps) == len(found) == 1 and found.missing:
        tree.transform(target, source, int(stamps[0]))
    given.answer([found.to_arrow()])
    sys.stdout.flush()
    remarks(
        f"{counted(number, 'time')} without a transform: {why}."
        for why, number in found.missing.items()
    )


def _times(tree: FrameTree, given: _Tf, target: str) -> NDArray[np.int64]:
    """The times that are wanted, ns."""
    import numpy as np

    start, end = tree.span
    if given.step is not None:
        low, high = parse_range(*(given.span or (None, None)), start=start, end=end)
        length = parse_duration(given.step)
        if not length or (high - low) // length >= _MAX_TIMES:
            raise UsageError(f"--step {given.step} would be more than {_MAX_TIMES:,} times.")
        return np.arange(low, high, length, dtype=np.int64)
    if given.between is not None:
        raise UsageError("--between needs --step or --topic.")
    times = [parse_time(one, start=start, end=end) for one in given.at]
    return np.array(times or [tree.latest(target, given.source or target)], np.int64)


def _show_trees(trees: Mapping[str, FrameTree], given: _Tf) -> None:
    """Show the frames of trees, by a topic of each, which is a column if there are several."""
    import pyarrow as pa

    if given.to_form != SCREEN:
        tables = ((name, tree.to_arrow()) for name, tree in trees.items())
        given.answer(
            [one.add_column(0, "tree", pa.array([name] * len(one), "str")) for name, one in tables]
        )
        return
    frames = (
        (topic, "  " * depth + name, tree.frames.get(name), tree.span[0])
        for topic, tree in trees.items()
        for name, depth in tree.walk()
    )
    rows = [(*row, row[2] and row[2].longest_gap()) for row in frames]
    print_table(_FRAMES[len(trees) == 1 :], rows)
    remarks(dict.fromkeys(text for tree in trees.values() for text in tree.problems()))


_FRAMES = [
    Column("tree", 0),
    Column("frame", 1),
    Column(
        "transforms",
        lambda row: row[2] and ("static" if row[2].is_static else len(row[2].stamps)),
        "number",
    ),
    Column("Hz", lambda row: row[2] and row[2].rate_hz, "rate"),
    Column("longest gap", lambda row: row[4] and row[4][1] - row[4][0], "duration"),
    Column("from", lambda row: row[4] and f"{(row[4][0] - row[3]) / 1e9:+.3f}s", "number"),
]
