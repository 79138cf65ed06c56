"""`hybridlog record` of what speaks, and the commands that visit a recorder."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.cli import record_live
from hybridlog.live.sources.base import Sink
from hybridlog_storage.errors import UsageError
from tests import places
from tests.cli.running import BACKGROUND, COMMAND, complete, environment, run
from tests.cli.within import answer
from tests.independent import read
from tests.limits import Limit
from tests.live.speaker import Speaker, text, text_channel
from tests.waiting import wait_for


@contextmanager
def recorder(
    store: Path, *arguments: object, program: Sequence[str] = COMMAND, **variables: str
) -> Iterator[subprocess.Popen[str]]:
    """A recorder that says on standard output, in JSON, how it is doing."""
    process = subprocess.Popen(
        [
            *BACKGROUND,
            *program,
            "record",
            "--store",
            str(store),
            "--json",
            "--reserve",
            "0",
            *map(str, arguments),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(**variables),
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def until_it_speaks(
    process: subprocess.Popen[str],
    holds: Callable[[dict[str, Any]], object] = lambda state: state["messages"],
) -> dict[str, Any]:
    """Wait until something is the case, such as that messages have come; the state then."""
    assert process.stdout is not None
    for line in process.stdout:
        state: dict[str, Any] = json.loads(line)["state"]
        if holds(state):
            return state
    raise AssertionError("it ended before anything came")


def end(process: subprocess.Popen[str], number: int | None = signal.SIGINT) -> dict[str, Any]:
    """End it as Ctrl-C does; its report."""
    return end_and_hear(process, number)[0]


def end_and_hear(
    process: subprocess.Popen[str], number: int | None = signal.SIGINT
) -> tuple[dict[str, Any], str]:
    """End it as Ctrl-C does; its report, and what it said besides."""
    if number is not None:
        process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, (process.returncode, err)
    assert "Traceback" not in err, err
    report: dict[str, Any] = json.loads(out.splitlines()[-1])["report"]
    return report, err


def test_a_replay_is_recorded_whole(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    done = run("record", "--replay", logs / "small.bag", "--speed", 20, "--reserve", 0, store=store)
    assert "received; complete; all sources have ended" in done.out
    expected = read(logs / "small.bag")
    run("export", tmp_path / "out.mcap", store=store)
    found = read(tmp_path / "out.mcap")
    assert Counter((m.topic, m.payload) for m in found) == Counter(
        (m.topic, m.payload) for m in expected
    )
    assert "complete" in run("info", "small", store=store).out
    assert "Nothing is missing" in run("info", "--losses", store=store).err


def test_a_service_manager_hears_of_it(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"{tmp_path.name}-notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"\0{name}")
        monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
        record_live.notify_service("READY=1", "STATUS=x")
        assert manager.recv(4096) == b"READY=1\nSTATUS=x"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(60)
        words = ("--replay", logs / "robot.bag", "--no-derive")
        variables = {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        with recorder(tmp_path / "store", *words, **variables) as process:
            heard = [manager.recv(4096).decode().splitlines() for _ in range(3)]
            report = end(process, signal.SIGTERM)
            while "STOPPING=1" not in heard[-1]:
                heard.append(manager.recv(4096).decode().splitlines())
    *running, last = heard
    assert last == ["STOPPING=1", "STATUS=writing what is left"]
    for ready, status, watchdog in running:
        assert (ready, watchdog) == ("READY=1", "WATCHDOG=1")
        assert re.fullmatch(r"STATUS=\d+ s · \d+ messages/s · .* free", status)
    assert report["exit_code"] == 0


def named(row: str, cell: int) -> set[str]:
    """What a cell of a table names."""
    return {*re.findall(r"`(\w+)`", row.split("|")[cell])}


def test_what_a_power_cut_left_is_recovered_behind_the_new_recording(
    logs: Path, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    replay = ("--replay", logs / "robot.bag", "--flush-interval", "100ms")
    with recorder(store, *replay) as process:
        until_it_speaks(process)
        with hl.open(store, read_only=True) as seen:
            wait_for(lambda: seen.recordings()[0].messages)  # it may speak before it has written
        process.kill()
    assert {one.suffix for one in places.folder(store, "robot").glob("0*")} == {".open"}
    with recorder(store, *replay, "--speed", 0.1) as process:
        assert until_it_speaks(process)["name"] == "robot-2"
        report, said = end_and_hear(process)
    (recording,) = report["recordings"]
    assert recording["messages"] == report["messages_received"] > 0
    found = {one["name"]: one for one in run("ls", "--json", store=store).json}
    assert {label: one["status"] for label, one in found.items()} == {
        "robot": "recovered",
        "robot-2": "complete",
    }
    kept = re.search(r"robot was cut short by a crash: (\d+) mes", said)
    assert kept is not None
    assert found["robot"]["messages"] == int(kept[1]) > 0
    assert "all is well" in run("verify", store=store).out


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_who_reads_what_it_says_may_go(logs: Path, tmp_path: Path, stream: str) -> None:
    words = ("--replay", logs / "robot.bag", "--speed", 8, "--no-derive", "--throttle", "/z", "1Hz")
    with recorder(tmp_path / "store", *words) as process:
        until_it_speaks(process)
        getattr(process, stream).close()
        (process.stdout if stream == "stderr" else process.stderr).read()
        assert process.wait(60) in {0, 1}
    (entry,) = run("ls", "--json", store=tmp_path / "store").json
    assert entry["status"] == "complete"


def test_a_recorder_is_visited(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with recorder(
        store, "--replay", logs / "robot.bag", "--speed", 0.2, "--name", "first drive"
    ) as process:
        until_it_speaks(process)
        run("mark", "gripper slipped", "--set-tag", "trial=7", "-r", "first drive", store=store)
        state = run("top", "first drive", "--json", "--once", store=store).json
        assert state["messages"] > 0
        shown = run("top", store=store).out
        assert "/imu/data" in shown
        assert "messages/s" in shown
        run("mark", "x", "--pin", "1s", "2s", "--at", "+1s", store=store, code=2)
        assert "is no running recorder" in run("mark", "x", "-r", "zz", store=store, code=2).err
        assert complete(f"mark x --store {store} -r fi") == ["first drive"]
        info = run("info", store=store).out
        assert "being recorded" in info
        assert "later losses are to come: first drive." in run("info", "--losses", store=store).err
        assert_ctrl_c_leaves_top(store)
        end(process)
    found = run(
        "fetch", "-t", "marks", "--where", "tags.trial = '7'", "--format", "jsonl", store=store
    )
    assert json.loads(found.out.splitlines()[0])["text"] == "gripper slipped"
    for command in (["top"], ["mark", "x"]):
        assert "No recorder runs on this store" in run(*command, store=store, code=2).err
        assert "nope is not a hybridlog store" in run(*command, store=store / "nope", code=5).err


def assert_ctrl_c_leaves_top(store: Path) -> None:
    watching = subprocess.Popen(
        [*COMMAND, "top", "--json", "--store", str(store)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    assert watching.stdout is not None
    assert watching.stdout.readline()
    watching.send_signal(signal.SIGINT)
    _, err = watching.communicate(timeout=30)
    assert (watching.returncode, err) == (0, "")


@pytest.mark.mongo
def test_what_a_follower_has_left_is_made_by_the_next_command(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with recorder(store, "--replay", logs / "robot.bag") as process:
        until_it_speaks(process)
        follower = follower_of(process)
        assert follower is not None
        os.kill(int(follower.name), signal.SIGSTOP)
        report, said = end_and_hear(process, signal.SIGTERM)
    assert "tables and index are not complete: the next command makes the rest" in said
    (recording,) = report["recordings"]
    assert recording["messages_indexed"] < recording["messages"] == report["messages_received"]
    assert recording["bytes_in"] > recording["messages"]
    assert run("ls", "--json", store=store).json[0]["status"] == "complete"
    assert "all is well" in run("verify", store=store).out


def follower_of(recorder: subprocess.Popen[str]) -> Path | None:
    """Its place in /proc."""
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parent = re.search(r"(?m)^PPid:\t(\d+)$", (place / "status").read_text())
            is_child = parent is not None and int(parent[1]) == recorder.pid
            if is_child and b"hybridlog.follow" in (place / "cmdline").read_bytes():
                return place
    return None


@pytest.mark.parametrize("triggers", [(), ("--trigger", "/imu/data")])
def test_the_follower_ends_with_a_recorder_that_is_killed(
    logs: Path, tmp_path: Path, triggers: tuple[str, ...]
) -> None:
    """Without triggers it takes the time that nobody wants."""
    words = ("--replay", logs / "robot.bag", "--mongo", "none", *triggers)
    nobody = {"NOTIFY_SOCKET": str(tmp_path / "nobody")}
    with recorder(tmp_path / "store", *words, **nobody) as process:
        until_it_speaks(process)
        wait_for(lambda: follower_of(process))
        place = follower_of(process)
        assert place is not None
        wait_for(lambda: (place / "oom_score_adj").read_text() == "500\n")
        policy = os.SCHED_OTHER if triggers else os.SCHED_IDLE
        wait_for(lambda: os.sched_getscheduler(int(place.name)) == policy)
        assert b"NOTIFY_SOCKET" not in (place / "environ").read_bytes()
        process.kill()
        process.wait()
        wait_for(lambda: not place.exists())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("", "Nothing to record"),
        ("--replay {bag} {bag}", "--replay and PATH exclude"),
        ("--replay {bag} --between +1s +2s", "--replay and --between exclude"),
        ("--replay {bag} --no-latched", "--replay and --no-latched exclude"),
        ("--replay {bag} --throttle /a fast", "is no rate"),
        ("--replay {bag} --priority /a urgent", "Unknown priority"),
        ("--replay {bag} --ring 1s --before 2s", "longer than --ring"),
        ("--replay {bag} --ring 0s", "--ring must be at least 1ns, not 0s."),
        ("--replay {bag} --ring 2s --use-sim-time", "--ring and --use-sim-time exclude"),
        ("{bag} --use-sim-time", "--use-sim-time is for --ros1 or --ros2"),
        ("--replay {bag} --ring 2d", "--ring must be at most 24h, not 2d."),
        ("--replay {bag} --ring 1s --trigger '/a: x >'", "x >"),
        ("--replay {bag} --budget 5kB", "--budget must be at least 1MiB"),
        ("--replay {bag} --split-size 1", "--split-size must be at least 1MiB"),
        ("--replay {bag} --flush-interval 2h", "--flush-interval must be at most 1h, not 2h."),
        ("{bag} --duration 3s --throttle /a 5Hz", "--duration is for --ros1"),
        ("--ros1 http://localhost:1 --speed 2", "--speed is for --replay"),
        ("--ros1 127.0.0.1:11311", "'127.0.0.1:11311' is not an address like http://host:port"),
        ("--ros1 '' --duration 1s", "looks like http://host:11311; this one is empty"),
        ("--foxglove http://robot", "does not begin with ws://"),
    ],
)
def test_options_that_make_no_sense_leave_no_store(
    logs: Path, tmp_path: Path, arguments: str, said: str
) -> None:
    store = tmp_path / "store"
    words = shlex.split(arguments.format(bag=logs / "small.bag"))
    assert said in answer("record", *words, store=store, code=UsageError.exit_code).err
    assert not store.exists()


def test_a_disk_without_room_is_code_7(logs: Path, tmp_path: Path) -> None:
    arguments = ("record", "--replay", logs / "small.bag", "--speed", 20, "--reserve")
    done = run(*arguments, "4000TB", "-q", store=tmp_path / "store", code=7)
    assert "--reserve" in done.err
    assert done.out == ""
    assert places.names(tmp_path / "store") == []


def test_a_damaged_log_is_told_when_it_is_replayed(logs: Path, tmp_path: Path) -> None:
    done = run(
        *("record", "--replay", logs / "torn.bag", "--speed", 50, "--reserve", 0),
        *("--throttle", "/nope", "5Hz", "--priority", b"b\xff", "low", "-t", "/nothing", "-t", "*"),
        store=tmp_path / "store",
        code=4,
    )
    assert "received; an unknown number of messages lost" in done.out
    assert (
        "hybridlog: an unknown number of messages lost in 1 place that cannot be read" in done.err
    )
    assert "no topic fits '/nope' of --throttle" in done.err
    assert "no topic fits 'b\\xff' of --priority" in done.err
    assert "no topic fits '/nothing'" in done.err


def test_a_robot_that_was_never_there_is_told(tmp_path: Path) -> None:
    done = run(
        *("record", "--ros1", "http://127.0.0.1:1", "--foxglove", "ws://127.0.0.1:1"),
        *("--duration", "1s", "--reserve", 0),
        store=tmp_path / "store",
        code=3,
    )
    for address in ("http://127.0.0.1:1", "ws://127.0.0.1:1"):
        assert f"hybridlog: {address} was never reached" in done.err
    assert "0 received" in done.out
    assert places.names(tmp_path / "store") == []
    assert run("ls", "--json", store=tmp_path / "store").json == []


def test_each_key_of_its_json_is_in_the_documentation(logs: Path, tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs/live.md").read_text("utf-8")
    section = text.partition("## State for other programs")[2].partition("\n## ")[0]
    with recorder(
        tmp_path / "store", "--replay", logs / "small.bag", "--max-messages", 50, "--ring", "9s"
    ) as process:
        assert process.stdout is not None
        lines = [json.loads(line) for line in process.stdout]
    states = [line["state"] for line in lines[:-1]]
    keys = {key for line in section.splitlines() if line[:3] == "| `" for key in named(line, 1)}
    assert keys == states[-1].keys()
    (topics,) = (named(line, 2) for line in section.splitlines() if line[:10] == "| `topics`")
    assert {key for state in states for topic in state["topics"] for key in topic} <= topics
    (told,) = (line for line in section.splitlines() if line.startswith("The report has"))
    report = lines[-1]["report"]
    assert (report["exit_code"], report["ended"]) == (0, "the limit of messages is reached")
    assert report.keys() <= {*re.findall(r"`(\w+)`", told)}
    failed = run("record", "--replay", tmp_path / "none.bag", "--json", store=tmp_path, code=None)
    assert failed.code != 0
    assert json.loads(failed.lines[-1])["report"]["exit_code"] == failed.code


def test_what_is_thinned_out_is_told(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with recorder(
        *(store, "--replay", logs / "small.bag", "--speed", 4, "--no-derive"),
        *("--throttle", "/imu/data", "5Hz", "-x", "/tf"),
    ) as process:
        report = end(process, None)
    topics = report["topics"]
    assert "/tf" not in topics
    counted = {t: n["received"] for t, n in topics.items()}
    lost = report["lost"]["throttle"]
    assert 0 < lost < counted["/imu/data"]
    (recording,) = report["recordings"]
    assert recording["messages"] + lost == report["messages_received"]
    rows = run("info", "--losses", "--json", "-t", "imu/data", store=store).json
    assert sum(row["count"] for row in rows) == lost
    assert {row["cause"] for row in rows} == {"throttle"}
    assert run("info", "--losses", "--json", "-t", "/joint_states", store=store).json == []
    assert "left out by a throttle" in run("fetch", "-t", "imu/data", "--count", store=store).err
    assert "/imu/data" in run("info", "--losses", store=store).out


def test_a_ring_keeps_the_end_and_what_is_pinned(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with recorder(
        *(store, "--replay", logs / "robot.bag", "--speed", 0.3, "--flush-interval", "100ms"),
        *("--ring", "1s", "--before", "500ms", "--after", "300ms", "--quiet", "--name", "the ring"),
    ) as process:
        until_it_speaks(process)
        run("mark", "bump", "--pin", "500ms", "300ms", "-r", "the ring", store=store)
        until_it_speaks(process, lambda state: state["let_go"])
        os.kill(process.pid, signal.SIGUSR1)
        until_it_speaks(process, lambda state: state["incidents"])
        report, said = end_and_hear(process)
    assert said == ""  # what is pinned is no trouble
    (entry,) = run("ls", "--json", store=store).json
    assert 0 < entry["messages"] < report["messages_received"]
    (told,) = run("info", "--json", store=store).json
    assert [pin["reason"] for pin in told["pins"]] == ["bump", "SIGUSR1"]
    run("export", tmp_path / "part.mcap", "--split-by", "mark", "-q", store=store)
    assert len([*tmp_path.glob("part-*.mcap")]) == 2


LOADS_LITTLE = """
import sys
from importlib import import_module
from hybridlog.live.recorder import Recorder

