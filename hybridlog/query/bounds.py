"""Leaves out recordings whose bounds exclude every match.

Bounds are the least and the greatest number of a field of a topic in a recording. Columns that
answer a question about many recordings tell them, the catalog keeps them, and later questions
open only files in which something may match. They are known only where columns alone can
answer: not for messages without fields, for running recordings, or for lost segments.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import takewhile
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.query.predicate.numbers import is_nan, is_number
from hybridlog.query.predicate.tree import And, Compare, Field, Member, Or, is_meta, nodes
from hybridlog_storage.catalog import content_of

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.predicate.tree import Node, Parts, Predicate
    from hybridlog.query.question import Part, Question
    from hybridlog.query.ranges import Ranges
    from hybridlog.session import Session
    from hybridlog_storage.catalog import Catalog, Ends

MIN_RECORDINGS: Final = 16
"""Fewer recordings are asked by their columns: to leave some out saves little."""
_ROUNDED = 1e-6  # most relative error of a mean
_MAY: Final[Mapping[str, Callable[[float, float, float], bool]]] = {
    "<": lambda low, _, wanted: low < wanted,
    "<=": lambda low, _, wanted: low <= wanted,
    ">": lambda _, high, wanted: high > wanted,
    ">=": lambda _, high, wanted: high >= wanted,
    "==": lambda low, high, wanted: low <= wanted <= high,
}
"""Whether a number between two ends may satisfy a comparison."""
_NONE: Final[Ends] = (None, None)


def key_of(topic: str, path: str) -> str:
    """A word for a field of a topic."""
    return hashlib.sha256(f"{topic}\n{path}".encode()).hexdigest()[:16]


def within_bounds(session: Session, question: Question, found: Ranges) -> Ranges:
    """The recordings of a question that may have matching messages."""
    assert question.predicate is not None
    root = question.predicate.root
    fields = _bounded(root)
    if len(found) < MIN_RECORDINGS or not fields:
        return found
    snapshot = session.snapshot()
    paths = {path for one in fields for path in _paths(one)}
    may = snapshot.is_open[found.places].copy()
    for topic in question.topics:
        has = np.isin(found.places, snapshot.having([topic]))
        known = {path: session.catalog.bounds(key_of(topic, path)) for path in paths}
        if not any(known.values()):
            may |= has
        for row in np.flatnonzero(has & ~may).tolist():
            content = snapshot.summaries[found.places[row]].content
            here = {path: ends[content] for path, ends in known.items() if content in ends}
            may[row] = may_hold(root, here)
    return found if may.all() else found.take(np.flatnonzero(may))


def _bounded(root: Node) -> list[Field]:
    """The fields of conditions that bounds may exclude."""
    return [
        node.field
        for node in nodes(root)
        if isinstance(node, Compare | Member) and not is_meta(node.field.path)
    ]


def _paths(target: Field) -> list[str]:
    """The paths of which bounds tell about a field: its own, and those it goes through."""
    names = [*takewhile(lambda part: isinstance(part, str), target.parts)]
    return [".".join(map(str, names[:end])) for end in range(1, len(names) + 1)]


def may_hold(node: Node, bounds: Mapping[str, Ends]) -> bool:
    """False if a predicate holds for no message.

    Args:
        node: The predicate.
        bounds: The fields with bounds, by their path.
    """
    if isinstance(node, And | Or):
        combine = all if isinstance(node, And) else any
        return combine(may_hold(item, bounds) for item in node.items)
    if isinstance(node, Member) and not node.negated:
        return any(_may_compare(Compare(node.field, "==", value), bounds) for value in node.values)
    return not isinstance(node, Compare) or _may_compare(node, bounds)


def _may_compare(node: Compare, bounds: Mapping[str, Ends]) -> bool:
    ends, rest = _ends_of(node.field.parts, bounds)
    if ends is None or not is_number(node.value) or is_nan(node.value) or node.order not in _MAY:
        return True
    if rest and not isinstance(rest[0], str):  # elements of an array
        rest = rest[1:]
    if rest not in {(), ("min",), ("max",), ("mean",)}:
        return True
    low, high = ends
    if low is None or high is None:
        return False
    slack = _ROUNDED * max(abs(low), abs(high)) if rest == ("mean",) else 0
    return _MAY[node.order](low - slack, high + slack, node.value)


def _ends_of(parts: Parts, bounds: Mapping[str, Ends]) -> tuple[Ends | None, Parts]:
    """The bounds of the field that a path leads to, and the rest of the path."""
    for count in range(len(parts), 0, -1):
        names = parts[:count]
        if all(isinstance(name, str) for name in names):
            ends = bounds.get(".".join(map(str, names)))
            if ends is not None:
                return ends, parts[count:]
    return None, ()


class BoundsFinder:
    """Finds bounds in columns that are read for an answer."""

    def __init__(self, catalog: Catalog, predicate: Predicate) -> None:
        self._catalog = catalog
        # A mean is rounded, and chunks may give another one.
        fields = {one.path: one for one in _bounded(predicate.root) if _is_plain(one)}
        self._fields = [*fields.values()]
        self._known: dict[str, dict[str, Ends]] = {}

    def of(self, parts: Collection[Part]) -> Found:
        """Bounds to be found for some parts with the same topics and types."""
        return Found(self, [one for one in self._fields if self._lacks(one, parts)])

    def _lacks(self, target: Field, parts: Collection[Part]) -> bool:
        return any(
            content_of(part.recording) not in self._known_of(part.topic, target) for part in parts
        )

    def _known_of(self, topic: str, target: Field) -> dict[str, Ends]:
        kind = key_of(topic, target.path)
        if kind not in self._known:
            self._known[kind] = self._catalog.bounds(kind)
        return self._known[kind]

    def note(self, part: Part, target: Field, ends: Ends) -> None:
        """Note what is known of a part's recording."""
        self._known_of(part.topic, target)[content_of(part.recording)] = ends
        self._catalog.note_bounds(key_of(part.topic, target.path), part.recording, ends)


