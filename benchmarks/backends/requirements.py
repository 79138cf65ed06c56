"""Whether what a backend needs is installed."""

from __future__ import annotations

from importlib.util import find_spec

from benchmarks.backends.base import BackendMissingError


def need(module: str, package: str) -> None:
    """See that a package can be imported, without importing it.

    Args:
        module: What is imported.
        package: What is installed, as pip calls it.
    """
    if find_spec(module) is None:
        raise BackendMissingError(
            f"The package {package} is not installed. Install it: pip install {package}, "
            "or all that the benchmarks use: pip install 'hybridlog[bench]'."
        )
