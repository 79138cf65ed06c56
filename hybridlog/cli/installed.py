"""`--installed`: what is installed, and what is missing for which command."""

from __future__ import annotations

import platform
import re
import subprocess
from collections.abc import Iterator
from importlib import metadata
from typing import Final

from hybridlog import __version__
from hybridlog.cli import output
from hybridlog.cli.render import Column, print_table
from hybridlog_storage.errors import MissingDependencyError

NEEDED_FOR: Final = {
    "foxglove": "record --foxglove, open websocket",
    "images": "compressed images, fetch -F jpg",
    "lerobot": "export -F lerobot",
    "mcp": "mcp",
    "plot": "pictures of plot",
    "protobuf": "fields of protobuf messages",
    "remote": "stores in buckets: s3://, gs://, az://",
    "sql": "sql",
    "video": "pictures of video topics, and mp4",
    "view": "view",
}
"""What each extra is needed for."""

_NAME: Final = re.compile(r"[\w.-]+")
_EXTRA: Final = re.compile(r"extra == ['\"]([\w-]+)['\"]")
_LIMIT_S: Final = 10


def print_installed() -> None:
    """Print the versions of hybridlog, Python, MongoDB and all packages, and missing extras."""
    here = f"{platform.system()} {platform.machine()}"
    output.say(f"hybridlog {__version__}, Python {platform.python_version()}, {here}")
    own = (f"{name} {version}" for name, version in packages() if version)
    output.tell(None, [f"MongoDB: {mongodb()}", f"Packages: {', '.join(own)}", ""])
    rows: list[tuple[str, ...]] = []
    for extra, purpose in NEEDED_FOR.items():
        found = list(packages(extra))
        has = ", ".join(f"{name} {version}" for name, version in found if version)
        is_there = all(version for _, version in found)
        cure = "" if is_there else f"pip install 'hybridlog[{extra}]'"
        rows.append((extra, purpose, cure or has))
    headings = ("extra", "needed for", "installed, or the cure")
    print_table([Column(heading, n) for n, heading in enumerate(headings)], rows)


def packages(extra: str | None = None) -> Iterator[tuple[str, str | None]]:
    """Names and versions (None: missing) of the packages that hybridlog or an extra needs."""
    for line in metadata.requires("hybridlog") or ():
        name, of = _NAME.match(line), _EXTRA.search(line)
        if name is not None and (of[1] if of else None) == extra:
            try:
                yield name[0], metadata.version(name[0])
            except metadata.PackageNotFoundError:
                if "sys_platform" not in line:  # the MongoDB of another system
                    yield name[0], None


def mongodb() -> str:
    """Version and path of the mongod that stores would use, or how to get one."""
    from hybridlog_storage.mongo.mongod import find_mongod

    try:
        path = find_mongod()
    except MissingDependencyError as error:
        return str(error)
    try:
        asked = subprocess.run(  # noqa: S603
            [path, "--version"], capture_output=True, text=True, timeout=_LIMIT_S, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        return f"{path} does not run: {error}"
    first = asked.stdout.splitlines()[:1]
    return f"{''.join(first).removeprefix('db version v')} ({path})"
