"""Study 3 in a report: the paper's four questions, Table 1."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from benchmarks.report.book import Book, by_backend, by_case, middle, named, repetitions, value
from benchmarks.report.look import OURS, databases, title
from benchmarks.report.model import Cell, Graph, Line, Panel, Section, Table
from benchmarks.report.numbers import faster, listed
from benchmarks.report.paper import QUERY_MS
from benchmarks.samples import Sample

STUDY = "queries"
QUESTION = "question"
MS = "ms"
FIRST_MS = "cold_ms"
TASK = "task"
ANSWER = "answer"

_PAPER = ("Q1", "Q2", "Q3", "Q4")

_PAPER_ROWS = (
    ("mongo_json", "MongoDB"),
    ("mongo_json_indexed", "MongoDB (indexed)"),
    ("postgres", "PostgreSQL"),
    ("postgres_indexed", "PostgreSQL (indexed)"),
    ("sqlite_udf", "SQLite (Python functions)"),
)


def section(book: Book) -> Section | None:
    """Table 1 with the paper's own beside it; None without samples."""
    samples = book.good(STUDY)
    if not samples:
        return None
    text = [
        "The paper's questions, each in the language of the system that is asked. Q1: how often "
        "was the right gripper closed. Q2: every viewpoint that was behind the robot. Q3: how "
        "often was the gripper moved within a region. Q4: how many grasps with the camera in "
        "front, within a time window of half a second to either side, as in the paper's code.",
        "Beside these stand what the paper only names, and what is asked of logs. Q2 positions: "
        "the coordinates of the viewpoints of Q2, as a frame. Q4 ±0.1 s: Q4 within a tenth of a "
        "second, as in the paper's text. Viewpoint changes: how often the user changed the "
        "viewpoint. Closed minutes: minutes, none of which overlap, in which the gripper was "
        "closed. Before errors: messages of all topics in the five minutes before each error, "
        "each counted once.",
        "hybridlog has four rows: through pymongo, word for word what MongoDB is asked, and the "
        "same questions through its own API; each without and with the indexes that the indexed "
        "row of MongoDB has: the paper's, and one on the time of every topic. MongoDB is asked "
        "with the filters of the paper's appendix; Q4 counts the rows that were found, and what "
        "the paper only names is asked in our words.",
        "Its API keeps fields that were asked about in memory, so that its medians are those of "
        "somebody who explores. Each of its rows begins with nothing kept: what it finds are "
        "documents, segments, and the columns that were laid down beside those when the load was "
        "recorded. The first times are of somebody who then asks one question after the other, "
        "in the order of the table: what one of them has brought into memory, a server's or "
        "hybridlog's, the next ones find there. Q1, Q2 and Q3 are about a topic each.",
        "Each backend was closed, its server too, and opened again before it was asked for the "
        "first time. Rows of one backend share its files, which the first of them brings into "
        "the machine's memory. What took more than ten seconds was asked twice, both "
        "times for the first time since it was opened.",
    ]
    wrong = differing(book)
    if wrong:
        text.append(
            f"The answers to {listed(wrong)} DIFFER between backends; their times mean nothing."
        )
    else:
        text.append(
            "Every backend gave the same answers, and they are those of the plan of the load."
        )
    asked = _questions(samples)
    tables = [
        _table(
            samples, "Table 1: milliseconds for each question", [q for q in asked if q in _PAPER]
        ),
        _paper(),
    ]
    others = [q for q in asked if q not in _PAPER]
    first = _table(samples, "The first time, milliseconds", asked, FIRST_MS)
    if any(cell is not None for row in first.rows for cell in row[1:]):
        tables.append(first)
    if others:
        tables.insert(2, _table(samples, "What the paper names besides, milliseconds", others))
    return Section(
        "queries", "Study 3: questions", tuple(text), tuple(_graphs(samples)), tuple(tables)
    )


def differing(book: Book) -> list[str]:
    """Names of the questions to which not every backend gave the same answer.

    An answer that was found wrong makes its sample a failure; it is counted here all the same.
    """
    answers: dict[str, set[str]] = {}
    names: dict[str, str] = {}
    for one in book.all:
        name = one.case.get(QUESTION) or one.case.get(TASK)
        if ANSWER in one.values and name is not None:
            # Only the same question about the same data has the same answer.
            place = json.dumps([one.study, dict(one.case), one.repetition], sort_keys=True)
            answers.setdefault(place, set()).add(json.dumps(one.values[ANSWER], sort_keys=True))
            names[place] = str(name)
    return list(dict.fromkeys(names[place] for place, found in answers.items() if len(found) > 1))


