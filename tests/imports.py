"""What the modules of the project import, read from their text."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE_ROOTS = (ROOT, ROOT / "storage")
PACKAGES = (ROOT / "hybridlog", ROOT / "storage" / "hybridlog_storage")


@dataclass(frozen=True)
class Import:
    """One import of one module.

    Attributes:
        module: Full name of what is imported (`from a import b` is both `a` and `a.b`).
        line: Where.
        typing: Whether only a type checker sees it.
    """

    module: str
    line: int
    typing: bool


def modules() -> dict[str, Path]:
    """All modules of both packages, by full name."""
    found = {}
    for package in PACKAGES:
        for path in sorted(package.rglob("*.py")):
            parts = list(path.relative_to(package.parent).with_suffix("").parts)
            if parts[-1] == "__init__":
                parts.pop()
            found[".".join(parts)] = path
    return found


def imports_of(path: Path, name: str) -> list[Import]:
    """Every import statement in a module, wherever it stands."""
    found: list[Import] = []
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]

    def visit(node: ast.AST, *, typing: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend(Import(a.name, node.lineno, typing) for a in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, *([base] if base else [])])
            found.append(Import(base, node.lineno, typing))
            found.extend(Import(f"{base}.{a.name}", node.lineno, typing) for a in node.names)
        else:
            is_checked = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
            for child in ast.iter_child_nodes(node):
                is_body = is_checked and child in node.body  # type: ignore[attr-defined]
                visit(child, typing=typing or is_body)

    visit(ast.parse(path.read_text(encoding="utf-8")), typing=False)
    return found
