"""Runs of equal values, against numpy's own way."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.ordering import run_lengths, run_starts


@given(st.lists(st.integers(0, 2), min_size=1, max_size=40))
def test_runs_begin_where_the_value_changes(values: list[int]) -> None:
    of = np.array(values, np.int32)
    starts = run_starts(of)
    assert starts.dtype == np.intp
    assert starts.tolist() == [0, *(np.flatnonzero(np.diff(of)) + 1).tolist()]
    assert run_lengths(starts, len(of)).tolist() == np.diff(starts, append=len(of)).tolist()
