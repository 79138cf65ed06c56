"""What comes after a question: messages by time, a message at a time, a table of a topic.

The load is that of a robot which drives through a building. Every backend is filled with
it as fast as it takes it, closed, opened again, and read from. What must come out is
decoded from the load itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from benchmarks.loads.mit_like import mit_like
from benchmarks.questions import run as turns
from benchmarks.questions import tasks
from benchmarks.questions.askers import READERS, SAME
from benchmarks.questions.base import SLOW_S
from benchmarks.questions.run import Turn
from benchmarks.samples import Sample
from benchmarks.studies.runs import Context, chosen

if TYPE_CHECKING:
    from benchmarks.harness.run import Outcome
    from benchmarks.loads.base import Load

STUDY = "reading"
_VERSION = 2
_SIDE = "benchmarks.questions.sides:read"
_USUAL_MEASURES = ("first_ms", "ms", "total_ms", "answer")


@dataclass(frozen=True, slots=True)
class Settings:
    """How much there is to read, and how often.

    Attributes:
        seconds: Of the load.
        repetitions: Of each task; one of which the first takes more than 10 s is done twice.
        backends: Names of those that take part; None for all.
    """

    seconds: float = 30.0
    repetitions: int = 3
    backends: Sequence[str] | None = None

    @classmethod
    def usual(cls, *, quick: bool) -> Settings:
        """Those of a full or of a quick run."""
        return cls(seconds=2.0, repetitions=1) if quick else cls()


def plan(context: Context, settings: Settings | None = None) -> list[Turn]:
    """Every backend's turn, those that the journal has included."""
    settings = settings or Settings.usual(quick=context.quick)
    found = []
    for name, kind in chosen(context.backends, settings.backends).items():
        if kind.kind == "none" or name in SAME:
            continue  # what is not kept cannot be read
        rows = READERS.get(name, {})
        samples = [
            Sample(STUDY, _case(task, settings), row, repetition)
            for row in rows or [name]
            for task in tasks.TASKS
            for repetition in range(settings.repetitions)
        ]
        found.append(Turn(name, rows, samples))
    return found


def run(context: Context, settings: Settings | None = None) -> None:
    """Do what is still to be done."""
    settings = settings or Settings.usual(quick=context.quick)
    truth: dict[tuple[str, int], list[int]] = {}

    def load() -> Load:
        return make_load(context, settings)

    def samples_of(outcome: Outcome, results: Sequence[turns.Result]) -> Iterable[Sample]:
        if results and not truth:
            truth.update(tasks.true_answers(load(), settings.repetitions))
        return [_sample(outcome, result, truth, settings) for result in results]

    for turn in plan(context, settings):
        arguments = {"repetitions": settings.repetitions}
        turns.do(context, turn, side=_SIDE, load=load, arguments=arguments, samples_of=samples_of)


def make_load(context: Context, settings: Settings) -> Load:
    """The load, made once."""
    about = {"version": _VERSION, "seed": context.seed, "seconds": settings.seconds}
    return context.load(
        "reading",
        about,
        lambda directory: mit_like(directory, seconds=settings.seconds, seed=context.seed),
    )


def _sample(
    outcome: Outcome,
    result: turns.Result,
    truth: dict[tuple[str, int], list[int]],
    settings: Settings,
) -> Sample:
    task, repetition = result["task"], result["repetition"]
    error = result.get("error", "")
    values = dict(outcome.values)
    if not error:
        values |= {name: result[name] for name in _USUAL_MEASURES}
        if repetition == 0 and result["total_ms"] > SLOW_S * 1e3:
            values[turns.SLOW] = True
    wanted = Sample(STUDY, _case(task, settings), result["row"], repetition)
    return turns.judged(wanted, values, truth[task, repetition], error)


def _case(task: str, settings: Settings) -> dict[str, Any]:
    return {"task": task, "seconds": settings.seconds}
