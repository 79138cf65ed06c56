"""Study 3: the paper's questions about teleoperation, Table 1, and more.

Every backend is filled with the same load as fast as it takes it, closed, opened again,
and asked in its own language. All answers are known from the plan of the load; one that
is wrong makes the sample a failure.
"""

from __future__ import annotations

from typing import NamedTuple

from benchmarks.loads.hcr_like import hcr_like, true_answers
from benchmarks.questions.base import QUESTIONS
from benchmarks.questions.run import judged, turns
from benchmarks.samples import Sample, Scale
from benchmarks.studies.runs import Context

STUDY = "queries"


class Settings(NamedTuple):
    """How much there is to ask about, and how often it is asked.

    Attributes:
        sessions: Of the load.
        minutes: Length of each session, at least 1.
        repetitions: Of each question, for the first time since the backend was opened, and
            after one of those.
    """

    sessions: int
    minutes: float
    repetitions: int


SETTINGS: dict[Scale, Settings] = {
    "full": Settings(4, 10.0, 5),
    "tiny": Settings(1, 1.0, 1),
}


def run(context: Context) -> None:
    """Ask all of all."""
    sessions, minutes, repetitions = SETTINGS[context.scale]
    about = {"sessions": sessions, "minutes": minutes}
    seed = context.seed
    load = context.load(
        "questions",
        {**about, "seed": seed},
        lambda place: hcr_like(place, seed=seed, sessions=sessions, minutes=minutes),
    )
    truth = true_answers(load)
    for name, outcome, results in turns(context, "ask", load, repetitions):
        for question in QUESTIONS:
            case = {"question": question, **about}
            result = results.get(question)
            for repetition in range(repetitions):
                wanted = Sample(STUDY, case, name, repetition)
                one = result
                if result is not None and "error" not in result:
                    times = {key: result[key][repetition] for key in ("ms", "cold_ms")}
                    one = {**result, **times}
                context.journal.add(judged(wanted, outcome, one, truth[question]))
