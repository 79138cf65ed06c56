"""`hybridlog record`."""

from __future__ import annotations

from hybridlog.cli.binder import command
from hybridlog.cli.record_choices import RecordChoices, check_choices


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
    check_choices(choices)
    if choices.is_live:
        from hybridlog.cli.record_live import record_live

        return record_live(choices)
    if choices.watch:
        from hybridlog.cli.record_logs import record_watched

        return record_watched(choices)
    from hybridlog.cli.record_logs import record_logs

    return record_logs(choices)
