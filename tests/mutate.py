"""Mutants: small faults that are put into the code, each of which a test must see.

`python -m tests.mutate` tries all of `tests/mutants.py`, `python -m tests.mutate NAME …` some.
The checkout is never changed: each mutant is put into a copy of it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from tests.data import DATA

ROOT = Path(__file__).parents[1]
LEFT_OUT = (".*", "__pycache__", "benchmarks")  # what of it is not copied
PASSED, FAILED = 0, 1  # what pytest returns; everything else is no answer
LONGEST_S = 1500
_ALIKE = "import hybridlog, hybridlog_storage as s; print(hybridlog.__file__); print(s.__file__)"


class Mutant(NamedTuple):
    """A small fault.

    Attributes:
        name: What people call it by.
        file: Path in the checkout.
        old: A fragment of the file, which occurs in it exactly once.
        new: What stands there instead.
        tests: The tests of which at least one must fail, as pytest names them.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


class MutantError(Exception):
    """A mutant that cannot be tried, which says nothing of the tests."""


def mutated(mutant: Mutant, root: Path = ROOT) -> str:
    """The text of a mutant's file with the fault in it.

    Raises:
        OSError: There is no such file.
        MutantError: The fragment does not occur exactly once, or is not changed.
    """
    text = (root / mutant.file).read_text()
    if (count := text.count(mutant.old)) != 1:
        raise MutantError(f"{mutant.name}: {mutant.old!r} occurs {count} times in {mutant.file}")
    if mutant.old == mutant.new:
        raise MutantError(f"{mutant.name}: nothing is changed")
    return text.replace(mutant.old, mutant.new)


class Copy:
    """A copy of the checkout in which mutants are tried, one after the other.

    Args:
        directory: Where it is made; empty.
        root: The checkout.
    """

    def __init__(self, directory: Path, root: Path = ROOT) -> None:
        self.directory = directory
        ignored = shutil.ignore_patterns(*LEFT_OUT)
        shutil.copytree(root, directory, ignore=ignored, dirs_exist_ok=True)

    def check(self, mutants: Iterable[Mutant]) -> None:
        """See that the copy is what is tested, and that its tests pass without a fault.

        Raises:
            MutantError: They do not, so that their failing would mean nothing.
        """
        done = self._run("-c", _ALIKE)
        for place in done.stdout.splitlines():
            if not Path(place).is_relative_to(self.directory):
                raise MutantError(f"not the copy is tested, but {place}")
        tests = dict.fromkeys(test for mutant in mutants for test in mutant.tests)
        if tests and (done := self._test(*tests)).returncode != PASSED:
            raise MutantError(f"the tests fail without a mutant:\n{done.stdout}{done.stderr}")

    def kills(self, mutant: Mutant) -> bool:
        """Whether a test of a mutant fails when the fault is there.

        Raises:
            MutantError: The tests cannot be run.
        """
        file = self.directory / mutant.file
        sound, text = file.read_text(), mutated(mutant, self.directory)
        try:
            file.write_text(text)
            done = self._test("-x", *mutant.tests)
        finally:
            file.write_text(sound)
        if done.returncode not in {PASSED, FAILED}:
            raise MutantError(f"{mutant.name}: pytest cannot run:\n{done.stdout}{done.stderr}")
        return done.returncode == FAILED

    def _test(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return self._run("-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *arguments)

    def _run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environment = {
            **{name: value for name, value in os.environ.items() if "PYTEST" not in name},
            "PYTHONPATH": f"{self.directory}{os.pathsep}{self.directory / 'storage'}",
            "PYTHONDONTWRITEBYTECODE": "1",  # a file that is changed twice a second looks the same
            "HYBRIDLOG_TEST_DATA": str(DATA),
        }
        try:
            return subprocess.run(
                [sys.executable, *arguments],
                cwd=self.directory,
                env=environment,
                capture_output=True,
                text=True,
                timeout=LONGEST_S,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise MutantError(f"after {LONGEST_S} s there is no answer") from error


def main(names: list[str]) -> int:
    """Try mutants; returns 1 when one survives."""
    from tests.mutants import MUTANTS

    chosen = [mutant for mutant in MUTANTS if not names or mutant.name in names]
    with tempfile.TemporaryDirectory() as directory:
        copy = Copy(Path(directory))
        copy.check(chosen)
        killed = 0
        for mutant in chosen:
            is_killed = copy.kills(mutant)
            killed += is_killed
            print("killed  " if is_killed else "SURVIVED", mutant.name, flush=True)
    print(f"{killed} of {len(chosen)} killed")
    return 0 if chosen and killed == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
