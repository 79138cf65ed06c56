"""Outputs of one long message take memory for a few copies of it, not for its text."""

from __future__ import annotations

import os
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from hybridlog_storage.messages import Channel, Schema
from tests.independent import write_mcap
from tests.some import in_turn

from .running import run

SIZE = 16 << 20
PROGRAM = "from hybridlog.cli.app import main; import sys; sys.exit(main())"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("long")
    random, rows = np.random.default_rng(0), []
    for name, definition, width in (("bytes", b"uint8[] a\n", 1), ("doubles", b"float64[] a\n", 8)):
        schema = Schema(f"my/msg/{name.title()}", "ros2msg", definition)
        for size in (16, SIZE):
            where = "long" if size == SIZE else "short"
            count = size // width
            values = random.random(count) if width == 8 else random.integers(0, 256, count, "u1")
            head = b"\0\1\0\0" + struct.pack("<I", count) + bytes(4 if width == 8 else 0)
            channel = Channel(f"/{name}/{where}", "cdr", schema)
            rows.append((channel, 10**18, head + values.tobytes(), 0))
    write_mcap(place / "long.mcap", rows)
    run("record", place / "long.mcap", "-q", store=place / "store")
    return place / "store"


def _peak(*words: str) -> int:
    """Greatest memory of a command, bytes."""
    child = os.fork()
    if not child:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.execv(sys.executable, [sys.executable, "-c", PROGRAM, *words])
    _, status, usage = os.wait4(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0, words
    return usage.ru_maxrss * 1024


@pytest.mark.parametrize(
    ("form", "kind"), in_turn(["jsonl", "table", "csv", "arrow"], ["bytes", "doubles"], every=2)
)
def test_one_long_message(store: Path, form: str, kind: str) -> None:
    words = ("fetch", "-q", "--store", str(store), "-F", form, "-o", "-")
    words = words[:-2] if form == "table" else words
    usual = _peak(*words, "-t", f"/{kind}/short")
    assert _peak(*words, "-t", f"/{kind}/long") - usual < 4 * SIZE
