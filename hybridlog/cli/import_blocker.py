"""Blocks imports that libraries attempt but commands never use."""

from __future__ import annotations

import sys

_BLOCKED = frozenset({"pandas"})
"""pyarrow imports pandas to see whether it is given one of its objects; no command has one.
The import takes three tenths of a short command's time."""


class _Blocker:
    """A finder of modules that reports the blocked ones as not installed."""

    @staticmethod
    def find_spec(fullname: str, *_: object) -> None:
        if fullname in _BLOCKED:
            raise ModuleNotFoundError(f"No command needs {fullname}.", name=fullname)


def install() -> None:
    """Block the imports in this process from now on."""
    sys.meta_path.insert(0, _Blocker())
