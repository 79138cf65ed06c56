"""`hybridlog record`."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import typer
from hybridlog_storage.errors import (
    AlreadyRecordedError,
    DatabaseError,
    HybridlogError,
    SourceDamaged,
    SourceError,
    UsageError,
)

from hybridlog.cli import output

if TYPE_CHECKING:
    from hybridlog.recorder import RecordOptions, RecordReport
    from hybridlog.sources.base import Source
    from hybridlog.store import Store


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
    mongo: str | None
    as_json: bool
    quiet: bool


def run(paths: list[Path], choices: Choices) -> None:
    """Record each path; what goes wrong with one does not keep the others out."""
    if choices.name is not None and len(paths) > 1:
        raise UsageError("--name names one recording; several paths were given.")
    tags = _tags(choices.tag or [])
    failures: list[HybridlogError] = []
    results: list[dict[str, Any]] = []
    from hybridlog.sources.detect import open_source

    if len(paths) == 1:
        # Before a store is made: a path that is no log should leave nothing behind.
        open_source(paths[0]).close()
    with output.opened(
        choices.store, choices.mongo, create=True, needs_database=True
    ) as store:
        for path in paths:
            try:
                report = _record_one(store, path, choices, tags)
            except (SourceError, AlreadyRecordedError, UsageError) as error:
                if len(paths) == 1:
                    raise
                output.note(f"hybridlog: {error}")
                failures.append(error)
                results.append({"path": str(path), "error": str(error)})
                continue
            results.append(_summary(path, report))
            if not choices.as_json and not choices.quiet:
                _print_report(path, report)
            failures.extend(_problems(path, report, quiet=choices.quiet))
    if choices.as_json:
        output.print_json(results if len(paths) > 1 else results[0])
    if failures:
        raise typer.Exit(failures[0].exit_code)


def _record_one(
    store: Store, path: Path, choices: Choices, tags: dict[str, str]
) -> RecordReport:
    from hybridlog.recorder import record
    from hybridlog.sources.detect import open_source
    from hybridlog.sources.fingerprint import fingerprint

    with open_source(path) as source:
        options = _options(source, choices, tags)
        with output.progress_bar(path.name, source.size_bytes, quiet=choices.quiet) as bar:
            report = record(
                source,
                store.directory,
                store.database_for("record"),
                fingerprint(source.files),
                options,
                lambda done, messages: bar(done, f"{messages} messages"),
            )
        unused = options.matcher.unused() if options.matcher is not None else []
        for pattern in unused:
            output.note(f"{path}: no topic fits {pattern!r}")
    store.refresh()
    return report


def _options(source: Source, choices: Choices, tags: dict[str, str]) -> RecordOptions:
    from hybridlog_storage.segment_writer import SegmentSettings

    from hybridlog.query.times import parse_range
    from hybridlog.query.topics import matcher
    from hybridlog.recorder import RecordOptions

    between = None
    if choices.between is not None:
        start, end = source.time_range or (None, None)
        between = parse_range(*choices.between, start=start, end=end)
    chosen = None
    if choices.topics or choices.exclude:
        chosen = matcher(choices.topics or (), choices.exclude or ())
    return RecordOptions(
        name=choices.name,
        tags=tags,
        matcher=chosen,
        between=between,
        again=choices.again,
        settings=SegmentSettings(
            chunk_size=output.parse_size(choices.chunk_size),
            compression=cast(Any, choices.compression),
            level=choices.level,
        ),
    )


def _tags(pairs: list[str]) -> dict[str, str]:
    tags = {}
    for pair in pairs:
        key, sign, value = pair.partition("=")
        if not sign or not key:
            raise UsageError(f"--tag wants KEY=VALUE, not {pair!r}.")
        tags[key] = value
    return tags


def _summary(path: Path, report: RecordReport) -> dict[str, Any]:
    entry = report.entry
    return {
        "path": str(path),
        "recording": entry.id,
        "status": entry.status,
        "topics": len({c.topic for c in entry.channels}),
        "messages": entry.messages,
        "messages_indexed": report.indexed,
        "messages_unreadable": sum(c.stats.unreadable for c in entry.channels),
        "messages_skipped": report.skipped,
        "bytes_in": entry.source["bytes"],
        "bytes_stored": entry.stored_bytes,
        "seconds": round(report.elapsed_s, 3),
        "damage": [{**asdict(d), "file": str(d.file)} for d in report.damage],
        "not_indexed": {c.topic: c.reason for c in entry.channels if c.reason is not None},
    }


def _print_report(path: Path, report: RecordReport) -> None:
    entry = report.entry
    taken = int(entry.source["bytes"])
    ratio = taken / entry.stored_bytes if entry.stored_bytes else 0.0
    rate = entry.messages / report.elapsed_s if report.elapsed_s else 0.0
    output.print_table(
        [("recording", "left"), (entry.id, "left")],
        [
            ("source", f"{path} ({entry.source['kind']})"),
            ("topics", str(len({c.topic for c in entry.channels}))),
            ("messages", f"{entry.messages} ({report.skipped} left out)" if report.skipped
             else str(entry.messages)),
            ("indexed", f"{report.indexed}"),
            ("bytes in", output.size(taken)),
            ("bytes stored", f"{output.size(entry.stored_bytes)} (ratio {ratio:.2f})"),
            ("time", f"{report.elapsed_s:.2f} s ({rate:,.0f} messages/s)"),
        ],
    )


def _problems(path: Path, report: RecordReport, *, quiet: bool) -> list[HybridlogError]:
    """Tell what is not as it should be; returns an error for what an exit code should say."""
    problems: list[HybridlogError] = []
    for channel in report.entry.channels:
        if channel.reason is not None and not quiet:
            output.note(f"{channel.topic}: not indexed beyond time: {channel.reason}")
        if channel.stats.unreadable:
            output.note(
                f"{channel.topic}: {channel.stats.unreadable} messages do not fit their "
                "definition; they are stored, their fields are not indexed"
            )
    for damage in report.damage:
        place = "" if damage.offset is None else f" at byte {damage.offset}"
        lost = "" if damage.messages_lost is None else f"; {damage.messages_lost} messages lost"
        output.note(f"{damage.file}{place}: {damage.reason}{lost}")
    if report.failure is not None:
        output.note(
            f"hybridlog: {report.failure} {report.missed} messages are stored but not in the "
            "index; the next command that opens the store catches up."
        )
        problems.append(DatabaseError(str(report.failure)))
    if report.damage:
        output.note(
            f"{path} is damaged: {report.entry.messages} messages are stored, "
            f"{len(report.damage)} places could not be read."
        )
        problems.append(SourceDamaged(str(path)))
    sys.stderr.flush()
    return problems
