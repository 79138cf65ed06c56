"""The tests see the faults that they are there for; see `mutate`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.mutants import MUTANTS
from tests.mutate import Copy, Mutant, MutantError, mutated


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_is_what_it_was(mutant: Mutant) -> None:
    """Code that was changed needs other mutants."""
    mutated(mutant)


def test_names_are_used_once() -> None:
    assert max(Counter(mutant.name for mutant in MUTANTS).values()) == 1


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Copy:
    copy = Copy(tmp_path_factory.mktemp("mutants"))
    copy.check(MUTANTS)
    return copy


@pytest.mark.exhaustive
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_is_killed(copy: Copy, mutant: Mutant) -> None:
    assert copy.kills(mutant), f"no test sees that {mutant.new!r} stands for {mutant.old!r}"


# The machinery.


def checkout(directory: Path) -> Path:
    (directory / "storage" / "hybridlog_storage").mkdir(parents=True)
    (directory / "storage" / "hybridlog_storage" / "__init__.py").touch()
    (directory / "hybridlog").mkdir()
    (directory / "hybridlog" / "__init__.py").write_text("def add(a, b):\n    return a + b\n")
    (directory / "tests").mkdir()
    (directory / "tests" / "test_it.py").write_text(
        "from hybridlog import add\n\n\ndef test_sum():\n    assert add(2, 0) == 2\n"
        "\n\ndef test_good():\n    assert add(2, 3) == 5\n"
    )
    return directory


def fault(old: str, new: str, test: str = "test_good") -> Mutant:
    return Mutant("m", "hybridlog/__init__.py", old, new, (f"tests/test_it.py::{test}",))


def test_only_a_failing_test_kills(tmp_path: Path) -> None:
    root = checkout(tmp_path / "checkout")
    (tmp_path / "copy").mkdir()
    copy = Copy(tmp_path / "copy", root)
    copy.check([fault("a + b", "a - b")])
    assert copy.kills(fault("a + b", "a - b"))
    assert not copy.kills(fault("a + b", "a - b", "test_sum"))
    for broken in (fault("a + b", "a +"), fault("a + b", "a - b", "test_gone")):
        with pytest.raises(MutantError, match="cannot run"):
            copy.kills(broken)
    assert (copy.directory / "hybridlog/__init__.py").read_text().endswith("a + b\n")
    assert (root / "hybridlog/__init__.py").read_text().endswith("a + b\n")
    (copy.directory / "hybridlog/__init__.py").write_text("def add(a, b):\n    return 0\n")
    with pytest.raises(MutantError, match="without a mutant"):
        copy.check([fault("a + b", "a - b")])


@pytest.mark.parametrize(
    ("mutant", "words"),
    [
        (fault("a * b", "a"), "0 times"),
        (fault("a", "b"), "3 times"),
        (fault("a + b", "a + b"), "nothing is changed"),
    ],
)
def test_a_fragment_stands_once(tmp_path: Path, mutant: Mutant, words: str) -> None:
    root = checkout(tmp_path / "checkout")
    with pytest.raises(MutantError, match=words):
        mutated(mutant, root)
    with pytest.raises(FileNotFoundError):
        mutated(mutant._replace(file="hybridlog/gone.py"), root)
