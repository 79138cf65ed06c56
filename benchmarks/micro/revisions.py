"""Other revisions of the source, each in a git worktree of its own for a while."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.micro.isolation import PACKAGES
from benchmarks.micro.running import ROOTS


class RevisionError(Exception):
    """There is no such revision, or no repository; the message says what can be done."""


def last_commit(root: Path) -> str:
    """What the source is compared with unless it is said.

    Args:
        root: The checkout.

    Returns:
        `HEAD` when files of the source differ from it, else `HEAD~1`.

    Raises:
        RevisionError: This is no git checkout.
    """
    places = [str(Path(part) / name) for part in ROOTS for name in PACKAGES]
    changed = _git(root, "status", "--porcelain", "--untracked-files=all", "--", *places)
    return "HEAD" if changed else "HEAD~1"


def commit_of(root: Path, revision: str) -> str:
    """The full name of a commit.

    Args:
        root: The checkout.
        revision: As git understands it: a branch, a tag, `HEAD~3`.

    Raises:
        RevisionError: There is no such commit.
    """
    try:
        return _git(
            root, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}"
        )
    except RevisionError as error:
        if (root / ".git").exists():
            raise RevisionError(
                f"There is no commit {revision}: name one that `git log` shows."
            ) from error
        raise


@contextmanager
def worktree(root: Path, commit: str, place: Path) -> Iterator[Path]:
    """The files of a commit; they are gone after the block, however it ends.

    Args:
        root: The checkout.
        commit: Full name of the commit.
        place: Directory to make.

    Raises:
        RevisionError: It cannot be made.
    """
    try:
        _git(root, "worktree", "add", "--detach", "--force", str(place), commit)
        yield place
    finally:
        # Twice forced, as one that was interrupted on its way is locked.
        _run(root, "worktree", "remove", "--force", "--force", str(place))
        _run(root, "worktree", "prune")


def _git(root: Path, *arguments: str) -> str:
    try:
        done = _run(root, *arguments)
    except OSError as error:
        raise RevisionError(f"git cannot be run, and it keeps the revisions: {error}") from error
    if done.returncode:
        raise RevisionError(
            f"git {arguments[0]} failed: {done.stderr.strip() or 'it does not say why'}. "
            f"Other revisions are to be had in a git checkout only; is {root} one?"
        )
    return done.stdout.strip()


def _run(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    # Hooks of the repository, and what git tells its hooks, are none of our business.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    return subprocess.run(
        ["git", "-C", str(root), "-c", "core.hooksPath=/dev/null", *arguments],
        env={**environment, "LC_ALL": "C"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        # Ctrl-C in a terminal is for us; git would leave a worktree half made.
        start_new_session=True,
    )
