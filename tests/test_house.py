"""The product and its tests stay as small as they are: `[tool.house]` in pyproject.toml says so."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest

from tests.imports import ROOT

LIMITS: dict[str, int] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"][
    "house"
]


def texts(*folders: str) -> dict[Path, str]:
    return {
        path.relative_to(ROOT): path.read_text("utf-8")
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
    }


def check(what: str, limit: int, sizes: dict[Path, int]) -> None:
    total = sum(sizes.values())
    if total > limit:
        largest = sorted(sizes, key=sizes.__getitem__, reverse=True)[:10]
        shown = "\n".join(f"{sizes[path]:7} {path}" for path in largest)
        pytest.fail(f"{total} {what} are more than {limit}. The largest files:\n{shown}", False)


def lines(text: str) -> int:
    return text.count("\n")


def statements(text: str) -> int:
    return sum(isinstance(node, ast.stmt) for node in ast.walk(ast.parse(text)))


def test_the_product_does_not_grow() -> None:
    product = texts("hybridlog", "storage")
    check("lines", LIMITS["max-lines"], {path: lines(text) for path, text in product.items()})
    counted = {path: statements(text) for path, text in product.items()}
    check("statements", LIMITS["max-statements"], counted)


def test_the_tests_do_not_grow() -> None:
    counted = {path: lines(text) for path, text in texts("tests").items()}
    check("lines of tests", LIMITS["max-test-lines"], counted)
