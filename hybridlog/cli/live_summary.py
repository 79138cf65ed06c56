"""The summary of a live recording: tables, remarks, and the exit code."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import output
from hybridlog.cli.app import DIFFERENT
from hybridlog.cli.live_table import closing_rows
from hybridlog.cli.render import print_fields
from hybridlog.contract.judge import broken
from hybridlog.query.answers.completeness import line_of
from hybridlog.record.losses import Cause
from hybridlog_storage.errors import (
    DatabaseError,
    DiskFullError,
    SourceDamagedError,
    SourceError,
)

if TYPE_CHECKING:
    from hybridlog.contract.judge import Result
    from hybridlog.live.policy import Rule
    from hybridlog.live.recorder import Recorder, RecorderOptions
    from hybridlog.live.sources.base import LiveSource
    from hybridlog.live.state import RecorderState
    from hybridlog.record.recorder import RecordReport

_MAX_ROWS = 10  # of the ledger; `losses` prints all


class LiveSummary:
    """The summary of a recorder that has stopped."""

    def __init__(
        self,
        reports: Sequence[RecordReport],
        recorder: Recorder,
        sources: Sequence[LiveSource],
        options: RecorderOptions,
    ) -> None:
        self._reports = reports
        self._recorder = recorder
        self._options = options
        self._state = recorder.look()
        self._unreached = [source.address for source in sources if not source.was_reached]
        self._broken: Sequence[Result] = ()
        self._is_all_unreached = len(self._unreached) == len(sources)

    def add_verdict(self, results: Sequence[Result]) -> None:
        """Add the results of the contract on the recording."""
        self._broken = broken(results)

    def print_and_exit(self, *, as_json: bool, quiet: bool) -> None:
        """Print it; exits with the code of the worst problem, if there is one."""
        code = self._exit_code()
        if as_json:
            summary = _summary(self._reports, self._state, self._recorder.reason)
            summary["broken"] = [asdict(one) for one in self._broken]
            output.print_json_line({"report": {**summary, "exit_code": code}})
        elif not quiet:
            self._print()
        if not quiet:
            for line in self._remarks():
                output.note(line)
        for line in self._errors(is_reason_shown=not (as_json or quiet)):
            output.note(f"hybridlog: {line}")
        if code:
            raise click.exceptions.Exit(code)

    def _print(self) -> None:
        reports, state = self._reports, self._state
        if reports:
            rows = closing_rows(reports[0], state, self._unreached)
            if self._recorder.reason:
                rows.append(("ended", self._recorder.reason))
            print_fields([("recording", reports[0].entry.name), *rows])
        else:
            output.note("Nothing was stored.")

    def _remarks(self) -> Iterator[str]:
        silent = self._recorder.silent()
        for topic in silent:
            yield f"{topic}: has a publisher that sent nothing"
        topics = {*silent, *(topic.topic for topic in self._state.topics)}
        matcher = self._options.matcher
        unused = [] if matcher is None else matcher.unused()
        for pattern in unused:
            yield f"no topic fits {output.quoted(pattern)}"
        for report in self._reports:
            yield from output.surpluses(report.entry.channels)
        if matcher is not None and not unused and not topics:
            yield "no topic is left: --exclude takes away all that --topic names"
        for option, rules in (
            ("--throttle", self._options.throttles),
            ("--priority", self._options.priorities),
        ):
            yield from _idle(option, rules, topics)

    def _errors(self, *, is_reason_shown: bool) -> Iterator[str]:
        """Lines that --quiet does not leave out."""
        if self._recorder.stopped_for_disk and not is_reason_shown:
            yield self._recorder.reason
        for one in self._broken:
            yield f"{one.topic or 'the recording'} breaks {one.rule} {one.wanted}: {one.found}"
        for address in self._unreached:
            yield f"{address} was never reached, so nothing of it is recorded."
        rows = [
            row
            for report in self._reports
            for row in report.entry.end.get("losses", [])
            if row["cause"] == Cause.UNREADABLE
        ]
        for row in rows[:_MAX_ROWS]:
            yield line_of(row)
        if len(rows) > _MAX_ROWS:
            more = output.counted(len(rows) - _MAX_ROWS, "more place")
            yield f"and {more} that could not be read; `hybridlog info --losses` lists them"
        for report in self._reports:
            if report.failure is not None:
                yield (
                    f"{report.failure} {output.stored(report.missed)} but not in the index; the "
                    "next command that opens the store catches up."
                )

    def _exit_code(self) -> int:
        state = self._state
        if self._recorder.stopped_for_disk or Cause.DISK in state.lost:
            return DiskFullError.exit_code
        if any(report.failure is not None for report in self._reports):
            return DatabaseError.exit_code
        if self._is_all_unreached and not state.messages:
            return SourceError.exit_code
        if Cause.UNREADABLE in state.lost:
            return SourceDamagedError.exit_code
        return DIFFERENT if self._broken else 0


def _idle(option: str, rules: Sequence[Rule], topics: set[str]) -> Iterator[str]:
    """Lines about rules that no topic fits."""
    for rule in rules:
        if not any(map(rule.fits, topics)):
            yield f"no topic fits {output.quoted(rule.pattern)} of {option}"


def _summary(reports: Sequence[RecordReport], state: RecorderState, reason: str) -> dict[str, Any]:
    recordings = [
        {
            "recording": report.entry.name,
            "status": report.entry.status,
            "tags": report.entry.tags,
            "messages": report.entry.messages,
            "messages_indexed": report.indexed,
            "losses": report.entry.end.get("losses", []),
            "bytes_stored": report.entry.stored_bytes,
            "seconds": round(report.elapsed_s, 3),
        }
        for report in reports
    ]
    return {
        "ended": reason,
        "recordings": recordings,
        "messages_received": state.messages,
        "bytes": state.stored_bytes,
        # A cause without a number stands for an unknown number.
        "lost": {cause: count or None for cause, count in state.lost.items()},
        "topics": {
            topic.topic: {"received": topic.messages, "lost": topic.lost} for topic in state.topics
        },
    }
