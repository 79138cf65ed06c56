"""`hybridlog record --watch`: records the logs of directories as they become complete."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.record_choices import opened_to_record
from hybridlog.cli.record_logs import LogRecorder, check_new_store, print_stores
from hybridlog.cli.signals import Stopped, if_stopped
from hybridlog_storage.errors import DatabaseError, SourceError
from hybridlog_storage.stopping import at_safe_points, pause, safe_point

if TYPE_CHECKING:
    from hybridlog.cli.record_choices import RecordChoices
    from hybridlog.formats.find import Log, Watch
    from hybridlog.store import Store

_INTERVAL_S = 2.0
"""Seconds between two looks at the directories."""
_MAX_UNFINISHED = 10


def record_watched(choices: RecordChoices) -> None:
    """Record what lies in directories, and what comes into them, until a signal ends it."""
    from hybridlog.formats.find import Watch
    from hybridlog.query.times import parse_duration

    settle_s = parse_duration(choices.settle) / 1e9
    recorder = LogRecorder(choices)
    check_new_store(choices, [])
    watches = [Watch(path, settle_s) for path in choices.paths]
    for watch in watches:
        watch.check()
    watching = _Watching(recorder, watches, quiet=choices.quiet)
    done = recorder.results
    done.report_each()
    try:
        with if_stopped(done.on_stop), opened_to_record(choices) as store, at_safe_points():
            watching.run(store)
    finally:
        done.show()
    done.exit()


class _Watching:
    """Looks at directories again and again.

    Args:
        recorder: Records the logs.
        watches: The directories.
        quiet: Errors only.
    """

    def __init__(self, recorder: LogRecorder, watches: list[Watch], *, quiet: bool) -> None:
        self._recorder = recorder
        self._watches = watches
        self._quiet = quiet
        self._told: set[str] = set()

    def run(self, store: Store) -> None:
        """Record until a signal comes, which ends this normally."""
        try:
            if not self._quiet:
                output.note("Watching. Ctrl-C ends it.")
            while True:
                for watch in self._watches:
                    self._look(store, watch)
                pause(_INTERVAL_S)
        except Stopped as stopped:
            if stopped.consequence:
                output.note(stopped.consequence)
            self._print_unfinished()

    def _look(self, store: Store, watch: Watch) -> None:
        try:
            found = watch.look()
        except SourceError as error:  # the directory may come back
            self._tell(error)
            return
        for place in found.stores:
            if str(place) not in self._told:
                self._told.add(str(place))
                print_stores([place])
        for problem in found.problems:
            self._tell(problem)
        for log in found.logs:
            safe_point()
            self._record(store, watch, log)

    def _record(self, store: Store, watch: Watch, log: Log) -> None:
        try:
            self._recorder.record(store, log, lambda _read, _messages: None)
        except DatabaseError as error:  # the log is tried again
            watch.put_back(log)
            self._tell(error)

    def _tell(self, error: SourceError | DatabaseError) -> None:
        """Print an error once, and count it for the exit code."""
        if str(error) not in self._told:
            self._told.add(str(error))
            self._recorder.results.fail(None, error)

    def _print_unfinished(self) -> None:
        paths: list[Path] = [path for watch in self._watches for path in watch.unfinished()]
        for path in paths[:_MAX_UNFINISHED]:
            output.note(f"{path} is not complete; `hybridlog record {path}` records what it has.")
        if len(paths) > _MAX_UNFINISHED:
            output.note(f"and {len(paths) - _MAX_UNFINISHED} more that are not complete")
