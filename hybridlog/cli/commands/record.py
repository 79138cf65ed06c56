"""`hybridlog record`: its options, how it records logs, and what it tells of each recording."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import click
from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.options import (
    SECONDS,
    SIZE,
    SOME_SECONDS,
    Amount,
    AsJson,
    Between,
    InStore,
    Latched,
    Quiet,
    argument,
    command,
    option,
    parse_seconds,
    parse_tags,
)
from hybridlog.cli.signals import watch
from hybridlog.wording import listed, parse_size
from hybridlog_storage.errors import (
    AlreadyRecordedError,
    DatabaseError,
    HybridlogError,
    SourceDamagedError,
    SourceError,
    TimeError,
    UsageError,
)
from hybridlog_storage.stopping import at_safe_points, safe_point

if TYPE_CHECKING:
    from hybridlog.formats.find import Watch
    from hybridlog.formats.log_set import LogSet
    from hybridlog.formats.reading import Source
    from hybridlog.query.topics import TopicMatcher
    from hybridlog.record.recorder import RecordReport
    from hybridlog.store import Store
    from hybridlog_storage.segments.segment_writer import SegmentSettings

_CHUNK: Final = 2 << 20
"""Bytes of a chunk."""
ENVIRONMENT_MASTER: Final = "ROS_MASTER_URI"
"""The master of ROS 1 that is meant without a URI."""
_LIVE: Final = ("ros1", "ros2", "foxglove", "replay")
"""Parameters that name a source of live messages."""
_OF_LOGS: Final = ("paths", "between", "again", "watch", "no_latched", "original_times")


def _live(help: str, metavar: str | None = None, **settings: Any) -> Any:  # noqa: A002
    """An option for live recording."""
    return option(help, metavar, **{"needs": _LIVE, "section": "Live recording", **settings})


class RecordChoices(Between, Latched, InStore, AsJson, Quiet):
    """The parameters as typed."""

    paths: tuple[Path, ...] = argument(
        "ROS 1 bags, ROS 2 bags (files or directories), MCAP files, and directories with any "
        "of them.",
        "[PATH]...",
    )
    topics: tuple[str, ...] = option(
        "Only these: name, glob, or re:REGEX.", "TOPIC", name="--topic", short="-t"
    )
    exclude: tuple[str, ...] = option("Not these.", "TOPIC", short="-x")
    no_index: tuple[str, ...] = option(
        "No documents in MongoDB for these: questions about them read tables.", "TOPIC"
    )
    name: str | None = option("Name of the recording; without, the file's.", "NAME")
    again: bool = option("Record it even if its content is in the store.")
    watch: bool = option(
        "Go on recording logs that come into the directories, when they are complete, until "
        "Ctrl-C.",
        excludes=("name",),
    )
    settle: float = option(
        "With --watch: a file that does not say so is complete when unchanged for this time.",
        "TIME",
        type=SECONDS,
        default="60s",
        needs=("watch",),
    )
    compression: str = option(
        "Compression of chunks.", type=click.Choice(["zstd", "lz4", "none"]), default="zstd"
    )
    level: int = option("zstd level, 1 to 19.", "N", type=click.IntRange(1, 19), default=3)
    ros1: str | None = option(
        "Record a running ROS 1 robot; the URI of a master may follow, else ROS_MASTER_URI "
        "names it.",
        "[URI]",
        is_flag=False,
        flag_value=ENVIRONMENT_MASTER,
        excludes=_OF_LOGS,
    )
    ros2: bool = option("Record a running ROS 2 robot; needs rclpy.", excludes=_OF_LOGS)
    foxglove: str | None = option(
        "Record what a Foxglove WebSocket server sends.", "URL", excludes=_OF_LOGS
    )
    replay: Path | None = option(
        "Play a log at the speed of a robot, and record that.", "FILE", excludes=_OF_LOGS
    )
    speed: float = _live(
        "With --replay: N times as fast.",
        "N",
        type=click.FloatRange(min=0.01),
        default=1.0,
        needs=("replay",),
    )
    duration: float | None = _live("Stop after this time, such as 10m.", "TIME", type=SOME_SECONDS)
    max_messages: int | None = _live(
        "Stop after this number of messages.", "N", type=click.IntRange(min=1)
    )
    split_size: int = _live(
        "Start a new segment file after this size.",
        "SIZE",
        type=Amount(parse_size, "1MiB"),
        default="1GiB",
    )
    split_duration: float = _live(
        "Start a new segment file after this time.", "TIME", type=SOME_SECONDS, default="10m"
    )
    use_sim_time: bool = _live("Log times are those of /clock, the time of a simulation.")
    throttle: tuple[tuple[str, str], ...] = _live(
        "At most this rate of messages, such as /camera 5Hz.",
        "TOPIC RATE",
        nargs=2,
    )
    priority: tuple[tuple[str, str], ...] = _live(
        "low, normal or high: when more arrives than can be written, payloads of the lowest "
        "priority are dropped first.",
        "TOPIC WORD",
        nargs=2,
    )
    budget: int | None = _live(
        "Size of payloads in memory; without, a sixteenth of all memory.",
        "SIZE",
        type=Amount(parse_size, "1MiB"),
    )
    reserve: int = _live(
        "Stop when the disk has less than this free.", "SIZE", type=SIZE, default="1GB"
    )
    flush_interval: float = _live(
        "The most that a killed recorder can lose.",
        "TIME",
        type=Amount(parse_seconds, "1ns", "1h"),
        default="1s",
    )
    ring: float | None = _live(
        "Keep only the last TIME, and what is pinned.",
        "TIME",
        type=Amount(parse_seconds, "1ns", "24h"),
        excludes=("use_sim_time", "contract"),
    )
    trigger: tuple[str, ...] = _live(
        "Mark and pin what is around such a message: '/diagnostics: status[*].level >= 2'.",
        "TOPIC: PREDICATE",
    )
    before: float | None = _live(
        "Pin so much before a trigger or SIGUSR1; without, all that the ring has.",
        "TIME",
        type=Amount(parse_seconds, most="24h"),
    )
    after: float | None = _live(
        "Pin so much after it.", "TIME", type=Amount(parse_seconds, most="24h")
    )
    contract: Path | None = _live(
        "Tell and mark topics that are silent for longer than the rules in this file allow, "
        "and judge the recording at its end.",
        "FILE",
    )
    no_derive: bool = _live(
        "Make no tables and no index now: a later command does.",
        excludes=("ring", "trigger", "contract"),
    )
    set_tag: tuple[str, ...] = option("Store KEY=VALUE with it.", "K=V")

    @property
    def is_live(self) -> bool:
        """True when a source of live messages is given."""
        return self.ros2 or (self.ros1, self.foxglove, self.replay) != (None, None, None)

    def check(self) -> None:
        """Refuse parameters that do not fit together."""
        if self.ros1 is not None and not self.ros1.strip():
            raise UsageError("A ROS master's URI looks like http://host:11311; this one is empty.")
        if not self.paths and not self.is_live:
            raise UsageError(
                "Nothing to record: give a log, or --ros1, --ros2, --foxglove URL or --replay FILE."
            )
        for path in self.paths if self.watch else ():
            if not path.is_dir():
                raise UsageError(f"--watch takes directories, and {path} is none.")

    def matchers(self) -> tuple[TopicMatcher | None, TopicMatcher | None]:
        """Matchers of topics and of those without documents; new at each call, since they count."""
        from hybridlog.query.topics import matcher

        chosen = matcher(self.topics, self.exclude) if self.topics or self.exclude else None
        return chosen, matcher(self.no_index) if self.no_index else None

    def segment_settings(self, chunk_size: int = _CHUNK) -> SegmentSettings:
        """Chunks and compression."""
        from hybridlog_storage.segments.segment_writer import SegmentSettings

        form = cast("Any", self.compression)
        return SegmentSettings(chunk_size=chunk_size, compression=form, level=self.level)


@command(RecordChoices)
def record_command(choices: RecordChoices) -> int:
    """Record logs, or a running robot, into the store.

    Each path becomes a recording: a ROS 1 bag, a ROS 2 bag (its directory or one file), an
    MCAP file. All logs below a directory are recorded. Content that is in the store already is
    refused unless --again, or left out below a directory. The readable part of a damaged log is
    stored, and the rest is reported.

    With --ros1, --ros2, --foxglove or --replay, messages are recorded as they arrive, until
    Ctrl-C. Lost messages are counted: see `hybridlog info --losses`. Options under
    "Live recording" are for this.
    """
    choices.check()
    if choices.is_live:
        from hybridlog.cli.record_live import record_live

        return record_live(choices)
    return _record_watched(choices) if choices.watch else _record_logs(choices)


def _record_logs(choices: RecordChoices) -> int:
    """Record each path, and each log below a directory; an error does not stop the others."""
    from hybridlog.formats.find import find_logs
    from hybridlog.formats.log_set import LogSet

    logs: list[LogSet] = []
    problems: list[SourceError] = []
    for path in choices.paths:
        found = find_logs(path) if path.is_dir() else None
        if found is None or not found.logs or found.is_one_log(path):
            logs.append(LogSet.at(path))
        else:
            logs += found.logs
            problems += found.problems
    is_search = len(logs) > len(choices.paths) or any(log.path not in choices.paths for log in logs)
    if choices.name is not None and len(logs) != 1:
        raise UsageError(f"--name names one recording; there are {len(logs)} logs.")
    # Wrong options are found before a store is made.
    recorder = _LogRecorder(choices, is_search=is_search)
    if logs and not (logs := recorder.begin(logs)):
        return recorder.exit_code
    total, before = sum(log.size for log in logs), 0

    def show(name: str, read: int, messages: int) -> None:
        bar(before + read, f"{name}: {output.counted(messages, 'message')}")

    with (
        choices.opened(create=True, records=True) as store,
        at_safe_points(),
        output.Bar("record", total) as bar,
    ):
        for problem in problems:
            recorder.fail(problem)
        for log in logs:
            safe_point()
            recorder.record(store, log, partial(show, log.path.name))
            before += log.size
    return recorder.end()


def _record_watched(choices: RecordChoices) -> int:
    """Record what lies in directories, and what comes into them, until a signal ends it."""
    from hybridlog.formats.find import Watch

    recorder = _LogRecorder(choices, is_search=True)
    recorder.begin(())
    watches = [Watch(path, choices.settle) for path in choices.paths]
    with choices.opened(create=True, records=True) as store:
        places = ", ".join(map(str, choices.paths))
        watch(places, partial(_look, recorder, store, watches), report=recorder.fail)
        if left := [path for one in watches for path in one.unfinished]:
            paths = listed(map(str, left))
            output.note(f"Not complete: {paths}. `hybridlog record PATH` records what is there.")
    return recorder.end()


def _look(recorder: _LogRecorder, store: Store, watches: Sequence[Watch]) -> Iterator[SourceError]:
    """Record logs that have become complete; yields what cannot be read."""
    for one in watches:
        try:
            found = one.look()
        except SourceError as error:  # the directory may come back
            yield error
            continue
        yield from found.problems
        for place, log in enumerate(found.logs):
            safe_point()
            try:
                recorder.record(store, log, lambda _read, _messages: None)
            except HybridlogError:  # these are tried again
                one.put_back(found.logs[place:])
                raise


class _LogRecorder:
    """Records logs with the options of the command, and tells at once what came of each."""

    def __init__(self, choices: RecordChoices, *, is_search: bool) -> None:
        self._choices = choices
        self._settings, self._tags = choices.segment_settings(), parse_tags(choices.set_tag)
        choices.matchers()
        self._is_search = is_search
        self._counts: Counter[str] = Counter()  # of what came of logs
        self.exit_code = 0

    def begin(self, logs: Sequence[LogSet]) -> list[LogSet]:
        """The logs without those in front that cannot be read: for them no store is made."""
        from hybridlog.store import store_path
        from hybridlog_storage.settings import NAME, is_uri, with_password

        left, uri = [*logs], self._choices.mongo
        if os.path.lexists(store_path(self._choices.store) / NAME):
            return left
        while left:
            try:
                left[0].open().close()
                break
            except SourceError as error:
                self.fail(error, left.pop(0).path)
        if is_uri(uri) and (left or not logs):
            # The new store stores the URI, so it has to be right.
            from hybridlog_storage.mongo.database import Database
            from hybridlog_storage.mongo.index_documents import IndexState, other_store

            with Database.connect(with_password(uri)) as database:
                if IndexState(database).owner() is not None:
                    raise other_store(database)
        return left

    def record(self, store: Store, log: LogSet, progress: Callable[[int, int], None]) -> None:
        """Record a log, or the parts that the store lacks."""
        for piece in self._pieces(store, log):
            try:
                report = self._record_one(store, piece, progress)
            except (AlreadyRecordedError, SourceError, UsageError) as error:
                if self._is_search and isinstance(error, AlreadyRecordedError):
                    self._tell("known", {"path": str(piece.path), "known": str(error)})
                else:
                    self.fail(error, piece.path)
                continue
            self.exit_code = self.exit_code or _remark(piece.path, report)
            row = row_of(report, piece.path)
            self._tell("recorded", row, [line_of(row)])

    def _pieces(self, store: Store, log: LogSet) -> list[LogSet]:
        """The log; in a search, each file of it if some were recorded on their own."""
        from hybridlog.formats.log_set import LogSet
        from hybridlog.formats.reading import fingerprint

        if self._is_search and not self._choices.again and len(log.files) > 1:
            find = store.session.snapshot().by_fingerprint.get
            with suppress(SourceError):  # which is told when it is recorded
                prints = fingerprint(log.files)
                if find(prints.whole) is None and any(map(find, prints.parts)):
                    return [*map(LogSet.at, log.files)]
        return [log]

    def _record_one(
        self, store: Store, log: LogSet, progress: Callable[[int, int], None]
    ) -> RecordReport:
        from hybridlog.record.recorder import RecordOptions

        choices = self._choices
        matcher, no_index = choices.matchers()
        with log.open() as source:
            options = RecordOptions(
                name=choices.name or log.name,
                tags=self._tags,
                matcher=matcher,
                between=_between(source, log, choices.between),
                latched=not choices.no_latched,
                original_times=choices.original_times,
                again=choices.again,
                settings=self._settings,
                no_index=no_index,
            )
            report = store.record(source, options, progress)
        for pattern in (text for one in (matcher, no_index) if one for text in one.unused()):
            output.note(f"{log.path}: no topic fits {output.quoted(pattern)}.")
        return report

    def fail(self, error: HybridlogError, path: Path | None = None) -> None:
        """Tell an error."""
        about = {} if path is None else {"path": str(path)}
        self._tell("error", {**about, "error": str(error), "exit_code": error.exit_code})
        output.note(f"hybridlog: {error}")
        self.exit_code = self.exit_code or error.exit_code

    def _tell(self, what: str, row: dict[str, Any], lines: Sequence[str] = ()) -> None:
        self._counts[what] += 1
        output.tell(row, lines, at_once=True)

    def end(self) -> int:
        """Say of a search what became of its logs; gives the exit code."""
        counts = self._counts
        if self._is_search:
            many = output.counted(counts["recorded"], "log")
            left = f"{counts['known']} in the store already, {counts['error']} not recorded"
            output.remarks([f"{many} recorded, {left}."])
        return self.exit_code


def _between(source: Source, log: LogSet, given: tuple[str, str] | None) -> tuple[int, int] | None:
    """The range, in which the log has some time."""
    from hybridlog.query.times import format_time, parse_range

    if given is None:
        return None
    source.time_range = source.time_range or log.read_time_range()
    start, end = source.time_range or (None, None)
    low, high = parse_range(*given, start=start, end=end)
    if start is None or end is None or low >= end or high <= start:
        asked, span = (low, high), (start or 0, (end or 1) - 1)
        (begin, to), (first, last) = (map(format_time, pair) for pair in (asked, span))
        raise TimeError(
            f"{source.path} has no message from {begin} up to {to}; it spans {first} to {last}."
        )
    return low, high


def _remark(path: Path, report: RecordReport) -> int:
    """Print what is odd about a recording; returns the exit code."""
    from hybridlog.query.answers.completeness import coverage
    from hybridlog.record.losses import losses_of

    entry, code = report.entry, 0
    if report.latched_left_out:
        left = output.counted(report.latched_left_out, "latched message")
        output.note(f"{path}: {left} from before the time range did not fit in memory.")
    output.remarks((*remarks_on(report), *report.remarks))
    if report.damage:
        code = SourceDamagedError.exit_code
        output.note(
            f"{path} is damaged: {_stored(entry.messages)}; "
            f"{coverage(entry, losses_of(entry))}; `hybridlog info --losses` says where."
        )
    if report.failure is not None:
        code = DatabaseError.exit_code
        output.note(f"hybridlog: {not_indexed(report)}")
    return code


def row_of(report: RecordReport, path: object) -> dict[str, Any]:
    """A recorded log as a row of JSON: that of `ls`, and what came of the log."""
    from hybridlog.cli.commands.ls import recording_dict
    from hybridlog.entries import summary_of
    from hybridlog.record.losses import losses_of

    entry = report.entry
    stats = [channel.stats for channel in entry.channels]
    return {
        "path": str(path),
        **recording_dict(summary_of(entry)),
        "messages_indexed": report.indexed,
        "messages_unreadable": sum(one.unreadable for one in stats),
        "messages_surplus": sum(one.surplus for one in stats),
        "messages_skipped": report.skipped,
        "messages_latched": report.latched,
        "attachments": entry.attachments,
        "attachments_left_out": report.attachments_left_out,
        "metadata_records": entry.metadata_records,
        # A live source has no size of its own.
        "bytes_in": entry.manifest.source.bytes or sum(one.payload_bytes for one in stats),
        "seconds": round(report.elapsed_s, 3),
        "losses": losses_of(entry),
        "damage": [{**asdict(d), "file": str(d.file)} for d in report.damage],
        "not_indexed": {
            c.topic: report.not_indexed[c.id] for c in entry.channels if c.id in report.not_indexed
        },
    }


def line_of(row: Mapping[str, Any]) -> str:
    """A recorded log in a line, without counts of zero."""
    more = (("skipped", "left out"), ("latched", "from before"))
    told = [
        output.counted(row["messages"], "message"),
        output.size(row["stored_bytes"]),
        *(f"{row[f'messages_{key}']} {what}" for key, what in more if row[f"messages_{key}"]),
        *([f"{row['attachments']} attachments"] if row["attachments"] else ()),
        f"from {row['path']}",
    ]
    return f"{row['name']}: {', '.join(told)}"


def remarks_on(report: RecordReport) -> Iterator[str]:
    """A line for each topic with messages whose fields are not all there, or not all they hold."""
    for channel in report.entry.channels:
        unreadable, surplus = channel.stats.unreadable, channel.stats.surplus
        if channel.is_indexed and channel.id in report.not_indexed:
            yield f"{channel.topic}: not indexed beyond time: {report.not_indexed[channel.id]}"
        if unreadable:
            unfit = output.unfit(unreadable)
            yield f"{channel.topic}: {unfit}, or the index; stored, without fields in it"
        if surplus:
            yield (
                f"{channel.topic}: {output.counted(surplus, 'message')} with bytes left over "
                "behind the last field; the fields are read"
            )


def not_indexed(report: RecordReport) -> str:
    """The sentence about messages that the index lacks, because it failed."""
    return (
        f"{report.failure} {_stored(report.missed)} but not in the index; the next command that "
        "opens the store catches up."
    )


def _stored(messages: int) -> str:
    """A number of stored messages: `1 message is stored`."""
    return f"{output.counted(messages, 'message')} {'is' if messages == 1 else 'are'} stored"
