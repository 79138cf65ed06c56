"""What libraries would load for a command, and no command needs."""

from __future__ import annotations

import sys

_SPARED = frozenset({"pandas"})
"""pyarrow loads pandas to see whether it is given one of its objects, which no command has;
that takes three tenths of a short command's time."""


class _Spared:
    """A finder of modules that says of these that there are none."""

    @staticmethod
    def find_spec(fullname: str, *_: object) -> None:
        if fullname in _SPARED:
            raise ModuleNotFoundError(f"No command needs {fullname}.", name=fullname)


def spare() -> None:
    """From now on, in this process, these packages are as if they were not installed."""
    sys.meta_path.insert(0, _Spared())