class Found:
    """Bounds of some parts."""

    def __init__(self, finder: BoundsFinder, fields: Sequence[Field]) -> None:
        self._finder = finder
        self._ends: dict[Field, dict[Part, Ends]] = {target: {} for target in fields}

    def add(self, records: pa.StructArray, spans: Iterable[tuple[Part, int, int]]) -> None:
        """Look at rows.

        Args:
            records: Fields of messages.
            spans: The rows of each part, from one index to another.
        """
        if not self._ends:
            return
        from hybridlog.query.predicate.to_mask import numbers_at

        spans = [*spans]
        edges = np.array([span[1:] for span in spans], np.intp).reshape(-1, 2)
        for target in [*self._ends]:
            found = numbers_at(target, spans[0][0].field_types, records) if spans else []
            if found is None:
                del self._ends[target]
                continue
            known = self._ends[target]
            for part, *_ in spans:
                known.setdefault(part, _NONE)
            for numbers, rows in found:
                for (part, *_), (begin, end) in zip(
                    spans, np.searchsorted(rows, edges).tolist(), strict=True
                ):
                    known[part] = _joined(known[part], numbers[begin:end])

    def note(self, part: Part) -> None:
        """Note the bounds of a part, of which all rows were looked at."""
        for target, known in self._ends.items():
            if part in known:
                self._finder.note(part, target, known[part])


def _is_plain(target: Field) -> bool:
    return all(isinstance(part, str) for part in target.parts) and target.parts[-1] != "mean"


def _joined(ends: Ends, numbers: NDArray[Any]) -> Ends:
    """The bounds of some numbers and of more."""
    if not len(numbers):
        return ends
    found = np.fmin.reduce(numbers).item(), np.fmax.reduce(numbers).item()
    if is_nan(found[0]):
        return ends
    low, high = ends
    return (found[0] if low is None else min(low, found[0])), (
        found[1] if high is None else max(high, found[1])
    )
