"""`hybridlog record` of log files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from hybridlog.cli import coverage, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.options import parse_tags
from hybridlog.cli.progress import progress_bar
from hybridlog.cli.record_choices import RecordChoices, segment_settings
from hybridlog.cli.signals import if_stopped
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
    from hybridlog.query.topics import TopicMatcher
    from hybridlog.recorder import RecordOptions, RecordReport
    from hybridlog.sources.base import Source
    from hybridlog.store import Store
    from hybridlog_storage.segment_writer import SegmentSettings


def record_logs(choices: RecordChoices) -> None:
    """Record each path; an error in one does not stop the others."""
    paths = choices.paths
    if choices.name is not None and len(paths) > 1:
        raise UsageError("--name names one recording; several paths were given.")
    # Wrong options are found before a store is made.
    settings = segment_settings(choices)
    tags = parse_tags(choices.tag)
    _matcher(choices)
    _no_index(choices)
    _check_new_store(choices)
    done = _Results(choices)
    try:
        with (
            if_stopped(done.on_stop),
            opened_store(
                choices.store,
                choices.mongo,
                create=True,
                shared=choices.shared,
                needs_database=True,
                cache_mb=choices.cache_size,
                quiet=choices.quiet,
            ) as store,
            at_safe_points(),
        ):
            for path in paths:
                safe_point()
                try:
                    done.add(path, _record_one(store, path, choices, settings, tags))
                except (SourceError, AlreadyRecordedError, UsageError) as error:
                    if len(paths) == 1:
                        raise
                    done.fail(path, error)
    finally:
        done.show()
    done.exit()


def _check_new_store(choices: RecordChoices) -> None:
    """Fail before a store is made, when no path can be read or the server does not answer."""
    from hybridlog.maintenance.lease import check
    from hybridlog.store import store_path
    from hybridlog_storage.settings import EMBEDDED, NAME, with_password

    if os.path.lexists(store_path(choices.store) / NAME):
        return
    from hybridlog.sources.detect import open_source

    paths = choices.paths
    first: SourceError | None = None
    for path in paths:
        try:
            open_source(path).close()
        except SourceError as error:
            first = first or error
        else:
            break
    else:
        if first is not None and len(paths) == 1:
            raise first
        if first is not None:
            raise SourceError(f"None of the {len(paths)} paths can be read. {first}")
    if choices.mongo not in {None, EMBEDDED}:
        # The new store stores the URI, so it has to be right.
        from hybridlog_storage.database import Database
        from hybridlog_storage.index_state import IndexState

        with Database.connect(with_password(choices.mongo)) as database:
            check(IndexState(database).mark(), {"id": ""}, database)


def _record_one(
    store: Store,
    path: Path,
    choices: RecordChoices,
    settings: SegmentSettings,
    tags: dict[str, str],
) -> RecordReport:
    from hybridlog.recorder import RecordOptions
    from hybridlog.sources.detect import open_source

    with anywhere():
        source = open_source(path)
    with source:
        matcher, no_index = _matcher(choices), _no_index(choices)
        options = RecordOptions(
            name=choices.name,
            tags=tags,
            matcher=matcher,
            between=_between(source, choices),
            latched=not choices.no_latched,
            original_times=choices.original_times,
            again=choices.again,
            settings=settings,
            no_index=no_index,
        )
        with progress_bar(path.name, source.size_bytes, quiet=choices.quiet) as bar:
            report = store.record(
                source,
                options,
                lambda read, messages: bar(read, output.counted(messages, "message")),
            )
        _check_not_empty(report, source, store, options)
    for pattern in (p for one in (matcher, no_index) if one is not None for p in one.unused()):
        output.note(f"{path}: no topic fits {output.quoted(pattern)}.")
    return report


def _check_not_empty(
    report: RecordReport, source: Source, store: Store, options: RecordOptions
) -> None:
    """Remove an empty recording, and fail: its time range holds no message."""
    messages = report.entry.messages - report.latched
    if options.between is None or messages or not report.skipped + report.latched:
        return
    store.refresh()
    store.remove(report.entry.id)
    raise _outside(source, options.between)


def _between(source: Source, choices: RecordChoices) -> tuple[int, int] | None:
    from hybridlog.query.times import is_relative, parse_range
    from hybridlog.sources.detect import read_time_range

    if choices.between is None:
        return None
    if source.time_range is None and any(map(is_relative, choices.between)):
        source.time_range = read_time_range(source.path)
    start, end = source.time_range or (None, None)
    between = parse_range(*choices.between, start=start, end=end)
    if start is not None and end is not None and (between[1] <= start or between[0] >= end):
        raise _outside(source, between)
    return between


def _outside(source: Source, between: tuple[int, int]) -> TimeError:
    from hybridlog.query.times import format_time

    low, high = map(format_time, between)
    spans = ""
    if source.time_range is not None:
        start, end = source.time_range
        spans = f"; it spans {format_time(start)} to {format_time(end - 1)}"
    return TimeError(f"{source.path} has no message from {low} up to {high}{spans}.")


def _matcher(choices: RecordChoices) -> TopicMatcher | None:
    """A new matcher for each source, as it counts the uses of its patterns."""
    from hybridlog.query.topics import matcher

    if not choices.topics and not choices.exclude:
        return None
    return matcher(choices.topics, choices.exclude)


def _no_index(choices: RecordChoices) -> TopicMatcher | None:
    """The same for the topics without index documents."""
    from hybridlog.query.topics import matcher

    return matcher(choices.no_index) if choices.no_index else None


class _Results:
    """Results of the paths, for the table at the end and the exit code."""

    def __init__(self, choices: RecordChoices) -> None:
        self._paths = choices.paths
        self._choices = choices
        self._reports: list[tuple[Path, RecordReport]] = []
        self._summaries: list[dict[str, Any]] = []
        self._errors: list[HybridlogError] = []

    def add(self, path: Path, report: RecordReport) -> None:
        self._reports.append((path, report))
        self._summaries.append(_summary(path, report))
        self._errors.extend(_problems(path, report, quiet=self._choices.quiet))

    def fail(self, path: Path, error: HybridlogError) -> None:
        output.note(f"hybridlog: {error}")
        self._errors.append(error)
        self._summaries.append(
            {"path": str(path), "error": str(error), "exit_code": error.exit_code}
        )

    def on_stop(self) -> str:
        """The effect of stopping now on the recordings."""
        done = len(self._summaries)
        if done == len(self._paths):
            return "Everything was recorded."
        kept = len(self._reports)
        before = f" {output.counted(kept, 'recording')} stored before." if kept else ""
        return f"Nothing of {self._paths[done]} is stored.{before}"

    def show(self) -> None:
        """Print the table of the finished recordings."""
        if self._choices.as_json:
            if self._summaries:
                one = len(self._paths) == 1
                output.print_json(self._summaries[0] if one else self._summaries)
        elif not self._choices.quiet and self._reports:
            if len(self._reports) == 1:
                _print_one(*self._reports[0])
            else:
                _print_several([report for _, report in self._reports])

    def exit(self) -> None:
        """Exit with the code of the first error, if there is one."""
        if self._errors:
            raise click.exceptions.Exit(self._errors[0].exit_code)


def _summary(path: Path, report: RecordReport) -> dict[str, Any]:
    entry = report.entry
    return {
        "path": str(path),
        "recording": entry.label,
        "id": entry.id,
        "status": entry.status,
        "topics": _topics(report),
        "messages": entry.messages,
        "messages_indexed": report.indexed,
        "messages_unreadable": sum(c.stats.unreadable for c in entry.channels),
        "messages_surplus": sum(c.stats.surplus for c in entry.channels),
        "messages_skipped": report.skipped,
        "messages_latched": report.latched,
        "bytes_in": entry.source["bytes"],
        "bytes_stored": entry.stored_bytes,
        "ratio": round(_ratio(entry.source["bytes"], entry.stored_bytes), 3),
        "seconds": round(report.elapsed_s, 3),
        "damage": [{**asdict(d), "file": str(d.file)} for d in report.damage],
        "not_indexed": {c.topic: c.unindexed for c in entry.channels if c.unindexed is not None},
    }


def _topics(report: RecordReport) -> int:
    return len({c.topic for c in report.entry.channels})


def _ratio(taken: int, stored: int) -> float:
    return taken / stored if stored else 0.0


def _print_one(path: Path, report: RecordReport) -> None:
    entry = report.entry
    taken = int(entry.source["bytes"])
    rate = entry.messages / report.elapsed_s if report.elapsed_s else 0.0
    left_out = f" ({report.skipped} left out)" if report.skipped else ""
    if report.latched:
        left_out += f"; {report.latched} of them latched, from before the time range"
    output.print_table(
        [("recording", "left"), (entry.label, "left")],
        [
            ("source", f"{path} ({entry.source['kind']})"),
            ("topics", str(_topics(report))),
            ("messages", f"{entry.messages}{left_out}"),
            ("bytes in", output.size(taken)),
            ("bytes stored", output.size(entry.stored_bytes)),
            ("ratio", f"{_ratio(taken, entry.stored_bytes):.2f}"),
            ("messages indexed", str(report.indexed)),
            ("time", f"{report.elapsed_s:.2f} s ({rate:,.0f} messages/s)"),
        ],
    )


class _Figures(NamedTuple):
    """A row of the table of several recordings."""

    name: str
    topics: int
    messages: int
    taken: int
    stored: int
    indexed: int
    elapsed_s: float

    def row(self) -> tuple[str, ...]:
        return (
            self.name,
            str(self.topics),
            str(self.messages),
            output.size(self.taken),
            output.size(self.stored),
            f"{_ratio(self.taken, self.stored):.2f}",
            str(self.indexed),
            f"{self.elapsed_s:.2f} s",
        )


def _print_several(reports: Sequence[RecordReport]) -> None:
    lines = [
        _Figures(
            report.entry.label,
            _topics(report),
            report.entry.messages,
            int(report.entry.source["bytes"]),
            report.entry.stored_bytes,
            report.indexed,
            report.elapsed_s,
        )
        for report in reports
    ]
    total = _Figures(
        "total",
        len({c.topic for report in reports for c in report.entry.channels}),
        sum(line.messages for line in lines),
        sum(line.taken for line in lines),
        sum(line.stored for line in lines),
        sum(line.indexed for line in lines),
        sum(line.elapsed_s for line in lines),
    )
    output.print_table(
        [
            ("recording", "left"),
            ("topics", "right"),
            ("messages", "right"),
            ("bytes in", "right"),
            ("stored", "right"),
            ("ratio", "right"),
            ("indexed", "right"),
            ("time", "right"),
        ],
        [line.row() for line in (*lines, total)],
    )


def _problems(path: Path, report: RecordReport, *, quiet: bool) -> list[HybridlogError]:
    """Print problems; returns an error for each that sets the exit code."""
    problems: list[HybridlogError] = []
    for channel in report.entry.channels:
        if channel.is_indexed and channel.reason is not None and not quiet:
            output.note(f"{channel.topic}: not indexed beyond time: {channel.reason}")
        if channel.stats.unreadable:
            output.note(
                f"{channel.topic}: {output.unfit(channel.stats.unreadable)}; stored, without "
                "fields in the index"
            )
    if report.latched_left_out:
        output.note(
            f"{path}: {output.counted(report.latched_left_out, 'latched message')} from before "
            "the time range did not fit in memory."
        )
    if not quiet:
        for line in output.surpluses(report.entry.channels):
            output.note(line)
    for damage in report.damage:
        place = "" if damage.offset is None else f" at byte {damage.offset}"
        count = damage.messages_lost
        lost = f"; {output.counted(count, 'message')} lost" if count else ""
        output.note(f"{damage.file}{place}: {damage.reason}{lost}")
    if report.failure is not None:
        output.note(
            f"hybridlog: {report.failure} {output.stored(report.missed)} "
            "but not in the index; the next command that opens the store catches up."
        )
        problems.append(DatabaseError(str(report.failure)))
    if report.damage:
        losses = coverage.losses_of(report.entry)
        output.note(
            f"{path} is damaged: {output.stored(report.entry.messages)}; "
            f"{coverage.describe(report.entry, losses)}."
        )
        problems.append(SourceDamagedError(str(path)))
    return problems
