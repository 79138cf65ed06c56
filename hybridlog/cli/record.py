"""`hybridlog record`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import typer

from hybridlog.cli import output
from hybridlog.cli.opening import opened
from hybridlog.cli.progress import progress_bar
from hybridlog.cli.stopping import Stopped
from hybridlog_storage.errors import (
    AlreadyRecordedError,
    DatabaseError,
    HybridlogError,
    SourceDamagedError,
    SourceError,
    TimeError,
    UsageError,
)

if TYPE_CHECKING:
    from hybridlog.cli.live_choices import LiveChoices
    from hybridlog.live.recorder import RecorderOptions
    from hybridlog.query.topics import TopicMatcher
    from hybridlog.recorder import RecordOptions, RecordReport
    from hybridlog.sources.base import Source
    from hybridlog.store import Store
    from hybridlog_storage.segment_writer import SegmentSettings


@dataclass(frozen=True, slots=True)
class Choices:
    """The options of the command, as typed."""

    store: Path | None
    topics: list[str] | None
    exclude: list[str] | None
    between: tuple[str, str] | None
    name: str | None
    tag: list[str] | None
    again: bool
    chunk_size: str
    compression: str
    level: int
    shared: bool
    mongo: str | None
    as_json: bool
    quiet: bool


def run(paths: list[Path], live: LiveChoices, choices: Choices) -> None:
    """Record logs, or a running robot."""
    from hybridlog.cli.live_choices import check_choices

    check_choices(live, paths)
    if live.any_source:
        from hybridlog.cli import record_live

        _refuse_for_live(choices)
        record_live.run(live, lambda: _live_options(live, choices), choices)
    else:
        _run_logs(paths, choices)


def _refuse_for_live(choices: Choices) -> None:
    """What makes sense for logs only.

    Raises:
        UsageError: It was given.
    """
    if choices.between is not None or choices.again:
        raise UsageError("--between and --again are for logs, not for a running robot.")


def _live_options(live: LiveChoices, choices: Choices) -> RecorderOptions:
    from hybridlog.cli.live_choices import recorder_options

    return recorder_options(
        live,
        name=choices.name,
        tags=tags_of(choices.tag or []),
        topics=choices.topics or (),
        exclude=choices.exclude or (),
        settings=_settings(choices),
    )


def _run_logs(paths: list[Path], choices: Choices) -> None:
    """Record each path; what goes wrong with one does not keep the others out."""
    if choices.name is not None and len(paths) > 1:
        raise UsageError("--name names one recording; several paths were given.")
    # Everything that can be wrong with the options is wrong before a store is made.
    settings = _settings(choices)
    tags = tags_of(choices.tag or [])
    _matcher(choices)
    _check_new_store(paths, choices)
    done = _Results(paths, choices)
    try:
        with opened(
            choices.store,
            choices.mongo,
            create=True,
            shared=choices.shared,
            needs_database=True,
            quiet=choices.quiet,
        ) as store:
            for path in paths:
                try:
                    done.add(path, _record_one(store, path, choices, settings, tags))
                except (SourceError, AlreadyRecordedError, UsageError) as error:
                    if len(paths) == 1:
                        raise
                    done.fail(path, error)
    except Stopped as stopped:
        stopped.consequence = done.on_stop()
        raise
    finally:
        done.show()
    done.exit()


def _check_new_store(paths: Sequence[Path], choices: Choices) -> None:
    """Before a store is made: what cannot succeed should leave nothing behind."""
    from hybridlog.maintenance.lease import check
    from hybridlog.store import store_path
    from hybridlog_storage.settings import EMBEDDED, NAME, with_password

    if os.path.lexists(store_path(choices.store) / NAME):
        return
    from hybridlog.sources.detect import open_source

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
        # The URI is written down in the store that is made, so it should be right.
        from hybridlog_storage.database import Database
        from hybridlog_storage.index_state import IndexState

        with Database.connect(with_password(choices.mongo)) as database:
            check(IndexState(database).mark(), {"id": ""}, database)


def _record_one(
    store: Store,
    path: Path,
    choices: Choices,
    settings: SegmentSettings,
    tags: dict[str, str],
) -> RecordReport:
    from hybridlog.recorder import RecordOptions
    from hybridlog.sources.detect import open_source

    with open_source(path) as source:
        matcher = _matcher(choices)
        options = RecordOptions(
            name=choices.name,
            tags=tags,
            matcher=matcher,
            between=_between(source, choices),
            again=choices.again,
            settings=settings,
        )
        with progress_bar(path.name, source.size_bytes, quiet=choices.quiet) as bar:
            report = store.record(
                source,
                options,
                lambda read, messages: bar(read, output.counted(messages, "message")),
            )
        _check_not_empty(report, source, store, options)
    for pattern in matcher.unused() if matcher is not None else ():
        output.note(f"{path}: no topic fits {output.quoted(pattern)}.")
    return report


def _check_not_empty(
    report: RecordReport, source: Source, store: Store, options: RecordOptions
) -> None:
    """A time range in which nothing lies is a mistake; the empty recording goes away."""
    if options.between is None or report.entry.messages or not report.skipped:
        return
    store.refresh()
    store.remove(report.entry.id)
    raise _outside(source, options.between)


def _between(source: Source, choices: Choices) -> tuple[int, int] | None:
    from hybridlog.query.times import parse_range

    if choices.between is None:
        return None
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


def _matcher(choices: Choices) -> TopicMatcher | None:
    """A matcher of its own for each source, as it counts what it was used for."""
    from hybridlog.query.topics import matcher

    if not choices.topics and not choices.exclude:
        return None
    return matcher(choices.topics or (), choices.exclude or ())


def _settings(choices: Choices) -> SegmentSettings:
    from hybridlog_storage.segment_writer import SegmentSettings

    return SegmentSettings(
        chunk_size=output.parse_size(choices.chunk_size),
        compression=cast(Any, choices.compression),
        level=choices.level,
    )


def tags_of(pairs: list[str]) -> dict[str, str]:
    """KEY=VALUE pairs.

    Raises:
        UsageError: One of them is none.
    """
    tags = {}
    for pair in pairs:
        key, sign, value = pair.partition("=")
        if not sign or not key:
            raise UsageError(f"--tag wants KEY=VALUE, not {pair!r}.")
        tags[key] = value
    return tags


class _Results:
    """How each path went, for the table at the end and the exit code."""

    def __init__(self, paths: Sequence[Path], choices: Choices) -> None:
        self._paths = paths
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
        """What being stopped now means."""
        done = len(self._summaries)
        if done == len(self._paths):
            return "Everything was recorded."
        kept = len(self._reports)
        before = f" {output.counted(kept, 'recording')} made before stay." if kept else ""
        return f"Nothing of {self._paths[done]} is kept.{before}"

    def show(self) -> None:
        """The table of what was recorded, also when something stopped the rest."""
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
        """Leave with the code of the first thing that went wrong."""
        if self._errors:
            raise typer.Exit(self._errors[0].exit_code)


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
        "messages_skipped": report.skipped,
        "bytes_in": entry.source["bytes"],
        "bytes_stored": entry.stored_bytes,
        "ratio": round(_ratio(entry.source["bytes"], entry.stored_bytes), 3),
        "seconds": round(report.elapsed_s, 3),
        "damage": [{**asdict(d), "file": str(d.file)} for d in report.damage],
        "not_indexed": {c.topic: c.reason for c in entry.channels if c.reason is not None},
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
    """A line of the table of several recordings."""

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
    """Tell what is not as it should be; returns an error for what an exit code should say."""
    problems: list[HybridlogError] = []
    for channel in report.entry.channels:
        if channel.reason is not None and not quiet:
            output.note(f"{channel.topic}: not indexed beyond time: {channel.reason}")
        if channel.stats.unreadable:
            output.note(
                f"{channel.topic}: {output.unfit(channel.stats.unreadable)}; stored, without "
                "fields in the index"
            )
    for damage in report.damage:
        place = "" if damage.offset is None else f" at byte {damage.offset}"
        lost = (
            ""
            if damage.messages_lost is None
            else f"; {output.counted(damage.messages_lost, 'message')} lost"
        )
        output.note(f"{damage.file}{place}: {damage.reason}{lost}")
    if report.failure is not None:
        output.note(
            f"hybridlog: {report.failure} {output.stored(report.missed)} "
            "but not in the index; the next command that opens the store catches up."
        )
        problems.append(DatabaseError(str(report.failure)))
    if report.damage:
        output.note(
            f"{path} is damaged: {output.stored(report.entry.messages)}, "
            f"{output.counted(len(report.damage), 'place')} could not be read."
        )
        problems.append(SourceDamagedError(str(path)))
    return problems
