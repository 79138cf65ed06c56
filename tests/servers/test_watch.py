"""`hybridlog index watch`: a server whose store robots copy into."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from pymongo import MongoClient

import hybridlog as hl
from hybridlog_storage.mongo.index_documents import IndexState
from tests import logs, places
from tests.cli.running import COMMAND, environment
from tests.indexed import misindexed
from tests.servers.mongods import Mongod, eventually

pytestmark = pytest.mark.mongo("embedded")

WATCH = ("index", "watch", "--every", "100ms")


def arrive(robot: Path, lab: Path, label: str) -> None:
    """A recording comes whole into the lab's store, as a copy lets it."""
    folder = places.folder(robot, label)
    there = places.new_folder(lab, folder.name)
    shutil.copytree(folder, there)
    coming = places.manifest_of(there).with_name(".coming")
    shutil.copy(places.manifest_of(folder), coming)
    coming.rename(places.manifest_of(there))


def test_what_comes_into_a_store_is_indexed_once_by_several_that_watch(tmp_path: Path) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    with hl.open(robot, create=True, mongo="none") as store:
        for n in range(4):
            log = logs.write(tmp_path / f"{n}.mcap", logs.content(n, 20 + n))
            store.record(log, name=f"drive-{n}", settings=logs.SETTINGS)
        expected = store.all_topics().count()
    with (
        Mongod(tmp_path / "mongod") as server,
        MongoClient[dict[str, Any]](f"mongodb://{server.address}/") as client,
    ):
        eventually(lambda: client.admin.command("ping"), "no server")
        uri = f"mongodb://{server.address}/lab?serverSelectionTimeoutMS=500"
        with hl.open(lab, create=True, mongo=uri) as store:
            arrive(robot, lab, "drive-0")
            store.shared.index.connect()

        def is_indexed(label: str) -> Any:
            with hl.open(robot, mongo="none") as source, hl.open(lab, mongo=uri) as store:
                state = IndexState(store.shared.index.connect(brings=False))
                entry = source.entry(label)
                return state.of([entry.key]) == {entry.key: entry.digests}

        with ExitStack() as stack:
            watching, outs, errs = [], [tmp_path / "out-0", tmp_path / "out-1"], []
            for out in outs:
                errs.append(out.with_suffix(".err"))
                watching.append(
                    stack.enter_context(
                        subprocess.Popen(
                            [*COMMAND, *WATCH, "--store", str(lab), "--json"],
                            env=environment(),
                            stdout=stack.enter_context(out.open("w")),
                            stderr=stack.enter_context(errs[-1].open("w")),
                        )
                    )
                )
                stack.callback(watching[-1].kill)

            def all_say(text: str) -> bool:
                return all(text in err.read_text() for err in errs)

            eventually(lambda: all_say("Watching"), "nobody watches")
            for n in (1, 2):
                arrive(robot, lab, f"drive-{n}")
            eventually(lambda: is_indexed("drive-1") and is_indexed("drive-2"), "not indexed")
            eventually(lambda: "drive-2" in "".join(out.read_text() for out in outs), "not told")
            server.kill()
            arrive(robot, lab, "drive-3")
            eventually(lambda: all_say("MongoDB"), "nobody says that MongoDB is away")
            server.start()
            eventually(lambda: client.admin.command("ping"), "no server")
            eventually(lambda: is_indexed("drive-3"), "not indexed after MongoDB came back")
            for process in watching:
                process.send_signal(signal.SIGINT)
            assert [process.wait(60) for process in watching] == [0, 0], errs[0].read_text()
        lines = [json.loads(line) for out in outs for line in out.read_text().splitlines()]
        assert {line["recording"] for line in lines} == {"drive-1", "drive-2", "drive-3"}
        assert all(line["chunks"] > 0 for line in lines)
        with hl.open(lab) as store:
            assert misindexed(store) == {}
            assert store.all_topics().count() == expected
