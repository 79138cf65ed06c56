"""Study 3: the paper's questions about teleoperation, Table 1, and three more.

Every backend is filled with the same load as fast as it takes it, closed, opened again,
and asked in its own language. All answers are known from the plan of the load; one that
is wrong makes the sample a failure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from benchmarks.loads.hcr_like import hcr_like
from benchmarks.loads.truth import Truth
from benchmarks.questions import run as turns
from benchmarks.questions.askers import ASKERS, SAME
from benchmarks.questions.base import QUESTIONS, true_answers
from benchmarks.questions.run import Turn
from benchmarks.samples import Sample
from benchmarks.studies.runs import Context, chosen

if TYPE_CHECKING:
    from benchmarks.harness.run import Outcome
    from benchmarks.loads.base import Load

STUDY = "queries"
_VERSION = 2
"""Goes up when the generator makes other messages from the same seed."""
_SIDE = "benchmarks.questions.sides:ask"


@dataclass(frozen=True, slots=True)
class Settings:
    """How much there is to ask about, and how often it is asked.

    Attributes:
        sessions: Of the load.
        minutes: Length of each session, at least 1.
        repetitions: Of each question, for the first time since the backend was opened, and
            after one of those; what takes more than 10 s is asked twice in all.
        backends: Names of those that take part; None for all.
    """

    sessions: int = 8
    minutes: float = 10.0
    repetitions: int = 5
    backends: Sequence[str] | None = None

    @classmethod
    def usual(cls, *, quick: bool) -> Settings:
        """Those of a full or of a quick run."""
        return cls(sessions=1, minutes=4.0, repetitions=1) if quick else cls()


def plan(context: Context, settings: Settings | None = None) -> list[Turn]:
    """Every backend's turn, those that the journal has included."""
    settings = settings or Settings.usual(quick=context.quick)
    found = []
    for name, kind in chosen(context.backends, settings.backends).items():
        if kind.kind == "none" or name in SAME:
            continue  # what is not kept cannot be asked about
        rows = ASKERS.get(name, {})
        samples = [
            Sample(STUDY, _case(question, settings), row, repetition)
            for row in rows or [name]
            for question in QUESTIONS
            for repetition in range(settings.repetitions)
        ]
        found.append(Turn(name, rows, samples))
    return found


def run(context: Context, settings: Settings | None = None) -> None:
    """Do what is still to be done."""
    settings = settings or Settings.usual(quick=context.quick)

    def load() -> Load:
        return make_load(context, settings)

    def samples_of(outcome: Outcome, results: Sequence[turns.Result]) -> Iterable[Sample]:
        directory = load().payloads.parent
        truth = true_answers(Truth.open(directory))
        # The last that was told of a question has all its times.
        latest = {(result["row"], result["question"]): result for result in results}
        for result in latest.values():
            yield from _samples(outcome, result, truth, settings)

    arguments = {"questions": list(QUESTIONS), "repetitions": settings.repetitions}
    for turn in plan(context, settings):
        turns.do(context, turn, side=_SIDE, load=load, arguments=arguments, samples_of=samples_of)


def make_load(context: Context, settings: Settings) -> Load:
    """The load, made once; its truth lies beside it."""
    about = {
        "version": _VERSION,
        "seed": context.seed,
        "sessions": settings.sessions,
        "minutes": settings.minutes,
    }
    return context.load(
        "questions",
        about,
        lambda directory: hcr_like(
            directory, seed=context.seed, sessions=settings.sessions, minutes=settings.minutes
        ),
    )


def _samples(
    outcome: Outcome, result: turns.Result, truth: dict[str, Any], settings: Settings
) -> Iterable[Sample]:
    """One sample a repetition; of a question that was slow, one for each time it was asked."""
    question = result["question"]
    error = result.get("error", "")
    values = dict(outcome.values)
    if result["index_bytes"] is not None:
        values["index_bytes"] = result["index_bytes"]
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
