"""Directories of the user, outside of all stores."""

from __future__ import annotations

import os
from pathlib import Path

from hybridlog_storage.errors import StoreError


def user_directory(variable: str, below_home: str, purpose: str) -> Path:
    """The directory of hybridlog in one of the user's base directories; it need not exist.

    Args:
        variable: Environment variable with an absolute path; a relative one does not count.
        below_home: Path below the home directory that counts without it.
        purpose: What is kept there, for the error.

    Raises:
        StoreError: This user has no home directory.
    """
    named = os.environ.get(variable, "")
    if os.path.isabs(named):  # noqa: PTH117 - a relative one does not count
        return Path(named, "hybridlog")
    try:
        return Path.home() / below_home / "hybridlog"
    except RuntimeError as error:
        raise StoreError(
            f"This user has no home directory to keep {purpose} in: set {variable}."
        ) from error
