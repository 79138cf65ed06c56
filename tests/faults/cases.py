"""What is done to a store, and what it may look like after it was interrupted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.logs import Content
from tests.faults.steps import ALLOCATES, DATABASE, TORN, Fault, Point, Run, Stepper
from tests.faults.stores import Case, Prepared, Seen, Server, State, WrongError, look

FAULTS: Mapping[str, tuple[Fault, bool]] = {
    "killed": ("die", False),
    "killed in the middle": ("torn", False),
    "full disk": ("ENOSPC", False),
    "failing disk": ("EIO", True),
    "no database": ("database", False),
    "database fails late": ("database", True),
    "interrupted": ("INT", False),
    "ended": ("TERM", True),
}
"""Faults, and whether the step is done first."""

Allowed = Callable[[State, State, str], bool]
"""Gets what is there, what was before, and how the command went; whether that may be."""


@dataclass(frozen=True)
class Scenario:
    """A command on a store.

    Attributes:
        name: For people.
        command: What is run.
        prepared: On what.
        before: What that answers.
        after: What it answers when the command has come to its end.
        steps: The steps of the command when nothing is in its way.
        allowed: Says whether something in between may be there all the same, since it says
            what is missing.
        again: Whether the command, run once more, comes to its end from there, too.
    """

    name: str
    command: tuple[str, ...]
    prepared: Prepared
    before: State
    after: State
    steps: tuple[str, ...]
    allowed: Allowed | None = None
    again: bool = True


@dataclass
class Bench:
    """What the cases of a module share.

    Attributes:
        server: The mongod.
        stepper: Runs commands.
        path: Where stores are.
        scenarios: Those that were made already, by name.
        two: The store that most of them begin with, once it is made.
    """

    server: Server
    stepper: Stepper
    path: Path
    scenarios: dict[str, Scenario] = field(default_factory=dict)
    two: Prepared | None = None

    def scenario(
        self,
        name: str,
        command: Sequence[str],
        prepared: Prepared,
        *,
        allowed: Allowed | None = None,
        is_opening: bool = False,
        again: bool = True,
        is_clean: bool = True,
        truth: Mapping[str, Content] | None = None,
    ) -> Scenario:
        """A scenario, from what its command does when nothing is in its way.

        Args:
            name: For people.
            command: What is run.
            prepared: On what.
            allowed: See `Scenario`.
            is_opening: Whether opening the store is all that the command does.
            again: See `Scenario`.
            is_clean: Whether `verify` finds nothing in the end.
            truth: What recordings hold in the end, by label.
        """
        with prepared.copy(self.server, self.path / "whole") as case:
            run = self.stepper.run(command, case.path, case.uri, Point("none"))
            assert run.outcome == "done", run
            after = look(case)
        if is_opening:
            before = after
        else:
            with prepared.copy(self.server, self.path / "whole") as case:
                before = look(case)
        assert not (is_clean and after.findings), after.findings
        assert not after.unreadable
        for label, said in (truth or {}).items():
            assert after.recordings[label].holds(said), label
        return Scenario(
            name, tuple(command), prepared, before, after, run.steps, allowed, again=again
        )

    def try_all(self, scenario: Scenario, points: Sequence[Point]) -> int:
        """Disturb the command at each point; returns how many points there were.

        Raises:
            AssertionError: At some of them the store came to harm; says at which, and why.
        """
        problems = []
        tried = 0
        for point in points:
            tried += 1
            problem = self.problem(scenario, point)
            if problem:
                problems.append(problem)
        listed = "\n".join(problems)
        assert not problems, f"{len(problems)} of {tried} points:\n{listed}"
        return tried

    def problem(self, scenario: Scenario, point: Point) -> str | None:
        """What is wrong after the command was disturbed at a point."""
        with scenario.prepared.copy(self.server, self.path / "case") as case:
            run = self.stepper.run(scenario.command, case.path, case.uri, point)
            step = scenario.steps[point.at] if point.at < len(scenario.steps) else "?"
            moment = "after" if point.after else "before"
            where = f"{scenario.name}: {point.fault} {moment} {point.at} ({step}), {run.outcome}"
            try:
                problem = _judge(self, scenario, case, run, has_died=point.fault == "die")
            except WrongError as error:
                problem = str(error)
        return f"{where}: {problem}" if problem else None


def _judge(bench: Bench, scenario: Scenario, case: Case, run: Run, *, has_died: bool) -> str | None:
    if run.outcome == "crash":
        return f"an error that is not told as one:\n{run.message}"
    state = look(case)
    if state == scenario.after:
        return None
    if run.outcome == "done":
        return f"done, and {difference(state, scenario.after)}"
    if state != scenario.before:
        if scenario.allowed is None or not scenario.allowed(state, scenario.before, run.outcome):
            first, second = difference(state, scenario.before), difference(state, scenario.after)
            return f"neither before: {first};\n    nor after: {second}"
        if not scenario.again:
            return None
    if not has_died:
        return None  # what is there is what a process that died has left, too
    once_more = bench.stepper.run(scenario.command, case.path, case.uri, Point("none"))
    if once_more.outcome != "done":
        return f"once more: {once_more.outcome}: {once_more.message}"
    state = look(case)
    if state != scenario.after:
        return f"once more, and {difference(state, scenario.after)}"
    return None


def try_everything(bench: Bench, scenario: Scenario) -> int:
    """Disturb a command in all ways at all of its steps; returns how many points there were."""
    everything = [
        point for fault, after in FAULTS.values() for point in points(scenario, fault, after=after)
    ]
    return bench.try_all(scenario, everything)


def points(scenario: Scenario, fault: Fault, *, after: bool = False) -> list[Point]:
    """All points at which a fault makes a difference."""
    kinds: tuple[str, ...] = ("",)
    if fault == "torn":
        kinds = TORN
    elif fault == "ENOSPC":
        kinds = ALLOCATES
    elif fault == "database":
        kinds = DATABASE
    steps = enumerate(scenario.steps)
    found = [Point(fault, at, after) for at, step in steps if step.startswith(kinds)]
    if fault == "EIO":
        found = [p for p in found if not scenario.steps[p.at].startswith(DATABASE)]
    if fault in {"INT", "TERM"}:  # they take the same way: one at every other step
        found = [p for p in found if p.at % 2 == after]
    if fault == "die" and not after:
        found.append(Point("die", len(scenario.steps) - 1, after=True))
    return found


def difference(state: State, wanted: State) -> str:
    """How two states differ, in words."""
    found = []
    if state.files != wanted.files:
        extra, missing = state.files - wanted.files, wanted.files - state.files
        found.append(f"files too many {sorted(extra)}, too few {sorted(missing)}")
    if state.findings != wanted.findings:
        found.append(f"findings {state.findings} instead of {wanted.findings}")
    if state.unreadable != wanted.unreadable:
        found.append(f"unreadable {state.unreadable}")
    if state.recordings.keys() != wanted.recordings.keys():
        found.append(f"recordings {sorted(state.recordings)}")
    for label, seen in state.recordings.items():
        other = wanted.recordings.get(label)
        if other is None or other == seen:
            continue
        found += [
            f"{label}.{name} is {value!r} instead of {other.entry.get(name)!r}"
            for name, value in seen.entry.items()
            if other.entry.get(name) != value
        ]
        if seen.messages != other.messages:
            found.append(f"{label} has other messages")
        if seen.losses != other.losses:
            found.append(f"{label} has losses {seen.losses} instead of {other.losses}")
    return "; ".join(found)


def says_what_is_missing(seen: Seen, said: Content) -> bool:
    """Whether a recording has nothing but messages of a log, and tells how many are lost."""
    lost = 0
    for topic, part in said.items():
        wanted = [(one.time, one.payload) for one in part]
        there = seen.messages.get(topic, ())
        if not set(there) <= set(wanted) or list(there) != sorted(there):
            return False
        lost += len(wanted) - len(there)
    if not seen.messages.keys() <= said.keys():
        return False
    if lost == 0:
        return True
    return bool(seen.entry["status"] == "damaged" and seen.lost >= lost)


def is_recovered_part(seen: Seen, said: Content) -> bool:
    """Whether a recording holds the beginning of a log, and says that it was cut short."""
    if seen.entry["status"] != "recovered":
        return False
    return all(
        part == tuple((one.time, one.payload) for one in said[topic])[: len(part)]
        for topic, part in seen.messages.items()
    )
