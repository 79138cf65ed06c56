"""What comes after a question: messages by time, a message at a time, a table of a topic.

The load is the log of a robot. Every backend is filled with it as fast as it takes it,
closed, opened again, and read from. What must come out is decoded from the load itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.questions import run as turns
from benchmarks.questions import tasks
from benchmarks.questions.askers import READERS
from benchmarks.questions.base import SLOW_S
from benchmarks.questions.run import Turn
from benchmarks.samples import Sample, Scale
from benchmarks.studies import logs
from benchmarks.studies.runs import Context, chosen

if TYPE_CHECKING:
    from benchmarks.harness.run import Outcome
    from benchmarks.loads.base import Load

STUDY = "reading"
_SIDE = "benchmarks.questions.sides:read"
_USUAL_MEASURES = ("first_ms", "ms", "total_ms", "answer")


class Settings(NamedTuple):
    """How much there is to read, and how often.

    Attributes:
        seconds: Of the load.
        repetitions: Of each task; one of which the first takes more than 10 s is done twice.
    """

    seconds: int
    repetitions: int


SETTINGS: dict[Scale, Settings] = {
    "full": Settings(30, 3),
    "quick": Settings(20, 2),
    "tiny": Settings(2, 1),
}


def plan(context: Context) -> list[Turn]:
    """Every backend's turn, those that the journal has included."""
    settings = SETTINGS[context.scale]
    return [
        Turn(
            name,
            READERS[name],
            [
                Sample(STUDY, _case(task, settings), name, repetition)
                for task in tasks.TASKS
                for repetition in range(settings.repetitions)
            ],
        )
        for name in chosen(context.backends, list(READERS))
    ]


def run(context: Context) -> None:
    """Do what is still to be done."""
    settings = SETTINGS[context.scale]
    truth: dict[tuple[str, int], list[int]] = {}

    def load() -> Load:
        return logs.make_load(context, settings.seconds)

    def samples_of(outcome: Outcome, results: Sequence[turns.Result]) -> Iterable[Sample]:
        if results and not truth:
            truth.update(tasks.true_answers(load(), settings.repetitions))
        return [_sample(outcome, result, truth, settings) for result in results]

    for turn in plan(context):
        arguments = {"repetitions": settings.repetitions}
        turns.do(context, turn, side=_SIDE, load=load, arguments=arguments, samples_of=samples_of)


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
