"""What the paper stops short of: the largest load of which a backend keeps everything."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

from benchmarks.report.book import MB, Book, by_backend
from benchmarks.report.look import OURS, databases, ordered, title
from benchmarks.report.model import Cell, Graph, Line, Panel, Section, Table, Value
from benchmarks.report.numbers import counted, listed, number, size, times, with_spread
from benchmarks.studies.ceiling import HARNESS, STUDY, Ceiling
from benchmarks.studies.ceiling import ceilings as found_in

if TYPE_CHECKING:
    from benchmarks.samples import Sample

_NOTE = (
    "≥: the ceiling is above; the harness could offer no more (harness), or no higher rate was "
    "planned (plan), or the search was stopped before its end (stopped), in one of the searches "
    "at least. none: something was dropped at every rate that was tried."
)

_LIMITS = ("stopped", "harness", "plan", "backend")
"""What may end a search: that which says least of the backend comes first."""


@dataclass(frozen=True, slots=True)
class _Found:
    """What all searches found for one backend and one message size.

    Attributes:
        backend: Name.
        size: Bytes of a message.
        searches: One or more.
    """

    backend: str
    size: int
    searches: Sequence[Ceiling]

    @property
    def offered(self) -> Value:
        """MB/s; 0 is that of a search in which every rate was too much."""
        return self.of(lambda one: one.offered_bytes_s / MB)

    @property
    def is_none(self) -> bool:
        """Whether something was lost at every rate in every search."""
        return all(one.rate is None for one in self.searches)

    @property
    def limit(self) -> str:
        """What ended the searches; `backend` only if it ended all of them."""
        found = {one.limit for one in self.searches}
        return next(limit for limit in _LIMITS if limit in found)

    def of(self, measure: Callable[[Ceiling], float]) -> Value:
        """One measure of the searches."""
        found = Value.of(map(measure, self.searches))
        assert found is not None
        return found


_Text = Callable[[_Found], str | None]


def section(book: Book) -> Section | None:
    """Ceilings in MB/s and messages/s, and ours over the best database's."""
    ceilings = _ceilings(book, book.all)
    if not ceilings:
        return None
    text = (
        "The rate is doubled until a message is dropped, then the gap is halved a few times, not "
        "so in a quick run. The ceiling is the largest offered load of which everything was found "
        "in the backend afterwards, known to about half of the last step. Each trial is one run, "
        "and chance has a say in the last ones, so the whole search is made anew for each "
        "repetition.",
        "A trial is short, longer only where the rate is so low that it would have few messages: "
        "what a backend can put off (messages in memory, dirty pages, a journal, work after the "
        "last message) helps it, hybridlog most of all. “Stored” divides by the time until "
        "everything was on the disk.",
    )
    return Section(
        "ceilings",
        "How much each can take",
        text,
        (_graph(ceilings),),
        (
            _table(ceilings, "Ceiling: offered load of which all was kept, MB/s", _megabytes),
            _table(ceilings, "The same in messages/s, all topics together", _messages(book)),
            _table(ceilings, "Stored at that load, MB/s, all work included", _kept, ""),
            *_ratios(book, ceilings),
        ),
    )


def findings(book: Book) -> list[str]:
    """Our ceiling against the best database's, at every size."""
    ceilings = _ceilings(book, book.all)
    found = []
    for bytes_ in sorted({one.size for one in ceilings}):
        of_size = [one for one in ceilings if one.size == bytes_]
        pair = _pair(of_size)
        if pair is None:
            continue
        ours, best = pair
        marked = " or more" if ours.limit != "backend" else ""
        turns = ""
        if (both := _in_same_runs(book, ours, best)) is not None:
            mine, other = both
            turns = (
                f" In the runs of both: {with_spread(mine)} and {with_spread(other)} MB/s, "
                f"{times(mine.median / other.median)}."
            )
        found.append(
            f"With {size(bytes_)} messages, hybridlog keeps everything up to "
            f"{with_spread(ours.offered)} MB/s{marked}, "
            f"{times(ours.offered.median / best.offered.median)} what the best database does "
            f"({title(best.backend)}, {with_spread(best.offered)} MB/s)."
            f"{turns}"
        )
    short = [one for one in ceilings if one.backend == OURS and one.limit == "harness"]
    if short:
        places = listed([size(one.size) for one in short])
        found.append(
            f"At {places} the harness, not hybridlog, was at its limit: publisher and logger "
            "share the machine."
        )
    return found


def _in_same_runs(book: Book, ours: _Found, best: _Found) -> tuple[Value, Value] | None:
    """MB/s of the two where they took turns, if not always: a machine is faster on one day."""
    of_size = (s for s in book.all if s.study == STUDY and s.case["size"] == ours.size)
    known = by_backend(of_size)
    groups = known[ours.backend], known[best.backend]
    both = book.in_same_runs(*groups)
    if both is None or list(map(len, both)) == list(map(len, groups)):
        return None
    pair = _pair(_ceilings(book, chain(*both)))
    return None if pair is None else (pair[0].offered, pair[1].offered)


