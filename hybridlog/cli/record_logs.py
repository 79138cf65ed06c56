"""`hybridlog record` of log files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.commands.ls import with_misfits
from hybridlog.cli.options import parse_tags
from hybridlog.cli.progress import Bar
from hybridlog.cli.record_choices import RecordChoices
from hybridlog.cli.record_summary import COLUMNS, fields_of, remarks_on, row_of
from hybridlog.cli.render import print_fields, print_table
from hybridlog.cli.signals import if_stopped
from hybridlog.cli.watching import watch
from hybridlog.query.answers.lost import coverage
from hybridlog.record.losses import losses_of
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
from hybridlog_storage.stopping import anywhere, at_safe_points, safe_point

if TYPE_CHECKING:
    from hybridlog.formats.find import Found, Watch
    from hybridlog.formats.log_set import LogSet
    from hybridlog.formats.reading import Source
    from hybridlog.record.recorder import RecordReport
    from hybridlog.store import Store


def record_logs(choices: RecordChoices) -> int:
    """Record each path, and each log below a directory; an error does not stop the others."""
    logs, walked = _find(choices)
    if choices.name is not None and len(logs) > 1:
        raise UsageError(f"--name names one recording; there are {len(logs)} logs.")
    # Wrong options are found before a store is made.
    recorder = LogRecorder(choices, logs, is_search=walked is not None)
    total, before = sum(log.size for log in logs), 0
    with (
        recorder.opened() as store,
        at_safe_points(),
        Bar(logs[0].path.name if len(logs) == 1 else f"{len(logs)} logs", total) as bar,
    ):
        for problem in walked.problems if walked is not None else ():
            recorder.fail(None, problem)
        for log in logs:
            safe_point()
            # A single one needs no name beside the bar.
            name = f"{log.path.name}: " if len(logs) > 1 else ""
            recorder.record(store, log, partial(_shown, bar, before, name))
            before += log.size
    return recorder.exit_code


def record_watched(choices: RecordChoices) -> int:
    """Record what lies in directories, and what comes into them, until a signal ends it."""
    from hybridlog.formats.find import Watch

    recorder = LogRecorder(choices, (), is_search=True)
    watches = [Watch(path, choices.settle) for path in choices.paths]
    with recorder.opened() as store:
        look = partial(_look, recorder, store, watches, set[Path]())
        places = ", ".join(map(str, choices.paths))
        watch(places, look, report=partial(recorder.fail, None))
        left = [path for one in watches for path in one.unfinished()]
        if left:
            paths = listed(map(str, left))
            output.note(f"Not complete: {paths}. `hybridlog record PATH` records what is there.")
    return recorder.exit_code


def _look(
    recorder: LogRecorder, store: Store, watches: Sequence[Watch], met: set[Path]
) -> Iterator[SourceError]:
    """Record logs that have become complete; yields what cannot be read."""
    for one in watches:
        try:
            found = one.look()
        except SourceError as error:  # the directory may come back
            yield error
            continue
        print_stores(path for path in found.stores if path not in met)
        met.update(found.stores)
        yield from found.problems
        for place, log in enumerate(found.logs):
            safe_point()
            try:
                recorder.record(store, log, lambda _read, _messages: None)
            except HybridlogError:  # these are tried again
                for left in found.logs[place:]:
                    one.put_back(left)
                raise


def _find(choices: RecordChoices) -> tuple[list[LogSet], Found | None]:
    """The logs to record, and what was met in directories; None if each path is one log."""
    from hybridlog.formats.find import Found, find_logs
    from hybridlog.formats.log_set import LogSet

    logs: list[LogSet] = []
    walked: Found | None = None
    for path in choices.paths:
        found = find_logs(path) if path.is_dir() else Found()
        print_stores(found.stores)
        is_one = len(found.logs) == 1 and path in {found.logs[0].path, found.logs[0].path.parent}
        if is_one or not found.logs:
            logs.append(LogSet.at(path))
            continue
        walked = walked or Found()
        logs += found.logs
        walked.problems += found.problems
    return logs, walked


def print_stores(stores: Iterable[Path]) -> None:
    """Print which stores were met and not searched."""
    for store in stores:
        output.note(
            f"{store} is a store and is not searched; `hybridlog copy --from {store}` takes its "
            "recordings."
        )


def _shown(bar: Bar, before: int, name: str, read: int, messages: int) -> None:
    bar(before + read, f"{name}{output.counted(messages, 'message')}")


def _check_new_store(choices: RecordChoices, logs: Sequence[LogSet]) -> None:
    """Fail before a store is made, when no log can be read or the server does not answer."""
    from hybridlog.store import store_path
    from hybridlog_storage.settings import NAME, is_uri, with_password

    settings = store_path(choices.store) / NAME
    if os.path.lexists(settings):
        return
    problem: SourceError | None = None
    for log in logs:
        try:
            log.open().close()
            break
        except SourceError as error:
            problem = problem or error
    else:
        if problem is not None:
            raise problem
    if is_uri(choices.mongo):
        # The new store stores the URI, so it has to be right.
        from hybridlog_storage.mongo.database import Database
        from hybridlog_storage.mongo.index_state import IndexState, other_store

        with Database.connect(with_password(choices.mongo)) as database:
            owner = IndexState(database).owner()
            if owner is not None and not os.path.lexists(settings):  # nobody made it meanwhile
                raise other_store(database)


def _between(source: Source, log: LogSet, choices: RecordChoices) -> tuple[int, int] | None:
    from hybridlog.query.times import is_relative, parse_range

    if choices.between is None:
        return None
    if source.time_range is None and any(map(is_relative, choices.between)):
        source.time_range = log.read_time_range()
    start, end = source.time_range or (None, None)
    return parse_range(*choices.between, start=start, end=end)


class LogRecorder:
    """Records logs with the options of the command; what came of them is told at the end."""

    def __init__(self, choices: RecordChoices, logs: Sequence[LogSet], *, is_search: bool) -> None:
        self._choices = choices
        self._settings = choices.segment_settings()
        self._tags = parse_tags(choices.set_tag)
        choices.matchers()
        self._logs, self._is_search = logs, is_search
        self._left = [log.path for log in logs]
        self._counts: Counter[str] = Counter()  # of what came of logs
        self.exit_code = 0
        self._rows: list[dict[str, Any]] = []  # those that are shown at the end

    @contextmanager
    def opened(self) -> Iterator[Store]:
        """The store; at the end the results are shown."""
        _check_new_store(self._choices, self._logs)
        try:
            with if_stopped(self._on_stop), self._choices.opened_to_record() as store:
                yield store
        finally:
            self._show()

    def record(self, store: Store, log: LogSet, progress: Callable[[int, int], None]) -> None:
        """Record a log, or the parts that the store lacks; raises if the only log cannot be."""
        if not self._logs:
            self._left = [log.path]
        for piece in self._pieces(store, log):
            try:
                report = self._record_one(store, piece, progress)
            except AlreadyRecordedError as error:
                if self._is_search:
                    self._tell({"path": str(piece.path), "known": str(error)}, "known")
                else:
                    self.fail(piece.path, error)
            except (SourceError, UsageError) as error:
                self.fail(piece.path, error)
            else:
                report.entry = entry = with_misfits(store, report.entry)
                code = _told(piece.path, report)
                self.exit_code = self.exit_code or code
                many = output.counted(entry.messages, "message")
                about = f"{many}, {output.size(entry.stored_bytes)}, from {piece.path}"
                self._tell(row_of(report, piece.path), "recorded", [f"{entry.name}: {about}"])
        self._left.remove(log.path)

    def _pieces(self, store: Store, log: LogSet) -> Iterator[LogSet]:
        """The log; in a search, the missing parts of it if others were recorded on their own."""
        from hybridlog.formats.log_set import LogSet
        from hybridlog.formats.reading import fingerprint

        missing: list[Path] = []
        if self._is_search and not self._choices.again and len(log.files) > 1:
            find = store.session.snapshot().by_fingerprint.get
            with suppress(SourceError):  # which is told when it is recorded
                prints = fingerprint(log.files)
                if find(prints.whole) is None:
                    of_files = zip(log.files, prints.parts, strict=True)
                    missing = [file for file, part in of_files if find(part) is None]
        is_whole = not missing or len(missing) == len(log.files)
        yield from [log] if is_whole else map(LogSet.at, missing)

    def _record_one(
        self, store: Store, log: LogSet, progress: Callable[[int, int], None]
    ) -> RecordReport:
        from hybridlog.query.times import format_time
        from hybridlog.record.recorder import RecordOptions

        choices = self._choices
        with anywhere():
            source = log.open()
        with source:
            matcher, no_index = choices.matchers()
            options = RecordOptions(
                name=choices.name or log.name,
                tags=self._tags,
                matcher=matcher,
                between=_between(source, log, choices),
                latched=not choices.no_latched,
                original_times=choices.original_times,
                again=choices.again,
                settings=self._settings,
                no_index=no_index,
            )
            report = store.record(source, options, progress)
            is_empty = report.entry.messages == report.latched
            if options.between is not None and is_empty and report.skipped + report.latched:
                store.refresh()
                store.remove(report.entry.id)
                low, high = map(format_time, options.between)
                spans = ""
                if source.time_range is not None:
                    start, end = source.time_range
                    spans = f"; it spans {format_time(start)} to {format_time(end - 1)}"
                raise TimeError(f"{source.path} has no message from {low} up to {high}{spans}.")
        for pattern in (p for one in (matcher, no_index) if one is not None for p in one.unused()):
            output.note(f"{log.path}: no topic fits {output.quoted(pattern)}.")
        return report

    def fail(self, path: Path | None, error: HybridlogError) -> None:
        """Add an error; that of the only log is raised."""
        if len(self._logs) == 1 and not self._is_search:
            raise error
        output.note(f"hybridlog: {error}")
        self.exit_code = self.exit_code or error.exit_code
        about = {} if path is None else {"path": str(path)}
        self._tell({**about, "error": str(error), "exit_code": error.exit_code}, "error")

    def _tell(self, row: dict[str, Any], what: str, lines: Sequence[str] = ()) -> None:
        """Show what came of a log: at the end; at once while directories are watched."""
        self._counts[what] += 1
        if self._logs:
            self._rows.append(row)
        else:
            output.tell(row, lines, at_once=True)

    def _on_stop(self) -> str:
        """The effect of stopping now on the recordings."""
        left, stored, parts = self._left, self._counts["recorded"], []
        if left:
            what = left[0] if len(left) == 1 else output.counted(len(left), "log")
            parts.append(f"Nothing of {what} is stored.")
        if stored:
            before = " before" if left else ""
            parts.append(f"{output.counted(stored, 'recording')} stored{before}.")
        return " ".join(parts)

    def _show(self) -> None:
        """Print the finished recordings, and what became of the others."""
        counts = self._counts
        if self._choices.as_json and self._rows:
            output.print_json(self._rows)
        elif not self._choices.as_json and not output.is_quiet():
            recorded = [row for row in self._rows if "messages" in row]
            if len(recorded) == 1:
                print_fields(fields_of(recorded[0]))
            else:
                print_table(COLUMNS, recorded)
        if self._is_search:
            many = output.counted(counts["recorded"], "log")
            left = f"{counts['known']} in the store already, {counts['error']} not recorded"
            output.remarks([f"{many} recorded, {left}."])


def _told(path: Path, report: RecordReport) -> int:
    """Print what is odd about a recording; returns the exit code."""
    if report.latched_left_out:
        output.note(
            f"{path}: {output.counted(report.latched_left_out, 'latched message')} from before "
            "the time range did not fit in memory."
        )
    output.remarks((*remarks_on(report.entry), *report.remarks))
    code = 0
    if report.damage:
        entry, code = report.entry, SourceDamagedError.exit_code
        output.note(
            f"{path} is damaged: {output.stored(entry.messages)}; "
            f"{coverage(entry, losses_of(entry))}; `hybridlog info --losses` says where."
        )
    if report.failure is not None:
        code = DatabaseError.exit_code
        output.note(f"hybridlog: {output.not_indexed(report)}")
    return code
