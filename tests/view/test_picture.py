"""The script that takes the picture of the README."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

import hybridlog as hl
from tests.imports import ROOT
from tests.view.chromium import Chromium


@pytest.mark.peer("browser")
def test_the_picture_of_the_readme(
    demo_store: hl.Store, installed: Chromium, tmp_path: Path
) -> None:
    taken = tmp_path / "view.png"
    subprocess.run(
        [
            *(sys.executable, ROOT / "docs/pictures/make.py", taken),
            *("--store", demo_store.directory.path, "--browser", installed.path),
        ],
        env=installed.environment or None,
        check=True,
    )
    with Image.open(taken) as now, Image.open(ROOT / "docs/pictures/view.png") as shown:
        assert now.size == shown.size
        assert len(now.convert("RGB").getcolors(1 << 20) or ()) > 100  # no empty page
