"""Answers of a question that are tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from hybridlog.query.steps import Steps, of_now

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from hybridlog.across.align import Aligned
    from hybridlog.query.answers.field_statistics import FieldStatistics
    from hybridlog.query.answers.regularity import TopicCheck
    from hybridlog.query.times import DurationLike


class TableAnswers(Steps):
    """Answers with the fields of messages as rows and columns."""

    def to_arrow(self) -> pa.Table:
        """A table: scalars and strings as columns, arrays as lists, first column log time."""
        import pyarrow as pa

        from hybridlog.frames.answer import to_arrow

        if self.question.frame is not None:
            return pa.concat_tables(self.to_tables(), promote_options="permissive")
        return to_arrow(self._planner())

    def to_polars(self) -> Any:
        """A polars frame of the same columns, `log_time` among them.

        Raises:
            MissingDependencyError: polars is not installed.
        """
        from hybridlog.frames.frame import to_polars

        return to_polars(self.to_arrow())

    def to_pandas(self) -> pd.DataFrame:
        """A frame of the same columns, indexed by log time (UTC, ns)."""
        from hybridlog.frames.answer import to_pandas
        from hybridlog.frames.frame import frame_of

        if self.question.frame is not None:
            table = self.to_arrow()
            names = [name for name in table.column_names if name != "log_time"]
            frame = frame_of(table["log_time"], ((name, table[name]) for name in names))
        else:
            frame = to_pandas(self._planner())
        frame.attrs["hybridlog"] = asdict(self.counters)
        return frame

    def to_tables(self) -> Iterator[pa.Table]:
        """The answer in order, in Arrow tables of bounded size; at least one, possibly empty."""
        from hybridlog.tf.in_frame import stream

        return stream(self._planner())

    def to_json_lines(self) -> Iterator[list[str]]:
        """The answer in order as lines of JSON, many at a time."""
        from hybridlog.frames.lines import lines

        self._as_they_came("Lines")
        for batch in lines(self._planner()):
            yield [line if isinstance(line, str) else "".join(line) for line in batch]

    def resample(
        self,
        step: DurationLike,
        how: str = "asof",
        tolerance: DurationLike | None = None,
    ) -> Aligned:
        """The topics at regular log times: every `step` from the beginning of each recording.

        With `between` or `during`, from the beginning of the range. Columns are those of
        `Store.align`; those of a single topic have no prefix. With an aggregate, `count` is in
        place of `distance`: the number of messages from a row to the next, or to the end.

        Args:
            step: Time between two rows, a duration.
            how: `asof`, `nearest` or `interpolate`, as for `Store.align`. Or an aggregate of
                the messages from a row to the next: `count`; `first` or `last`, their fields;
                `min`, `max` or `mean` of finite numbers, null without any.
            tolerance: Greatest distance in time; None for any.

        Raises:
            UsageError: an unknown way, a step of 0, a tolerance for an aggregate, a field that
                has none, another clock than the log's, or limit, every or reverse.
            TimeError: no duration, or a range outside of all recordings.
        """
        from hybridlog.across.align import resampled

        return resampled(self.session, self.question, step, how, tolerance)

    def rate(self, window: DurationLike | None = None) -> pa.Table:
        """Number and rate of the messages of each topic.

        Args:
            window: Length of the windows, a duration; the first begins with the recording or
                the range, the last may be shorter. None for all messages in one.

        Returns:
            `begin`, `end`, `recording` (name), `topic`, `messages` and `rate`, messages a
            second. Without windows: from the first message to the last, and the mean rate
            from one to the next, null if there is none.

        Raises:
            UsageError: `limit`, `every`, `reverse`, another clock than the log's, or too many
                windows.
            TimeError: no duration, or a range outside of all recordings.
        """
        from hybridlog.query.answers.rates import Rates

        with self.counters.timed():
            return Rates(self.session, self.question, self.counters).rate(window)

    def check(self) -> list[TopicCheck]:
        """Check how regularly the topics came: rate, jitter, gap, late start, early stop, losses.

        Returns:
            One for each recording and topic, also for topics without messages; those that were
            silent for most of their usual periods first, then those that have lost most.

        Raises:
            UsageError: `limit`, `every`, `reverse`, or another clock than the log's.
            TimeError: a range outside of all recordings.
        """
        from hybridlog.query.answers.regularity import check

        with self.counters.timed():
            return check(self.session, self.question, self.counters)

    def stats(self, *fields: str) -> list[FieldStatistics]:
        """Statistics of the numeric fields: count, NaN, infinite, least, greatest, mean, deviation.

        Args:
            fields: Paths; also summaries (`ranges.min`), and arrays, for all their elements.
                None for every field that is a number.

        Raises:
            TopicError: no such field exists.
            UsageError: `limit`, `every`, `reverse`, or no field is a number.
            TimeError: a range outside of all recordings.
        """
        from hybridlog.query.answers.field_statistics import statistics

        self._as_they_came("Statistics")
        now = of_now(self)
        query = now.fields(*fields) if fields else now
        with self.counters.timed():
            return statistics(now.session, query.question, self.counters)
