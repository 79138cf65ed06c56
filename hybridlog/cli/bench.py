"""`hybridlog bench`: finds the benchmarks in the source tree and becomes their process."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NoReturn

import click

from hybridlog_storage.errors import MissingDependencyError

PROGRAM = "hybridlog bench"
_START = (
    "import sys; from benchmarks.__main__ import main; "
    f"sys.exit(main(sys.argv[1:], program={PROGRAM!r}))"
)
_MARKS = ("__main__.py", "samples.py")
"""Files that tell these benchmarks from another directory of that name."""


@click.command(
    # Everything after the name belongs to the benchmarks, their own --help included.
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
)
@click.argument(
    "arguments",
    nargs=-1,
    type=click.UNPROCESSED,
    metavar="[ARGUMENT]...",
    help="Of the benchmarks: all --quick, report, --list-backends, throughput --help.",
)
def command(*, arguments: tuple[str, ...]) -> NoReturn:
    """Compare hybridlog with databases and files.

    Needs the source tree. The arguments are those of `python -m benchmarks`; without any, it
    lists the benchmarks.
    """
    root = find(Path(__file__).parents[2], Path.cwd())
    # The benchmarks run the code of their own tree, whatever else is installed.
    roots = [str(root), str(root / "storage")]
    before = os.environ.get("PYTHONPATH")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([*roots, *([before] if before else [])]),
    }
    sys.stdout.flush()
    sys.stderr.flush()
    # -P: files in the current directory must not replace modules.
    os.execve(sys.executable, [sys.executable, "-P", "-c", _START, *arguments], environment)  # noqa: S606


def find(*roots: Path) -> Path:
    """The first of some directories that is a source tree with the benchmarks.

    Raises:
        MissingDependencyError: No directory is one.
    """
    for root in roots:
        if all((root / "benchmarks" / name).is_file() for name in _MARKS):
            return root
    raise MissingDependencyError(
        "The benchmarks are not part of the installed package. Clone the repository, run "
        "`pip install -e '.[bench]'` in it, and call `hybridlog bench` again."
    )