def findings(book: Book) -> list[str]:
    """Our best times against the fastest database's, question by question."""
    samples = book.good(STUDY)
    found = []
    wrong = differing(book)
    if wrong:
        found.append(f"The backends do not agree on {listed(wrong)}: that is a mistake.")
    shown: dict[str, list[str]] = {"paper": [], "besides": [], "first": []}
    for (question,), group in by_case(samples, QUESTION).items():
        about = "paper" if question in _PAPER else "besides"
        for place, measure in ((about, MS), ("first", FIRST_MS)):
            told = _compared(_medians(group, measure))
            if told is not None:
                shown[place].append(f"{question} {told}")
    beginnings = {
        "paper": "Questions",
        "besides": "What the paper names besides",
        "first": "Asked for the first time",
    }
    found.extend(
        f"{beginnings[place]}, the fastest of hybridlog's rows beside the fastest of the "
        f"databases: {listed(texts)}."
        for place, texts in shown.items()
        if texts
    )
    return found


def _compared(medians: Mapping[str, float]) -> str | None:
    """The fastest of several rows on either side: with and without indexes."""
    others = [name for name in databases(medians) if medians[name]]
    ours = [name for name in medians if name.startswith(OURS)]
    if not ours or not others:
        return None
    mine = min(ours, key=lambda name: medians[name])
    best = min(others, key=lambda name: medians[name])
    return faster(medians[mine], medians[best], title(best))


def paper_says(book: Book) -> list[tuple[str, str]]:
    """The paper's ranking beside the one found here."""
    slowest = []
    for (question,), group in by_case(book.good(STUDY), QUESTION).items():
        if question not in _PAPER:
            continue
        medians = _medians(group)
        medians = {name: medians[name] for name in databases(medians)}
        if len(medians) > 1:
            fast = min(medians, key=lambda name: medians[name])
            slow = max(medians, key=lambda name: medians[name])
            slowest.append(f"{question} {title(fast)} and {title(slow)}")
    if not slowest:
        return []
    return [
        (
            "MongoDB answers fastest, SQLite slowest, and an index changes little.",
            f"The fastest and the slowest of the databases: {'; '.join(slowest)}.",
        )
    ]


def _medians(samples: Sequence[Sample], measure: str = MS) -> dict[str, float]:
    found = {name: middle(of, named(measure)) for name, of in by_backend(samples).items()}
    return {name: one for name, one in found.items() if one is not None}


def _graphs(samples: Sequence[Sample]) -> list[Graph]:
    asked = _questions(samples)
    paper = [q for q in asked if q in _PAPER]
    others = [q for q in asked if q not in _PAPER]
    graphs = []
    if paper:
        graphs.append(_graph(samples, "table-1", "Table 1 as a picture: time for each", paper))
    if others:
        graphs.append(_graph(samples, "questions", "Time for what the paper names besides", others))
    return graphs


def _graph(samples: Sequence[Sample], key: str, heading: str, questions: Sequence[str]) -> Graph:
    lines = tuple(
        Line(
            name,
            tuple(
                (question, one)
                for question in questions
                if (one := value(_asked(group, question), named(MS))) is not None
            ),
        )
        for name, group in by_backend(samples).items()
    )
    return Graph(
        key,
        heading,
        f"Logarithmic; less is better. Median of {repetitions(samples)}; the bars reach from the "
        "least to the greatest.",
        "bars",
        (Panel("", lines),),
        "",
        "ms",
        log_y=True,
    )


def _questions(samples: Sequence[Sample]) -> list[str]:
    """The questions in the order in which they were asked."""
    return list(dict.fromkeys(str(one.case[QUESTION]) for one in samples if QUESTION in one.case))


def _asked(samples: Sequence[Sample], question: str) -> list[Sample]:
    return [one for one in samples if one.case.get(QUESTION) == question]


def _table(
    samples: Sequence[Sample], heading: str, questions: Sequence[str], measure: str = MS
) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, group in by_backend(samples).items():
        of = by_case(group, QUESTION)
        rows.append((title(name), *(value(of.get((q,), []), named(measure)) for q in questions)))
    return Table(
        heading,
        ("backend", *questions),
        tuple(rows),
        f"Median (least…greatest) of {repetitions(samples)}.",
        title(OURS),
    )


def _paper() -> Table:
    return Table(
        "The paper's Table 1, milliseconds",
        ("system", *_PAPER),
        tuple((shown, *QUERY_MS[name]) for name, shown in _PAPER_ROWS),
        "Other data (the HCR recordings), another machine, the systems of that time: only the "
        "order can be compared.",
    )
