"""From a journal to a report: all sections, in order."""

from __future__ import annotations

from benchmarks.report import (
    ceilings,
    conditions,
    cost,
    load_study,
    noise,
    question_study,
    reading_study,
    stream_study,
)
from benchmarks.report.book import DISTURBED, MEANING, Book
from benchmarks.report.model import Report, Section, Table
from benchmarks.samples import Journal

TITLE = "What a robot's log store can keep, and how fast it answers"


def report(journal: Journal) -> Report:
    """All that a journal's samples say, and nothing that they do not.

    Args:
        journal: Of one or more runs.
    """
    book = Book(journal)
    quick = any(header.get("quick") for header in journal.headers)
    marks = []
    if quick:
        marks.append(
            "This is a quick run: few messages, few repetitions, the ends of each axis. Its "
            "figures are rough; do not cite them."
        )
    marks += noise.warnings(book, journal.headers)
    marks += conditions.warnings(journal.headers)
    findings = [
        *stream_study.findings(book),
        *ceilings.findings(book),
        *cost.findings(book),
        *load_study.findings(book),
        *question_study.findings(book),
        *reading_study.findings(book),
        *conditions.findings(book),
    ]
    if any(DISTURBED in text for text in findings):
        findings.append(MEANING)
    sections = [
        _paper(book),
        conditions.systems(journal.headers),
        stream_study.section(book),
        ceilings.section(book),
        cost.section(book),
        load_study.section(book),
        load_study.speed_up(book),
        question_study.section(book),
        reading_study.section(book),
        cost.timing(book),
        noise.section(book, journal.headers),
        conditions.not_run(book),
        conditions.machine(journal),
    ]
    return Report(
        title=f"{TITLE} (quick run)" if quick else TITLE,
        quick=quick,
        warnings=tuple(marks),
        findings=tuple(findings),
        sections=tuple(one for one in sections if one is not None),
        headers=tuple(journal.headers),
        failed=len(book.bad("failed")),
        differing=tuple(question_study.differing(book)),
    )


def _paper(book: Book) -> Section | None:
    """What the paper says beside what was found."""
    said = [
        *stream_study.paper_says(book),
        *load_study.paper_says(book),
        *question_study.paper_says(book),
    ]
    if not said:
        return None
    table = Table("What the paper found", ("the paper", "here"), tuple(said))
    return Section("paper", "Beside the paper", (), (), (table,))
