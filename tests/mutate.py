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
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.data import DATA

ROOT = Path(__file__).parents[1]
LIMIT_S = 600
PAIRS: tuple[tuple[type[ast.AST], type[ast.AST]], ...] = (
    *((ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.In, ast.NotIn)),
    *((ast.Is, ast.IsNot), (ast.And, ast.Or), (ast.Add, ast.Sub), (ast.Mult, ast.FloorDiv)),
    *((ast.BitAnd, ast.BitOr), (ast.LShift, ast.RShift)),
)
SWAPPED = {**dict(PAIRS), **{other: one for one, other in PAIRS}}


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
    hints = [getattr(node, n, None) for node in ast.walk(tree) for n in ("annotation", "returns")]
    no_code = {id(part) for hint in hints if hint is not None for part in ast.walk(hint)}
    for number, node in enumerate(ast.walk(tree)):
        if id(node) not in no_code and change(copy.copy(node)):
            other = ast.parse(source)
            change(list(ast.walk(other))[number])
            found.append((node.lineno, ast.unparse(ast.fix_missing_locations(other))))  # type: ignore[attr-defined]
    return found


def main() -> int:
    """Name the faults that survive; returns 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("module", help="path of the module that gets faults")
    parser.add_argument("tests", nargs="+", help="tests, as pytest names them")
    parser.add_argument("--most", type=int, default=20, help="number of faults (20)")
    parser.add_argument("--seed", type=int, default=0, help="which faults (0)")
    asked = parser.parse_args()
    source = (ROOT / asked.module).read_text()
    chosen = mutants(source)
    random.Random(asked.seed).shuffle(chosen)
    survives = 0
    with tempfile.TemporaryDirectory() as place:
        tree = Path(place, "tree")
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".*", "__pycache__"))
        variables = {
            **{name: value for name, value in os.environ.items() if "PYTEST" not in name},
            "PYTHONPATH": f"{tree}{os.pathsep}{tree / 'storage'}",
            "PYTHONDONTWRITEBYTECODE": "1",  # two faults in a second look the same
            "HYBRIDLOG_TEST_DATA": str(DATA),
        }
        command = ["timeout", str(LIMIT_S), sys.executable, "-m", "pytest", "-xq", "-n0"]
        command += ["-p", "no:cacheprovider", *asked.tests]
        for line, text in [(0, source), *chosen[: asked.most]]:
            (tree / asked.module).write_text(text)
            ended = subprocess.run(
                command, cwd=tree, env=variables, capture_output=True, check=False
            )
            if not line and ended.returncode:
                raise SystemExit("The tests fail without a fault.")
            if line and not ended.returncode:
                print(f"{asked.module}:{line}: survives: {source.splitlines()[line - 1].strip()}")
                survives = 1
    return survives


if __name__ == "__main__":
    sys.exit(main())
