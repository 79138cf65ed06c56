"""Programs as Debian packs them, fetched and unpacked without root and without installing."""

from __future__ import annotations

import os
import shutil
import subprocess
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

_STATUS = Path("/var/lib/dpkg/status")
_TIMEOUT_S = 200


def unpack(
    place: Path, packages: Sequence[str], status: Callable[[str], str] = lambda said: said
) -> str:
    """Fetch packages, and all that they need and the system lacks, and unpack them in `tree`.

    Args:
        place: An empty directory; it gets the directory `tree`.
        packages: Names of packages.
        status: Changes what dpkg says of the system.

    Returns:
        The reason why it cannot be done; empty if it was.
    """
    if shutil.which("apt-get") is None or shutil.which("dpkg") is None:
        return "there is no apt to fetch it with"
    try:
        _unpack(place, packages, status(_STATUS.read_text()))
    except subprocess.SubprocessError as error:
        said = getattr(error, "stderr", None) or str(error)
        return f"apt cannot fetch it: {(said.strip().splitlines() or [''])[-1]}"
    return ""


def libraries(root: Path) -> str:
    """Where programs of a tree look for libraries: a value for `LD_LIBRARY_PATH`."""
    found = [*root.glob("usr/lib/*-linux-gnu"), *root.glob("lib/*-linux-gnu")]
    found += root.glob("usr/lib/*-linux-gnu/pulseaudio")  # which libpulse finds by its own path
    return ":".join(map(str, found))


def _unpack(place: Path, packages: Sequence[str], status: str) -> None:
    for folder in ("state/lists/partial", "cache/archives/partial", "tree"):
        (place / folder).mkdir(parents=True)
    known = place / "state" / "status"
    known.write_text(status)
    settings = place / "apt.conf"
    settings.write_text(
        textwrap.dedent(
            f"""\
            Dir::State "{place}/state";
            Dir::State::status "{known}";
            Dir::Cache "{place}/cache";
            Debug::NoLocking "true";
            APT::Install-Recommends "false";
            APT::Sandbox::User "";
            """
        )
    )

    def run(*command: str | Path) -> None:
        subprocess.run(
            command,
            env={**os.environ, "APT_CONFIG": str(settings)},
            capture_output=True,
            text=True,
            check=True,
            timeout=_TIMEOUT_S,
        )

    run("apt-get", "update", "-qq")
    run("apt-get", "install", "-qq", "--yes", "--download-only", *packages)
    for package in sorted((place / "cache" / "archives").glob("*.deb")):
        run("dpkg", "-x", package, place / "tree")
    for done in ("state", "cache"):
        shutil.rmtree(place / done)
