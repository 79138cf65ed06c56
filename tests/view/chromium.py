"""Debian's chromium: the one that is installed, or one that is fetched into the cache."""

from __future__ import annotations

import os
import shutil
import textwrap
from pathlib import Path
from typing import NamedTuple

from tests.debian import libraries, unpack
from tests.peer_cache import made_once

PACKAGES = ("chromium", "fonts-dejavu-core")


class Chromium(NamedTuple):
    """Where chromium lies."""

    path: str
    environment: dict[str, str | float | bool]


def chromium() -> Chromium | str:
    """Chromium, or why it cannot be had."""
    installed = shutil.which("chromium")
    if installed is not None:
        return Chromium(installed, {})
    place = made_once("chromium-debian", _made)
    if isinstance(place, str):
        return place
    tree = place / "tree"
    environment = {
        **os.environ,
        "LD_LIBRARY_PATH": libraries(tree),
        "FONTCONFIG_FILE": str(place / "fonts.conf"),
    }
    return Chromium(str(tree / "usr/lib/chromium/chromium"), dict(environment))


def _made(place: Path) -> str:
    failure = unpack(place, PACKAGES)
    if not failure:
        (place / "fonts.conf").write_text(
            textwrap.dedent(
                f"""\
                <?xml version="1.0"?>
                <!DOCTYPE fontconfig SYSTEM "fonts.dtd">
                <fontconfig>
                  <dir>{place}/tree/usr/share/fonts</dir>
                  <dir>/usr/share/fonts</dir>
                  <cachedir>{place}/fonts</cachedir>
                </fontconfig>
                """
            )
        )
    return failure