look = Recorder.look

def checked(self):
    assert not {"pyarrow", "pandas", "pymongo"} & {*sys.modules}
    return look(self)

Recorder.look = checked
import_module("hybridlog.cli.app").main()
"""


@pytest.mark.mongo
def test_a_recorder_loads_nothing_of_what_its_follower_does(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with hl.open(store, create=True) as opened:
        opened.directory.change_settings(retention={"max-age": "0s"})
    words = ("--replay", logs / "robot.bag", "--speed", 5, "--split-size", "1MiB")
    program = (sys.executable, "-c", LOADS_LITTLE)
    with recorder(store, *words, "--trigger", "/map: data == 0", program=program) as process:
        report = end(process, None)
    (recording,) = report["recordings"]
    assert recording["messages"] == recording["messages_indexed"] == report["messages_received"]
    assert any(log.gone == "expired" for log in places.manifest(store, "robot").logs.values())


def test_another_recording_goes_on_when_a_manifest_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: Limit
) -> None:
    """The limits are those of both, and each has what came in its time."""
    limit(full_manifest_bytes=1)
    said = 8
    numbers = iter(range(100))

    def speak(sink: Sink) -> None:
        for number in islice(numbers, 3):
            sink.take(text_channel(), text(str(number)), received=time.time_ns())

    monkeypatch.setattr(record_live, "sources_of", lambda _: [Speaker(speak)])
    words = ("--ros1", "--name", "run", "--max-messages", said, "--reserve", 0, "--json")
    done = answer("record", *words, "--no-derive", store=tmp_path / "store")
    report = json.loads(done.out.splitlines()[-1])["report"]
    names = ["run", "run-2", "run-3"][: -(-said // 3)]
    assert [one["name"] for one in report["recordings"]] == names
    assert f"the manifest of {names[-2]} is full: {names[-1]} goes on" in done.err
    with hl.open(tmp_path / "store", mongo="none") as store:
        found = [[int(m.fields["data"]) for m in store.query(["/chatter"], [n])] for n in names]
        assert found == [[*range(n, min(n + 3, said))] for n in range(0, said, 3)]
        assert store.verify().findings == []
