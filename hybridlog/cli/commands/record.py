"""`hybridlog record`, and how it records log files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.options import command, parse_tags
from hybridlog.cli.record_choices import (
    RecordChoices,
    line_of,
    not_indexed,
    remarks_on,
    row_of,
    stored,
)
from hybridlog.cli.signals import watch
from hybridlog.wording import listed
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
    from hybridlog.record.recorder import RecordReport
    from hybridlog.store import Store


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
        """Tell, after a search, how many logs were recorded; returns the exit code."""
        counts = self._counts
        if self._is_search:
            many = output.counted(counts["recorded"], "log")
            left = f"{counts['known']} in the store already, {counts['error']} not recorded"
            output.remarks([f"{many} recorded, {left}."])
        return self.exit_code


def _between(source: Source, log: LogSet, given: tuple[str, str] | None) -> tuple[int, int] | None:
    """The range asked for, ns; refused if no time of the log lies in it."""
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
            f"{path} is damaged: {stored(entry.messages)}; "
            f"{coverage(entry, losses_of(entry))}; `hybridlog info --losses` says where."
        )
    if report.failure is not None:
        code = DatabaseError.exit_code
        output.note(f"hybridlog: {not_indexed(report)}")
    return code
