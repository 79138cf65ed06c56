"""What comes after a question: messages by time, a message at a time, a table of a topic.

The load is the log of a robot. Every backend is filled with it as fast as it takes it,
closed, opened again, and read from. What must come out is decoded from the load itself.
"""

from __future__ import annotations

from typing import NamedTuple

from benchmarks.questions import tasks
from benchmarks.questions.run import judged, turns
from benchmarks.samples import Sample, Scale
from benchmarks.studies import logs
from benchmarks.studies.runs import Context

STUDY = "reading"


class Settings(NamedTuple):
    """How much there is to read, and how often.

    Attributes:
        seconds: Of the load.
        repetitions: Of each task.
    """

    seconds: int
    repetitions: int


SETTINGS: dict[Scale, Settings] = {
    "full": Settings(30, 3),
    "tiny": Settings(2, 1),
}


def run(context: Context) -> None:
    """Read all from all."""
    seconds, repetitions = SETTINGS[context.scale]
    load = logs.make_load(context, seconds)
    truth = tasks.true_answers(load, repetitions)
    for name, outcome, results in turns(context, "read", load, repetitions):
        for task in tasks.TASKS:
            found = results.get(task, [None] * repetitions)
            for repetition, result in enumerate(found):
                wanted = Sample(STUDY, {"task": task, "seconds": seconds}, name, repetition)
                context.journal.add(judged(wanted, outcome, result, truth[task, repetition]))
