"""`hybridlog copy` as a user runs it, over ssh and watching, too."""

from __future__ import annotations

import re
import signal
from collections import Counter
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.cli.signals import Stopped
from hybridlog.drawing.times import aligned, lane_of
from hybridlog.schema.states import CAUSES, State, without_payload
from hybridlog_storage import stopping
from hybridlog_storage.errors import PayloadError
from tests import places
from tests.cli.running import run, started
from tests.cli.within import answer
from tests.copying.conftest import answers, expire
from tests.copying.server import Sshd
from tests.json_schemas import misfit, schema_of
from tests.waiting import wait_for


def test_copies_to_a_directory(
    robots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run("copy", "noted", "-r", "exp*", tmp_path / "lab", "--store", robots)
    assert sorted(done.lines) == ["copied expired", "copied noted"]
    again = run("copy", tmp_path / "lab", "--store", robots, "--tag", "place", "--json")
    assert again.json["known"] == ["noted"]
    assert not misfit(again.json, schema_of(["copy"]))
    assert again.json["bytes_copied"] == 0
    assert answers(tmp_path / "lab", "noted") == answers(robots, "noted")
    for wrong, cure in {
        "ssh://-oProxyCommand=x/y": "Write ssh://user@host/path",
        "ssh://a:b@c/d": "has no password",
        **dict.fromkeys(
            ("ssh:/lab/data", "me@lab:/data", "lab:data", "ftp://x/y", "file:///data"),
            "Write ssh://user@host/path for a server, s3://, gs:// or az:// for a bucket, and ./",
        ),
        "~nosuchuser/x": "no such home directory",
        str(robots / "inside"): "lies inside the store",
    }.items():
        assert cure in run("copy", wrong, "--store", robots, code=2).err
    run("copy", "noted", "~/home", "--store", robots, HOME=str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab:data").mkdir()
    with hl.open(robots, mongo="none") as store:
        for there in ("./lab:here", "lab:data"):
            store.copy(there, ["noted"])
    for there in ("home", "lab:here", "lab:data"):
        assert places.folder(tmp_path / there, "noted").is_dir()
    assert run("copy", tmp_path / "x", "--store", robots, "--limit-rate", "0", code=2).err
    assert run("copy", "nosuch", tmp_path / "x", "--store", robots, code=2).err


WHY = {
    State.NOT_COPIED: "not copied yet (`hybridlog copy",
    State.EXPIRED: "deleted to make room",
}


def test_some_were_deleted_before_and_others_not_copied_yet(robots: Path, tmp_path: Path) -> None:
    """Each message knows its own state, in a copy of a copy, too, and when payloads follow."""
    here, lab, there = tmp_path / "here", tmp_path / "lab", tmp_path / "there"
    with hl.open(robots, mongo="none") as robot:
        robot.copy(here, ["noted"])
    with hl.open(here, mongo="none") as store:
        expire(store, "noted", [0])
        was = Counter(one.state for one in store.topic("/cloud"))
    gone = was[State.EXPIRED]
    assert gone
    assert was[State.WHOLE]
    run("copy", lab, "--store", here, "--only-fields")
    run("copy", there, "--store", lab)
    for place in (lab, there):
        assert not answer("verify", "--json", store=place).json["findings"]
        counted = _told(place)
        assert counted == {State.EXPIRED: gone, State.NOT_COPIED: was[State.WHOLE]}
    run("copy", there, "--store", here)
    assert _told(there) == was


def _told(path: Path) -> Counter[State]:
    """States of a topic's messages, that all places agree on."""
    with hl.open(path, mongo="none") as store:
        query = store.topic("/cloud")
        found = Counter(one.state for one in query)
        told = query.completeness()
        assert (told.expired, told.not_copied) == (found[State.EXPIRED], found[State.NOT_COPIED])
        sql = store.sql("select state, count(*) from cloud group by 1").to_arrow().to_pydict()
        assert dict(zip(*sql.values(), strict=True)) == found
        (one,) = store.session.look().summaries
        assert one.span is not None
        span = one.span[0], one.span[1] + 1
        lane = lane_of(store.session, store.entry(one.id), "/cloud")
        assert lane.counts(aligned(span, 8)).sum() == found.total()
        (listed,) = answer("ls", "--json", store=path).json
        assert (listed["expired"], listed["not_copied"]) == (one.expired, one.not_copied)
        for message in query:
            if message.state in WHY:
                with pytest.raises(PayloadError, match=re.escape(WHY[message.state])):
                    _ = message.raw
    raw = answer("fetch", "cloud", "-o", path.with_suffix(".mcap"), "--force", store=path).err
    arrays = answer("sql", "select sum(len(data)) from cloud", store=path).err
    verified = answer("verify", store=path)
    assert "to make room" not in verified.out + verified.err
    for state, number in ((State.EXPIRED, one.expired), (State.NOT_COPIED, one.not_copied)):
        assert (WHY[state] in " ".join(arrays.split())) == bool(number)
        text = answer("info", "--json", store=path).json[0]["coverage"]
        assert (CAUSES[state] in text) == bool(number)
        assert not number or f"{number} " in text
        words = "deleted" if state is State.EXPIRED else "not copied yet"
        assert (f"{number} payloads {words}" in answer("ls", store=path).out) == bool(number)
        sentence = f"{without_payload(found[state], state)}: not in this answer"
        assert (sentence in " ".join(raw.split())) == bool(number)
    return found


def test_copies_over_ssh(robots: Path, tmp_path: Path, sshd: Sshd) -> None:
    server, there = sshd, tmp_path / "lab store"
    url = server.url(there).replace(" ", "%20")
    words = ("copy", "driven", url, "--store", robots, "--ssh")
    server.left = 20_000
    cut = run(*words, server.ssh, code=5)
    assert "run the command again" in cut.err
    server.reset()
    assert run(*words, server.ssh).lines == ["copied driven"]
    assert run(*words, server.ssh).lines == ["driven is there already"]
    assert answers(there, "driven") == answers(robots, "driven")
    away = run(*words, "sh -c 'echo no route to lab >&2; exit 255'", code=5)
    assert f"{url} is not reached: no route to lab" in away.err
    missing = run(*words, "nosuch-program", code=5)
    assert "nosuch-program" in missing.err


def test_follows_a_store(robots: Path, tmp_path: Path) -> None:
    store, lab, told = tmp_path / "robot", tmp_path / "lab", tmp_path / "told"
    run("record", robots.parent / "noted.mcap", "--store", store, "--mongo", "none")
    words = ("copy", lab, "--store", store, "--watch")
    with started(*words, output=told) as process:
        wait_for(lambda: told.read_text().splitlines()[1:] == ["copied noted"])
        run("record", robots.parent / "driven.mcap", "--store", store, "--mongo", "none")
        wait_for(lambda: told.read_text().splitlines()[1:] == ["copied noted", "copied driven"])
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    assert answers(lab, "driven") == answers(store, "driven")


def test_a_watch_goes_on_after_a_cut(
    robots: Path, tmp_path: Path, sshd: Sshd, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses, server = [], sshd

    def pause(seconds: float) -> None:
        server.reset()  # the connection is there again
        pauses.append(seconds)
        if len(pauses) == 2:
            raise Stopped(signal.SIGINT)

    monkeypatch.setattr(stopping, "pause", pause)
    server.left = 20_000
    words = ("copy", "driven", server.url(tmp_path / "lab"), "--ssh", server.ssh)
    told = answer(*words, "--watch", "--json", store=robots)
    assert pauses == [2, 2]
    assert [line for line in told.lines if '"copied": ["driven"]' in line] == told.lines[-1:]
    assert answers(tmp_path / "lab", "driven") == answers(robots, "driven")


def test_a_signal_ends_a_watch_amid_a_recording(robots: Path, tmp_path: Path) -> None:
    lab, told = tmp_path / "lab", tmp_path / "told"
    words = ("copy", "driven", lab, "--store", robots, "--watch")
    with started(*words, "--limit-rate", "1kB/s", output=told) as process:
        wait_for(lambda: any(file.stat().st_size for file in lab.rglob("*.part")))
        process.terminate()
        assert process.wait(60) == 0
    assert run("copy", "driven", lab, "--store", robots).lines == ["copied driven"]
