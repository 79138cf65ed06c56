"""The question that a user holds: built step by step, answered on access.

```python
scans = store.topic("scan").between("+10s", "+11s").where("ranges.min < 0.5")
for message in scans: ...
frame = scans.to_pandas()
```

Each step returns a new query; nothing is read before the answer is accessed. `counters`
then has the cost of the answer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog.query.interval_answers import IntervalAnswers
from hybridlog.query.message_answers import MessageAnswers
from hybridlog.query.steps import of_now
from hybridlog.query.table_answers import TableAnswers
from hybridlog.wording import listed
from hybridlog_storage.errors import (
    HybridlogError,
)

if TYPE_CHECKING:
    from hybridlog.query.answers.completeness import Completeness


class Query(MessageAnswers, TableAnswers, IntervalAnswers):
    """A question about some topics of an open store. Immutable: each step returns a new one.

    Args:
        source: The open store, or one moment of it.
        question: The question.

    Attributes:
        question: The question, as a value that can be compared, hashed and pickled.
        counters: The cost of the last answer.
        conditions: Queries about other topics, whose answers are in the question.
    """

    def __repr__(self) -> str:
        return f"<Query {'; '.join(self._described().values())}>"

    def _repr_html_(self) -> str:
        """The question in a notebook; no message is read for it."""
        from hybridlog.drawing.notebook import properties_html

        return properties_html("Query", self._described())

    def _described(self) -> dict[str, str]:
        """The parts of the question in words."""
        question, session = self.question, self.session
        found = {"topics": listed(self.topics, 3)}
        try:
            places = session.chosen(question).tolist()
        except HybridlogError as error:
            found["recordings"] = str(error)
        else:
            summaries = session.snapshot().summaries
            names = listed((summaries[place].name for place in places[:4]), 3)
            several = f"{len(places)} recordings"
            found["recordings"] = several if len(places) != 1 else f"recording {names}"
        if question.bounds is not None:
            begin, end = question.bounds
            clock = "" if question.clock == "log" else f" by {question.clock} time"
            found["time"] = f"between {begin} and {end}{clock}"
        if question.during is not None:
            found["during"] = f"during {len(question.during)} intervals"
        if question.predicate is not None:
            from hybridlog.query.predicate.tree import spelled

            text = spelled(question.predicate.root)
            found["predicate"] = f"where {text if len(text) <= 200 else text[:200] + '…'}"
        if question.fields is not None:
            found["fields"] = f"fields {listed(question.fields, 5)}"
        if question.frame is not None:
            found["frame"] = f"in frame {question.frame}"
        if question.every > 1:
            found["every"] = f"every {question.every}th"
        if question.limit is not None:
            found["limit"] = f"at most {question.limit}"
        if question.reverse:
            found["order"] = "latest first"
        return found

    def completeness(self) -> Completeness:
        """Completeness of the last answer, or, without one, of an answer given now.

        Losses of topics in conditions count as an unknown number.
        """
        from hybridlog.query.answers.lost import completeness_of

        others = ((one.question, one.counters) for one in self.conditions)
        return completeness_of(self.session, self.question, self.counters, *others)

    def remarks(self, *, is_empty: bool | None = None) -> list[str]:
        """Sentences about the last answer.

        They tell what it lacks: messages that could not be read or asked, those without their
        payload, losses in its range, and recordings that go on. And topics that lack fields of
        the predicate, topics whose end is a short name that was given, header stamps of another
        epoch, likely causes of an empty answer.

        Args:
            is_empty: Whether the answer was empty; without, if `counters` has no messages.
        """
        from hybridlog.query.answers.remarks import remarks

        if is_empty is None:
            is_empty = not self.counters.messages
        now = of_now(self)
        found = [*now.completeness().sentences]
        for one in self.conditions:
            nothing = self.question.during is not None and not self.question.during
            found += remarks(now.session, one.question, is_empty=nothing)
        found += remarks(now.session, self.question, is_empty=is_empty)
        return [*dict.fromkeys(found)]
