"""The loss ledger: nothing that was noted is ever gone, however rows are cut."""

from __future__ import annotations

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from hybridlog.entries import loss_values
from hybridlog.record.losses import Cause, Ledger, joined
from hybridlog_storage.manifest import Loss

SECOND = 1_000_000_000
notes = st.lists(
    st.one_of(
        st.just(None),  # a flush
        st.tuples(
            st.sampled_from(["/a", "/b"]),
            st.sampled_from([Cause.TRANSPORT, Cause.THROTTLE]),
            st.one_of(st.none(), st.integers(1, 100)),
            st.integers(0, 100),
            st.integers(0, 5),
        ),
    ),
    max_size=40,
)


@given(notes)
def test_rows_hold_all_that_was_noted(
    said: list[tuple[str, Cause, int | None, int, int] | None],
) -> None:
    ledger = Ledger()
    rows = []
    counted: Counter[tuple[str, str]] = Counter()
    unknown = set()
    for one in said:
        if one is None:
            rows.extend(map(loss_values, ledger.take()))
            continue
        topic, cause, count, first, length = one
        ledger.note(Loss(cause, topic, count, first=first * SECOND, last=(first + length) * SECOND))
        if count is None:
            unknown.add((topic, cause.value))
        else:
            counted[topic, cause.value] += count
    rows.extend(map(loss_values, ledger.take(everything=True)))
    assert ledger.take(everything=True) == []
    for found in (rows, joined(rows)):
        per_key: Counter[tuple[str, str]] = Counter()
        open_ended = set()
        for row in found:
            assert row["from"] <= row["to"]
            if row["count"] is None:
                open_ended.add((row["topic"], row["cause"]))
            else:
                per_key[row["topic"], row["cause"]] += row["count"]
        assert open_ended == unknown
        for key, count in counted.items():
            assert per_key[key] == count if key not in unknown else per_key[key] <= count
    # Every time that a row was noted for lies in a joined row.
    for one in said:
        if one is not None:
            topic, cause, _, first, length = one
            assert any(
                row["from"] <= first * SECOND and (first + length) * SECOND <= row["to"]
                for row in joined(rows)
                if (row["topic"], row["cause"]) == (topic, cause.value)
            )


def test_a_loss_that_goes_on_is_one_row() -> None:
    ledger = Ledger()
    rows = []
    for second in range(3600):
        ledger.note(Loss(Cause.QUEUE, "/scan", 3, second * SECOND, second * SECOND, "x"))
        rows.extend(map(loss_values, ledger.take()))
    (row,) = joined(rows)
    assert (row["count"], row["from"], row["to"], row["reason"]) == (10_800, 0, 3599 * SECOND, "x")
    for pause, count in ((12 * SECOND, 1), (12 * SECOND + 1, 2)):
        at = 3599 * SECOND + pause
        ledger.note(Loss(Cause.QUEUE, "/scan", 1, first=at, last=at, reason="x"))
        assert len(joined([*rows, *map(loss_values, ledger.take())])) == count


def test_what_the_user_wants_is_a_row_each_ten_seconds() -> None:
    ledger = Ledger()
    for last, count in ((0, 0), (10 * SECOND - 1, 0), (10 * SECOND, 1), (11 * SECOND, 0)):
        ledger.note(Loss(Cause.THROTTLE, "/scan", 1, first=last, last=last))
        assert len(ledger.take()) == count
    assert [row.count for row in ledger.take(everything=True)] == [1]


def test_rows_without_times_stay_as_they_are() -> None:
    row = {"cause": "source damaged", "topic": None, "from": None, "to": None, "count": None}
    assert joined([row]) == [row]
