"""Study 3: the paper's questions about teleoperation, Table 1, and more.

Every backend is filled with the same load as fast as it takes it, closed, opened again,
and asked in its own language. All answers are known from the plan of the load; one that
is wrong makes the sample a failure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.loads.hcr_like import hcr_like
from benchmarks.loads.truth import Truth
from benchmarks.questions import run as turns
from benchmarks.questions.askers import ASKERS
from benchmarks.questions.base import QUESTIONS, true_answers
from benchmarks.questions.run import Turn
from benchmarks.samples import Sample, Scale
from benchmarks.studies.runs import Context, chosen

if TYPE_CHECKING:
    from benchmarks.harness.run import Outcome
    from benchmarks.loads.base import Load

STUDY = "queries"
_SIDE = "benchmarks.questions.sides:ask"


class Settings(NamedTuple):
    """How much there is to ask about, and how often it is asked.

    Attributes:
        sessions: Of the load.
        minutes: Length of each session, at least 1.
        repetitions: Of each question, for the first time since the backend was opened, and
            after one of those; what takes more than 10 s is asked twice in all.
    """

    sessions: int
    minutes: float
    repetitions: int


SETTINGS: dict[Scale, Settings] = {
    "full": Settings(4, 10.0, 5),
    "quick": Settings(2, 5.0, 3),
    "tiny": Settings(1, 1.0, 1),
}


def plan(context: Context) -> list[Turn]:
    """Every backend's turn, those that the journal has included."""
    settings = SETTINGS[context.scale]
    return [
        Turn(
            name,
            ASKERS[name],
            [
                Sample(STUDY, _case(question, settings), name, repetition)
                for question in QUESTIONS
                for repetition in range(settings.repetitions)
            ],
        )
        for name in chosen(context.backends, list(ASKERS))
    ]


def run(context: Context) -> None:
    """Do what is still to be done."""
    settings = SETTINGS[context.scale]

    def load() -> Load:
        return make_load(context, settings)

    def samples_of(outcome: Outcome, results: Sequence[turns.Result]) -> Iterable[Sample]:
        truth = true_answers(Truth.open(load().payloads.parent))
        # The last that was told of a question has all its times.
        latest = {result["question"]: result for result in results}
        for result in latest.values():
            yield from _samples(outcome, result, truth, settings)

    arguments = {"questions": list(QUESTIONS), "repetitions": settings.repetitions}
    for turn in plan(context):
        turns.do(context, turn, side=_SIDE, load=load, arguments=arguments, samples_of=samples_of)


def make_load(context: Context, settings: Settings) -> Load:
    """The load, made once; its truth lies beside it."""
    sessions, minutes, _ = settings
    about = {"seed": context.seed, "sessions": sessions, "minutes": minutes}
    return context.load(
        "questions",
        about,
        lambda directory: hcr_like(
            directory, seed=context.seed, sessions=sessions, minutes=minutes
        ),
    )


def _samples(
    outcome: Outcome, result: turns.Result, truth: dict[str, Any], settings: Settings
) -> Iterable[Sample]:
    """One sample a repetition; of a question that was slow, one for each time it was asked."""
    question = result["question"]
    error = result.get("error", "")
    values = dict(outcome.values)
    first_times: list[float] = [] if error else result["cold_ms"]
    times: list[float] = [] if error else result["ms"]
    if not error:
        values["answer"] = result["answer"]
    if not times:
        values[turns.SLOW] = True
        times = first_times or [0.0]
    for repetition, ms in enumerate(times):
        wanted = Sample(STUDY, _case(question, settings), result["row"], repetition)
        timed = dict(values)
        if not error:
            timed["ms"] = ms
            if repetition < len(first_times):  # fewer when the side was ended
                timed["cold_ms"] = first_times[repetition]
        yield turns.judged(wanted, timed, truth[question], error)


def _case(question: str, settings: Settings) -> dict[str, Any]:
    return {"question": question, "sessions": settings.sessions, "minutes": settings.minutes}
