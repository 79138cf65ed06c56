"""`python -m benchmarks STUDY …`: hands over to one of the studies."""

from __future__ import annotations

import sys
from importlib import import_module

_STUDIES = {
    "speed": ("benchmarks.speed.command", "the speed targets, each as a ratio from one run"),
}
"""Module with a `main(arguments) -> exit code`, and what the study is about."""


def main(arguments: list[str]) -> int:
    """Run the study that the first argument names.

    Returns:
        The study's exit code; 0 for the list of studies, 2 when there is no such study.
    """
    if arguments and arguments[0] in _STUDIES:
        module, _ = _STUDIES[arguments[0]]
        return int(import_module(module).main(arguments[1:]))
    asked = not arguments or arguments[0] in {"-h", "--help"}
    stream = sys.stdout if asked else sys.stderr
    if not asked:
        print(f"There is no study {arguments[0]!r}.", file=stream)
    print("usage: python -m benchmarks STUDY [options]\n\nStudies:", file=stream)
    for name, (_, about) in _STUDIES.items():
        print(f"  {name:12} {about}", file=stream)
    print("\n`python -m benchmarks STUDY --help` lists the options of one.", file=stream)
    return 0 if asked else 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
