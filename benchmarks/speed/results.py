"""What a benchmark finds: samples, and what follows from them."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Literal

from benchmarks.side import Values

Relation = Literal[">=", "<=", "<"]


@dataclass(frozen=True, slots=True)
class Sample:
    """One run of one side.

    Attributes:
        study: Name of the study.
        side: Which of the sides.
        repetition: From 0.
        values: What the side measured, by name; units stand in the names.
    """

    study: str
    side: str
    repetition: int
    values: Values

    def to_json(self) -> Values:
        """As one line of the results."""
        return {"kind": "sample", **asdict(self)}


@dataclass(frozen=True, slots=True)
class Finding:
    """One figure, and its target when there is one.

    Attributes:
        study: Name of the study.
        about: What is compared with what, or measured.
        value: The median.
        low: The least of the repetitions.
        high: The greatest of the repetitions.
        unit: `x` for ratios, else what follows the number.
        relation: How the value must stand to the target.
        target: None when the figure is for information.
        aim: The target is an aim: missing it fails nothing.
    """

    study: str
    about: str
    value: float
    low: float
    high: float
    unit: str = "x"
    relation: Relation = ">="
    target: float | None = None
    aim: bool = False

    @property
    def passed(self) -> bool | None:
        """Whether the target is met; None without one."""
        if self.target is None:
            return None
        if self.relation == ">=":
            return self.value >= self.target
        return self.value <= self.target if self.relation == "<=" else self.value < self.target

    def to_json(self) -> Values:
        """As one line of the results."""
        return {"kind": "finding", **asdict(self), "passed": self.passed}


@dataclass(slots=True)
class Outcome:
    """Everything a run has found.

    Attributes:
        header: Machine, versions, settings and seeds.
        samples: In the order of the runs.
        findings: In the order of the studies.
    """

    header: Values
    samples: list[Sample] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def lines(self) -> list[Values]:
        """As lines of JSON: the header, the samples, the findings."""
        return [
            {"kind": "run", **self.header},
            *(sample.to_json() for sample in self.samples),
            *(finding.to_json() for finding in self.findings),
        ]


def values_of(samples: Sequence[Sample], side: str, name: str) -> list[float]:
    """One value of one side, by repetition."""
    return [float(s.values[name]) for s in samples if s.side == side]


def ratio(
    study: str,
    about: str,
    above: Sequence[float],
    below: Sequence[float],
    *,
    target: float | None = None,
    relation: Relation = ">=",
    aim: bool = False,
) -> Finding:
    """A ratio of medians; its spread is that of the repetitions, pair by pair.

    Args:
        study: Name of the study.
        about: What is compared with what.
        above: The numerator, one value a repetition.
        below: The denominator, in the same order.
        target: What the ratio must reach.
        relation: How it must stand to the target.
        aim: The target is an aim only.
    """
    pairs = [a / b for a, b in zip(above, below, strict=True)]
    value = statistics.median(above) / statistics.median(below)
    return Finding(study, about, value, min(pairs), max(pairs), "x", relation, target, aim=aim)


def figure(
    study: str,
    about: str,
    values: Sequence[float],
    unit: str,
    *,
    target: float | None = None,
    relation: Relation = "<",
) -> Finding:
    """A median with its spread."""
    value = statistics.median(values)
    return Finding(study, about, value, min(values), max(values), unit, relation, target)
