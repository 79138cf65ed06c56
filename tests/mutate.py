"""Mutants: small faults in a module, of which its tests should see each.

`python -m tests.mutate hybridlog/query/times.py tests/query/test_times.py --most 20 --seed 5` puts
one after the other into a copy of the tree, runs the tests there, and names those that survive.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.data import DATA

ROOT = Path(__file__).parents[1]
PASSED, NO_ANSWER = 0, None
PAIRS: tuple[tuple[type[ast.AST], type[ast.AST]], ...] = (
    *((ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.In, ast.NotIn)),
    *((ast.Is, ast.IsNot), (ast.And, ast.Or), (ast.Add, ast.Sub), (ast.Mult, ast.FloorDiv)),
    *((ast.BitAnd, ast.BitOr), (ast.LShift, ast.RShift)),
)
SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    **dict(PAIRS),
    **{other: one for one, other in PAIRS},
    ast.Div: ast.Mult,
    ast.Mod: ast.Add,
}
_ANNOTATIONS = ("annotation", "returns")


def change(node: ast.AST) -> bool:
    """Put a fault into a node; False if there is none for it."""
    match node:
        case ast.Compare(ops=[first, *others]) if type(first) in SWAPPED:
            node.ops = [SWAPPED[type(first)](), *others]  # type: ignore[list-item]
        case ast.BinOp() | ast.BoolOp() | ast.AugAssign() if type(node.op) in SWAPPED:
            node.op = SWAPPED[type(node.op)]()  # type: ignore[assignment]
        case ast.If() | ast.IfExp() | ast.While():
            node.test = ast.UnaryOp(ast.Not(), node.test)
        case ast.UnaryOp(op=ast.Not()):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)
        case ast.Constant(value=bool()):
            node.value = not node.value
        case ast.Constant(value=int() | float() as number):
            node.value = number + 1
        case _:
            return False
    return True


def mutants(source: str) -> list[tuple[int, str]]:
    """All faults of a module: the line, and the module with the fault in it."""
    found = []
    tree = ast.parse(source)
    roots = [getattr(node, name, None) for node in ast.walk(tree) for name in _ANNOTATIONS]
    hints = {id(part) for root in roots if root is not None for part in ast.walk(root)}
    for number, node in enumerate(ast.walk(tree)):
        if id(node) not in hints and change(copy.copy(node)):
            other = ast.parse(source)
            change(list(ast.walk(other))[number])
            found.append((node.lineno, ast.unparse(ast.fix_missing_locations(other))))  # type: ignore[attr-defined]
    return found


def run(tree: Path, tests: Sequence[str], limit_s: float) -> int | None:
    """Run tests in a copy of the checkout; None if they do not end in time."""
    variables = {name: value for name, value in os.environ.items() if "PYTEST" not in name}
    variables["PYTHONPATH"] = f"{tree}{os.pathsep}{tree / 'storage'}"
    variables["PYTHONDONTWRITEBYTECODE"] = "1"  # two faults in a second look the same
    variables["HYBRIDLOG_TEST_DATA"] = str(DATA)
    child = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-xq", "-n0", "-p", "no:cacheprovider", *tests],
        cwd=tree,
        env=variables,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        return child.wait(limit_s)
    except subprocess.TimeoutExpired:
        return NO_ANSWER
    finally:
        if child.poll() is None:  # with all that it has started
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()


def survivors(
    module: str, tests: Sequence[str], *, most: int, seed: int, root: Path = ROOT
) -> list[int]:
    """The lines of faults that no test sees.

    Args:
        module: Path in the checkout.
        tests: Tests in the checkout, as pytest names them.
        most: Number of faults that are tried.
        seed: Which of them.
        root: The checkout, which is not changed.

    Raises:
        RuntimeError: The tests fail without a fault.
    """
    chosen = mutants((root / module).read_text())
    random.Random(seed).shuffle(chosen)
    with tempfile.TemporaryDirectory() as place:
        tree = Path(place, "tree")
        shutil.copytree(root, tree, ignore=shutil.ignore_patterns(".*", "__pycache__"))
        begin = time.monotonic()
        if run(tree, tests, 3600) != PASSED:
            raise RuntimeError("The tests fail without a fault.")
        limit_s = 10 + 5 * (time.monotonic() - begin)
        left = []
        for line, text in chosen[:most]:
            (tree / module).write_text(text)
            if run(tree, tests, limit_s) == PASSED:
                left.append(line)
    return sorted(left)


def main() -> int:
    """Name the faults that survive; returns 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("module", help="path of the module that gets faults")
    parser.add_argument("tests", nargs="+", help="tests, as pytest names them")
    parser.add_argument("--most", type=int, default=20, help="number of faults (20)")
    parser.add_argument("--seed", type=int, default=0, help="which faults (0)")
    asked = parser.parse_args()
    lines = (ROOT / asked.module).read_text().splitlines()
    left = survivors(asked.module, asked.tests, most=asked.most, seed=asked.seed)
    for line in left:
        print(f"{asked.module}:{line}: survives: {lines[line - 1].strip()}")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
