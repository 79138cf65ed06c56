"""Hostile logs end within 5 s of processor time and 500 MB, or are refused with the reason."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hybridlog.live.sources.ros2.overrides import read_overrides
from hybridlog.yaml_values import YamlError, parse_yaml
from hybridlog_storage.errors import UsageError
from tests.sources.test_rosbag2 import make

CPU_S = 5
MEMORY = 500 << 20

READ = """
import json, sys
from pathlib import Path
from hybridlog.sources.detect import open_source

with open_source(Path(sys.argv[1])) as source:
    messages = sum(len(batch) for batch in source.batches())
    damage = [[each.reason, each.messages_lost] for each in source.damage]
    print(json.dumps([messages, len(source.channels), damage]))
"""


def bounded(*command: str, memory: int = MEMORY) -> subprocess.CompletedProcess[str]:
    """Run a Python command with limits of processor time and memory."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))

    environment = {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    return subprocess.run(
        [sys.executable, *command],
        preexec_fn=limit,
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )


def read(path: Path) -> tuple[int, int, list[Any]]:
    """Number of messages and channels of a log, and its damage, read within the limits."""
    done = bounded("-c", READ, str(path))
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    messages, channels, damage = json.loads(done.stdout)
    return messages, channels, damage


# YAML

BAG = (
    "rosbag2_bagfile_information:\n  storage_identifier: sqlite3\n"
    "  relative_file_paths: [bag.db3]\n"
)
LAUGHS = "a0: &a0 [x]\n" + "".join(
    f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)
)
MERGES = "a0: &a0 {k: 1}\n" + "".join(
    f"a{k}: &a{k} {{<<: [{','.join([f'*a{k - 1}'] * 9)}]}}\n" for k in range(1, 12)
)
LARGE = 6_000_000


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (LAUGHS + BAG, None),
        (MERGES + BAG, None),
        (BAG + "  files: &a [*a, *a]\n  message_count: *none\n", None),
        (BAG + "".join(f"  k{k}: 1\n" for k in range(LARGE // 30)), None),
        (BAG + "  junk: " + "word " * (LARGE // 5), None),
        (BAG + "  junk: &" + "a" * LARGE + " x\n", None),
        (BAG + "  junk: " + "[" * (LARGE // 2) + "]" * (LARGE // 2), "nesting depth"),
        ("? " * (LARGE // 2), "a key is a list"),
        (BAG + "  junk: [" + "," * LARGE, "cannot be used"),
        (BAG + "  junk: [" + "a," * LARGE, "more than 2000000 keys and values"),
        (BAG + "  junk: " + "9" * (1 << 26), "more than 64 MiB"),
    ],
    ids=lambda value: str(value)[:20] if value else "read",
)
def test_metadata_of_any_kind_is_bounded(tmp_path: Path, text: str, reason: str | None) -> None:
    folder = make(tmp_path / "bag")
    (folder / "metadata.yaml").write_text(text)
    messages, _, damage = read(folder)
    assert messages == 300
    if reason is None:
        assert damage == []
    else:
        assert len(damage) == 1
        assert reason in damage[0][0]
        assert "the files beside it are read without it" in damage[0][0]


def test_missing_files_of_the_metadata_are_counted_together(tmp_path: Path) -> None:
    folder = make(tmp_path / "bag")
    files = "".join(f"    - {{path: f{k}.db3, message_count: 2}}\n" for k in range(1000))
    (folder / "metadata.yaml").write_text(f"{BAG}  files:\n{files}")
    assert read(folder)[2] == []
    text = BAG.replace(
        "[bag.db3]", "[bag.db3, " + ", ".join(f"f{k}.db3" for k in range(1000)) + "]"
    )
    (folder / "metadata.yaml").write_text(f"{text}  files:\n{files}")
    damage = read(folder)[2]
    assert damage[:100] == [["the file is missing; metadata.yaml lists it", 2]] * 100
    assert damage[100:] == [["900 more files that it lists are missing", 1800]]


def test_yaml_values() -> None:
    text = "{a: 1, b: '1', c: ~, d: True, e: 1.5, f: &x [-2, null], g: *x, <<: {h: 1}, i: !!str 3}"
    found = parse_yaml(text)
    assert found == {
        "a": 1,
        "b": "1",
        "c": None,
        "d": True,
        "e": "1.5",
        "f": [-2, None],
        "g": [-2, None],
        "<<": {"h": 1},
        "i": "3",
    }
    assert parse_yaml("a: {b: 1, x: {b: 2}}\nx: [1]\nb: 3", {"a", "b"}) == {"a": {"b": 1}, "b": 3}
    assert parse_yaml("a: 1\n---\n}") == {"a": 1}
    assert parse_yaml("") is None
    for wrong in ("{a: 1, a: 2}", "[", "{[a]: 1}", "\x00", "\ud800"):
        with pytest.raises(YamlError):
            parse_yaml(wrong)


def test_overrides_that_grow_are_shown_in_short(tmp_path: Path) -> None:
    path = tmp_path / "qos.yaml"
    path.write_text(LAUGHS + "/a: {depth: *a11}\n")
    with pytest.raises(UsageError, match="topic with policies") as found:
        read_overrides(path)
    assert len(str(found.value)) < 500
    path.write_text("/b:\n  depth: &a0 [x]\n" + "/a: {depth: 1}\n")
    with pytest.raises(UsageError, match="depth is a number"):
        read_overrides(path)
