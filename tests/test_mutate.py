"""Faults are put into a copy, and those that no test sees are named; see `mutate`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.mutate import survivors

MODULE = """\
def larger(a: int | None, b: int) -> bool:
    return a > b


def capped(n: int) -> int:
    if n < 3:
        n += 1
    return n
"""
TESTS = """\
from hybridlog import capped, larger


def test_larger():
    assert larger(2, 1)


def test_capped():
    assert [capped(n) for n in range(5)] == [1, 2, 3, 3, 4]
"""


def test_the_survivors_are_named(tmp_path: Path) -> None:
    (tmp_path / "storage/hybridlog_storage").mkdir(parents=True)
    (tmp_path / "hybridlog").mkdir()
    (tmp_path / "tests").mkdir()
    (tmp_path / "hybridlog/__init__.py").write_text(MODULE)
    (tmp_path / "tests/test_it.py").write_text(TESTS)
    ask = ("hybridlog/__init__.py", ["tests/test_it.py"])
    # `larger` is never asked about equals.
    assert survivors(*ask, most=99, seed=1, root=tmp_path) == [2]
    assert (tmp_path / "hybridlog/__init__.py").read_text() == MODULE
    (tmp_path / "tests/test_it.py").write_text("def test_it():\n    assert False\n")
    with pytest.raises(RuntimeError, match="without a fault"):
        survivors(*ask, most=1, seed=1, root=tmp_path)
