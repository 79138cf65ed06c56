"""The limit of the whole process of `hybridlog sql`."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from hybridlog.sql.engine import OWN_MEMORY, limited_memory, private_bytes
from tests.cli.running import COMMAND, environment

LIMIT = 64 << 20
START = 300 << 20  # what a process has before its first query, and files that it maps
# DuckDB counts neither of them.
GROWING = ("select unnest(range(100000000))", "select repeat('x', 900000000)")


# A process that is started counts the memory of the one that starts it as its own.
MEASURED = """
import resource, subprocess, sys
ended = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(ended.returncode)
"""


@pytest.mark.parametrize("query", GROWING)
def test_a_query_takes_no_more_than_it_may(root: Path, query: str) -> None:
    command = [*COMMAND, "sql", "--store", str(root), "--memory", "64MiB", query]
    ended = subprocess.run(
        [sys.executable, "-c", MEASURED, *command],
        check=False,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 7, ended.stderr
    said = "The query needs more than 64 MiB of memory: ask for less at a time"
    assert said in ended.stderr
    assert int(ended.stdout.splitlines()[-1]) << 10 < LIMIT + OWN_MEMORY + START


def test_a_limit_ends_with_its_block() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with limited_memory(LIMIT) as most:
        assert 0 <= most - private_bytes() - LIMIT - OWN_MEMORY <= LIMIT
        with pytest.raises(MemoryError):
            bytearray(most)
        with limited_memory(1 << 40) as inner:
            assert inner == most
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
