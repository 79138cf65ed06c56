"""A manifest with an odd value, whose digest is right, concerns its recording only."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from blake3 import blake3
from hypothesis import given, settings
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog_storage.cells import CATALOG
from hybridlog_storage.manifest import Loss, encode, replace
from hybridlog_storage.manifests import MANIFEST_OLD
from tests import odd_values, places
from tests.cli.within import answer
from tests.copying.conftest import expire
from tests.payloads.logs import BASE, SETTINGS, STEP, robot, write_log

NOWHERE = "mongodb://127.0.0.1:9/x?serverSelectionTimeoutMS=20&connectTimeoutMS=20"
COUNT = 20
LOSS = Loss("segment", "/number", 3, BASE, BASE + STEP, "r", "000000.mcap", 5, 6)
READING: Sequence[Sequence[str]] = (
    ("ls", "--json"),
    ("ls",),
    ("info", "odd"),
    ("info", "odd", "--json"),
    ("info", "--losses"),
    ("info", "--losses", "--json"),
    ("info", "--sizes", "both"),
    ("info", "-t", "/scan"),
    ("fetch", "-t", "/number", "--count"),
    ("fetch", "-t", "/number", "--count", "--strict"),
    ("fetch", "-t", "/scan", "-r", "odd", "--fields", "header"),
    ("fetch", "-t", "/number", "--between", "+1s", "+2s", "--format", "jsonl"),
    ("intervals", "-t", "/number", "--where", "data > 3", "--state"),
    ("intervals", "-t", "/number", "--gaps"),
    ("stats", "-t", "/number"),
    ("sql", "select * from losses"),
    ("sql", "select * from recordings"),
    ("sql", "select count(*) from number"),
    ("info", "odd", "--attachments"),
    ("verify",),
)
CHANGING: Sequence[Sequence[str]] = (
    ("verify", "--repair"),
    ("tag", "odd", "k=v"),
    ("edit", "odd", "--note", "x"),
    ("mark", "odd", "--at", "+1s", "m"),
    ("edit", "odd", "--name", "even"),
    ("rm", "odd", "--yes"),
)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings; the manifest of one has a value of every kind."""
    place = tmp_path_factory.mktemp("odd")
    path = place / "store"
    with hl.open(path, create=True) as store:
        for name, count in (("odd", 60), ("other", COUNT)):
            log = write_log(place / f"{name}.mcap", robot(count))
            store.record(log, name=name, settings=SETTINGS)
        expire(store, "odd", [0])
        store.edit("odd", note="wind")
        store.edit("odd", tag={"place": "lab"})
        store.mark("odd", BASE + STEP, "here", {"kind": "odd"}, until=BASE + 2 * STEP)
        store.pin("odd", topics=["/number"], reason="wanted")
    shutil.rmtree(path / "mongod", ignore_errors=True)
    (path / CATALOG).unlink()
    return path


@pytest.fixture(scope="module")
def manifest(template: Path) -> dict[str, Any]:
    found = replace(
        places.manifest(template, "odd"),
        status="damaged",
        losses=(LOSS,),
    )
    made: dict[str, Any] = json.loads(encode(found).split(b"\n")[0])
    return made


def hold(template: Path, path: Path, manifest: Any, commands: Sequence[Sequence[str]]) -> None:
    """Run commands on a store with this manifest: no traceback, and the other recording answers."""
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(template, path)
    text = json.dumps(manifest, separators=(",", ":")).encode()
    folder = places.folder(path, "odd")
    (places.manifest_of(folder)).write_bytes(
        b"%b\n%b\n" % (text, blake3(text).hexdigest().encode())
    )
    (folder / MANIFEST_OLD).write_bytes((places.manifest_of(folder)).read_bytes())
    other = ("fetch", "-t", "/number", "-r", "other", "--count")
    for command in (other, *commands, other):
        found = answer(*command, "--mongo", NOWHERE, store=path, code=None)
        if command is other:
            assert found.out.strip() == str(COUNT)
        else:
            # Wrong usage, what verify has found, losses, and a recording that cannot be read.
            assert found.code in {0, 1, 2, 4, 5, 6, 11}, (command, found)


@settings(max_examples=8)
@given(data=st.data())
def test_an_odd_value_concerns_its_recording_only(
    template: Path,
    manifest: dict[str, Any],
    tmp_path_factory: pytest.TempPathFactory,
    data: Any,
) -> None:
    _, path = data.draw(st.sampled_from(odd_values.places([manifest])))
    odd = odd_values.with_value(manifest, path, data.draw(odd_values.VALUES))
    commands = [*(data.draw(st.sampled_from(READING)) for _ in range(3))]
    commands.append(data.draw(st.sampled_from(CHANGING)))
    hold(template, tmp_path_factory.getbasetemp() / "odd-store", odd, commands)


@pytest.mark.exhaustive
@pytest.mark.parametrize("which", range(8))
def test_every_odd_value_and_every_command(
    template: Path, manifest: dict[str, Any], tmp_path: Path, which: int
) -> None:
    for _, path in odd_values.places([manifest])[which::8]:
        for value in odd_values.ODD:
            odd = odd_values.with_value(manifest, path, value)
            hold(template, tmp_path / "store", odd, [*READING, *CHANGING])
