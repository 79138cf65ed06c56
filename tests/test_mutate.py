"""Faults are put into a copy, and those that no test sees are named; see `mutate`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.mutate import mutants, run, survivors

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


def test_faults_are_in_the_code_alone() -> None:
    assert [line for line, _ in mutants(MODULE)] == [6, 2, 6, 7, 6, 7]
    assert all("a: int | None" in text for _, text in mutants(MODULE))
    texts = {text.split("return ")[1].split("\n")[0] for _, text in mutants(MODULE)}
    assert texts == {"a > b", "a >= b"}


def test_a_run_without_end_is_ended(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text("import time\ndef test_it():\n    time.sleep(1000)\n")
    assert run(tmp_path, ["test_it.py"], 2) is None


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