def _ceilings(book: Book, samples: Iterable[Sample]) -> list[_Found]:
    searches: dict[tuple[str, int], list[Ceiling]] = {}
    for one in found_in(samples, book.settings):
        searches.setdefault((one.backend, one.size), []).append(one)
    return [_Found(backend, bytes_, of) for (backend, bytes_), of in searches.items()]


def _pair(of_size: Sequence[_Found]) -> tuple[_Found, _Found] | None:
    """Ours, and the best of the databases; None when either has no ceiling."""
    known = {one.backend: one for one in of_size if one.offered.median}
    others = databases(known)
    if OURS not in known or not others:
        return None
    best = max(others, key=lambda name: known[name].offered.median)
    return known[OURS], known[best]


def _graph(ceilings: Sequence[_Found]) -> Graph:
    lines = []
    for name in ordered(one.backend for one in ceilings):
        # The axis is logarithmic: 0 has no place on it.
        of = [one for one in ceilings if one.backend == name and one.offered.median]
        points = [(float(one.size), one.offered) for one in sorted(of, key=lambda one: one.size)]
        lines.append(Line(name, tuple(points)))
    sizes = sorted({one.size for one in ceilings})
    floor = (
        " Where the line of “harness alone” is reached, the harness can offer no more through its "
        "queues."
        if any(line.backend == HARNESS for line in lines)
        else ""
    )
    return Graph(
        "ceilings",
        "Largest load of which everything is kept",
        "Offered load over message size, both axes logarithmic. Median of "
        f"{_searches(ceilings)}; the bars reach from the least to the greatest.{floor}",
        "lines",
        (Panel("", tuple(lines)),),
        "message size",
        "MB/s",
        log_x=True,
        log_y=True,
        ticks=tuple((float(one), size(one)) for one in sizes),
    )


def _table(ceilings: Sequence[_Found], heading: str, text: _Text, note: str = _NOTE) -> Table:
    sizes = sorted({one.size for one in ceilings})
    by_place = {(one.backend, one.size): one for one in ceilings}
    rows = tuple(
        (
            title(name),
            *(
                None if (one := by_place.get((name, bytes_))) is None else text(one)
                for bytes_ in sizes
            ),
        )
        for name in ordered(one.backend for one in ceilings)
    )
    note = f"Median (least…greatest) of {_searches(ceilings)}. {note}".rstrip()
    return Table(heading, ("backend", *map(size, sizes)), rows, note, title(OURS))


def _searches(ceilings: Sequence[_Found]) -> str:
    return counted([len(one.searches) for one in ceilings], "search", "searches")


def _megabytes(one: _Found) -> str:
    return _bound(one, one.offered)


def _bound(one: _Found, value: Value) -> str:
    if one.is_none:
        return "none so far (stopped)" if one.limit == "stopped" else "none"
    return with_spread(value) if one.limit == "backend" else f"≥ {with_spread(value)} ({one.limit})"


def _kept(one: _Found) -> str | None:
    return None if one.is_none else with_spread(one.of(lambda each: each.stored_bytes_s / MB))


def _messages(book: Book) -> _Text:
    topics = {
        one.case.get("size"): one.case.get("topics") for one in book.all if one.study == STUDY
    }

    def text(one: _Found) -> str | None:
        count = topics.get(one.size)
        if one.is_none or not isinstance(count, int):
            return None
        return _bound(one, one.of(lambda each: (each.rate or 0.0) * count))

    return text


def _ratios(book: Book, ceilings: Sequence[_Found]) -> list[Table]:
    """Of all searches, and of those in which the two took turns, where these are others."""
    sizes = sorted({one.size for one in ceilings})
    pairs = [_pair([one for one in ceilings if one.size == bytes_]) for bytes_ in sizes]
    if not any(pairs):
        return []
    offered = [pair and (pair[0].offered, pair[1].offered) for pair in pairs]
    both = [pair and _in_same_runs(book, *pair) for pair in pairs]
    rows: list[tuple[Cell, ...]] = [("ratio", *map(_ratio, offered))]
    if any(both):
        rows.append(("in the runs of both", *map(_ratio, both)))
    rows.append(("best database", *(pair and title(pair[1].backend) for pair in pairs)))
    return [
        Table("hybridlog's ceiling over the best database's", ("", *map(size, sizes)), tuple(rows))
    ]


def _ratio(pair: tuple[Value, Value] | None) -> str | None:
    return None if pair is None else number(pair[0].median / pair[1].median)
