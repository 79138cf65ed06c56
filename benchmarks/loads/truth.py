"""What must be found in a load that looks like the teleoperation study."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

NAME = "truth.json"
BEFORE_ERROR_NS = 300_000_000_000
"""The five minutes before a system error, ns."""
MINUTE_NS = 60_000_000_000


@dataclass(frozen=True, slots=True)
class RobotError:
    """A system error and what came before it.

    Attributes:
        log_time: Of the message on `/rosout` with a level of ERROR (8), ns.
        messages: Messages of all topics, those of `/rosout` included, with a log time in
            `[log_time - 5 minutes, log_time)`.
    """

    log_time: int
    messages: int


@dataclass(frozen=True, slots=True)
class Truth:
    """Answers, known from the plan of the sessions and not from their messages.

    All times are log times in ns since the epoch. No message lies within a millisecond
    of the edge of a window, so that a system that keeps milliseconds finds the same.

    Attributes:
        sessions: Begin and end of each session; no message lies between two of them.
        messages: How many messages each topic has.
        q1: Commands that close the right gripper (`position == 0.0`).
        q2: Viewpoint messages with `position.x <= 0`.
        q2_sum: Sums of x, y and z of those, exact: all are multiples of 1/64.
        q3: Commands to the right arm with `z > 1`, `-0.5 < y < 0.5`, `0.5 < x < 1`.
        q4_near: Closings with a viewpoint message of `position.x >= 0` less than 0.1 s
            before or after (the paper's text).
        q4_wide: The same within 0.5 s (the paper's code).
        viewpoint_changes: Runs of viewpoint messages that each differ from the one
            before. Sessions begin and end with the same viewpoint at rest.
        closed: Begin and end of each time for which the right gripper was closed: from
            the command that closes it to the next one that opens it.
        closed_minutes: Where the non-overlapping minutes begin in which it stayed closed:
            each time in `closed` is cut into whole minutes from its begin.
        errors: The system errors, in order.
        before_errors: Messages in the five minutes before any error, each counted once.
    """

    sessions: tuple[tuple[int, int], ...]
    messages: dict[str, int]
    q1: int
    q2: int
    q2_sum: tuple[float, float, float]
    q3: int
    q4_near: int
    q4_wide: int
    viewpoint_changes: int
    closed: tuple[tuple[int, int], ...]
    closed_minutes: tuple[int, ...]
    errors: tuple[RobotError, ...]
    before_errors: int

    def save(self, directory: Path) -> None:
        """Write it beside the load."""
        text = json.dumps(asdict(self), indent=1)
        (directory / NAME).write_text(text, encoding="utf-8")

    @classmethod
    def open(cls, directory: Path) -> Truth:
        """The truth beside a load."""
        value = json.loads((directory / NAME).read_text(encoding="utf-8"))
        for name in ("sessions", "closed"):
            value[name] = tuple((begin, end) for begin, end in value[name])
        for name in ("q2_sum", "closed_minutes"):
            value[name] = tuple(value[name])
        value["errors"] = tuple(RobotError(**error) for error in value["errors"])
        return cls(**value)
