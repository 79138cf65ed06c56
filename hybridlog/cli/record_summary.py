"""The end of `hybridlog record`: what is told of a recording, and the exit code of a robot's."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import click

from hybridlog.cli import output
from hybridlog.cli.app import DIFFERENT
from hybridlog.cli.render import Column, bytes_of, numbers, print_fields
from hybridlog.query.answers.completeness import coverage, in_words
from hybridlog.record.losses import Cause, losses_of
from hybridlog_storage.errors import (
    DatabaseError,
    DiskFullError,
    SourceDamagedError,
    SourceError,
)

if TYPE_CHECKING:
    from hybridlog.contract.judge import Result
    from hybridlog.live.recorder import Recorder, RecorderOptions
    from hybridlog.live.sources.base import LiveSource
    from hybridlog.live.state import RecorderState
    from hybridlog.record.recorder import RecordReport


def row_of(report: RecordReport, path: object) -> dict[str, Any]:
    """What is told in JSON of each recording."""
    entry, seconds = report.entry, report.elapsed_s
    return {
        "path": str(path),
        "kind": entry.source["kind"],
        "id": entry.id,
        "recording": entry.name,
        "status": entry.status,
        "topics": len({c.topic for c in entry.channels}),
        "messages": entry.messages,
        "messages_indexed": report.indexed,
        "messages_unreadable": sum(c.stats.unreadable for c in entry.channels),
        "messages_surplus": sum(c.stats.surplus for c in entry.channels),
        "messages_skipped": report.skipped,
        "messages_latched": report.latched,
        "attachments": entry.attachments,
        "attachments_left_out": report.attachments_left_out,
        "metadata_records": entry.metadata_records,
        "bytes_in": entry.source["bytes"],
        "bytes_stored": entry.stored_bytes,
        "seconds": round(seconds, 3),
        "damage": [{**asdict(d), "file": str(d.file)} for d in report.damage],
        "not_indexed": {c.topic: c.unindexed for c in entry.channels if c.unindexed is not None},
    }


def _source(row: Mapping[str, Any]) -> str:
    return f"{row['path']} ({row['kind']})" if row["path"] else ""


def _ratio(row: Mapping[str, Any]) -> str:
    return f"{row['bytes_in'] / (row['bytes_stored'] or math.inf):.2f}"


def _rate(row: Mapping[str, Any]) -> str:
    return f"{row['messages'] / (row['seconds'] or math.inf):,.0f}"


COLUMNS: Final = [
    Column("recording"),
    Column("source", _source, order=1),
    *numbers("topics", "messages"),
    Column("left out", "messages_skipped", "right", varies=True),
    Column("from before", "messages_latched", "right", varies=True),
    Column("attachments", side="right", varies=True),
    bytes_of("bytes in", "bytes_in", order=3),
    bytes_of("stored", "bytes_stored"),
    Column("ratio", _ratio, "right"),
    Column("indexed", "messages_indexed", "right"),
    Column("time", lambda row: f"{row['seconds']:.2f} s", "right"),
    Column("messages/s", _rate, "right", order=2),
]
"""Of a table of the rows of `row_of`."""


def fields_of(row: Mapping[str, Any]) -> list[tuple[str, object]]:
    """What is told to people of one recording."""
    cells = [(one, one.cell(row)) for one in COLUMNS]
    return [(one.name, cell) for one, cell in cells if not (one.varies and cell == "0")]


@dataclass(slots=True)
class LiveSummary:
    """The summary of a recorder that has stopped."""

    reports: Sequence[RecordReport]
    recorder: Recorder
    state: RecorderState
    sources: Sequence[LiveSource]
    options: RecorderOptions
    broken: Sequence[Result]

    @property
    def unreached(self) -> list[str]:
        """Addresses of sources that never answered."""
        return [source.address for source in self.sources if not source.was_reached]

    def print_and_exit(self, *, as_json: bool) -> None:
        """Print it; exits with the code of the worst problem, if there is one."""
        code = self._exit_code()
        if as_json:
            summary = _summary(self.reports, self.state, self.recorder.reason)
            summary["broken"] = [asdict(one) for one in self.broken]
            output.print_json_line({"report": {**summary, "exit_code": code}})
        elif not output.is_quiet():
            self._print()
        output.remarks(self._remarks())
        for line in self._errors(is_reason_shown=not (as_json or output.is_quiet())):
            output.note(f"hybridlog: {line}")
        if code:
            raise click.exceptions.Exit(code)

    def _print(self) -> None:
        if not self.reports:
            output.note("Nothing was stored.")
            return
        report, state = self.reports[-1], self.state
        entry = report.entry
        row = {**row_of(report, entry.source["path"]), "bytes_in": state.stored_bytes}
        fields = [*fields_of(row), ("received", state.messages)]
        fields.append(("coverage", coverage(entry, losses_of(entry))))
        if state.let_go:
            fields.append(("let go", f"{state.let_go}, by the ring"))
        if self.recorder.reason:
            fields.append(("ended", self.recorder.reason))
        print_fields(fields)

    def _remarks(self) -> Iterator[str]:
        silent = self.recorder.silent()
        for topic in silent:
            yield f"{topic}: has a publisher that sent nothing"
        unfitting = self.recorder.unfitting()
        yield from (f"no topic fits {text}" for text in unfitting)
        for report in self.reports:
            yield from output.surpluses(report.entry.channels)
        if self.options.matcher is not None and not (unfitting or silent or self.state.topics):
            yield "no topic is left: --exclude takes away all that --topic names"

    def _errors(self, *, is_reason_shown: bool) -> Iterator[str]:
        """Lines that --quiet does not leave out."""
        if self.recorder.stopped_for_disk and not is_reason_shown:
            yield self.recorder.reason
        for one in self.broken:
            yield f"{one.topic or 'the recording'} breaks {one.rule} {one.wanted}: {one.found}"
        for address in self.unreached:
            yield f"{address} was never reached, so nothing of it is recorded."
        rows = [
            row
            for report in self.reports
            for row in report.entry.end.get("losses", [])
            if row["cause"] == Cause.UNREADABLE
        ]
        if rows:
            yield f"{in_words(rows)} that cannot be read; `hybridlog info --losses` lists them"
        yield from (output.not_indexed(one) for one in self.reports if one.failure is not None)

    def _exit_code(self) -> int:
        state = self.state
        if self.recorder.stopped_for_disk or Cause.DISK in state.lost:
            return DiskFullError.exit_code
        if any(report.failure is not None for report in self.reports):
            return DatabaseError.exit_code
        if len(self.unreached) == len(self.sources) and not state.messages:
            return SourceError.exit_code
        if Cause.UNREADABLE in state.lost:
            return SourceDamagedError.exit_code
        return DIFFERENT if self.broken else 0


def _summary(reports: Sequence[RecordReport], state: RecorderState, reason: str) -> dict[str, Any]:
    return {
        "ended": reason,
        "recordings": [
            {
                **row_of(report, report.entry.source["path"]),
                "tags": report.entry.tags,
                "losses": report.entry.end.get("losses", []),
            }
            for report in reports
        ],
        "messages_received": state.messages,
        "bytes": state.stored_bytes,
        # A cause without a number stands for an unknown number.
        "lost": {cause: count or None for cause, count in state.lost.items()},
        "topics": {
            topic.topic: {"received": topic.messages, "lost": topic.lost} for topic in state.topics
        },
    }
