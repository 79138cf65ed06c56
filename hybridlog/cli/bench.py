"""`hybridlog bench`: finds the benchmarks, which live in the source tree, and hands over."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from hybridlog_storage.errors import MissingDependencyError

PROGRAM = "hybridlog bench"
_START = (
    "import sys; from benchmarks.__main__ import main; "
    f"sys.exit(main(sys.argv[1:], program={PROGRAM!r}))"
)
_MARKS = ("__main__.py", "samples.py")
"""Files that tell our benchmarks from somebody else's directory of that name."""


def run(arguments: Sequence[str]) -> NoReturn:
    """Become the process of the benchmarks.

    Args:
        arguments: Of `python -m benchmarks`.

    Raises:
        MissingDependencyError: There is no source tree.
    """
    root = find(Path(__file__).parents[2], Path.cwd())
    # The benchmarks bring the code they lie beside, whatever else is installed.
    roots = [str(root), str(root / "storage")]
    before = os.environ.get("PYTHONPATH")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([*roots, *([before] if before else [])]),
    }
    sys.stdout.flush()
    sys.stderr.flush()
    # -P: what lies in the current directory must not stand in for a module.
    os.execve(sys.executable, [sys.executable, "-P", "-c", _START, *arguments], environment)  # noqa: S606


def find(*roots: Path) -> Path:
    """The first of some directories that is a source tree with the benchmarks.

    Raises:
        MissingDependencyError: None is.
    """
    for root in roots:
        if all((root / "benchmarks" / name).is_file() for name in _MARKS):
            return root
    raise MissingDependencyError(
        "The benchmarks are not part of the installed package. Clone the repository, run "
        "`pip install -e '.[bench]'` in it, and call `hybridlog bench` again."
    )
