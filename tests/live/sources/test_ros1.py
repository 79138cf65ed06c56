"""The ROS 1 source against a master and publishers in plain Python, good and bad ones."""

from __future__ import annotations

import socket
import struct
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import psutil
import pytest

from hybridlog.live.sources.base import Cause
from hybridlog.live.sources.ros1.source import Ros1Source
from tests.live.sources.heard import Listening, must_return
from tests.live.sources.ros1_peers import (
    Collector,
    FakeMaster,
    FakePublisher,
    framed,
    sends,
    until_closed,
)
from tests.servers.mongods import free_port
from tests.waiting import wait_for

Script = Callable[[socket.socket], None]


@pytest.fixture(autouse=True)
def _quiet_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_MASTER_URI", raising=False)


@pytest.fixture(autouse=True)
def _nothing_is_left() -> Iterator[None]:
    """No thread and no socket outlives a test."""
    files, threads = psutil.Process().num_fds(), threading.active_count()
    yield
    wait_for(lambda: threading.active_count() <= threads)
    wait_for(lambda: psutil.Process().num_fds() <= files)


@contextmanager
def _system(
    *publishers: FakePublisher, sink: Collector | None = None
) -> Iterator[tuple[FakeMaster, Collector]]:
    """A master, publishers that it knows, and a source that listens to them."""
    sink = sink or Collector()
    with ExitStack() as stack:
        master = stack.enter_context(FakeMaster())
        for publisher in publishers:
            stack.enter_context(publisher)
            _announce(master, publisher)
        with Ros1Source(master.uri, poll_s=0.1) as source:
            source.start(sink)
            yield master, sink


def _announce(master: FakeMaster, publisher: FakePublisher) -> None:
    master.add(publisher.topic, publisher.fields["type"], publisher.node, publisher.uri)


def test_messages_come_as_they_were_sent() -> None:
    publisher = FakePublisher(sends(b"", b"one", bytes(3_000_000), b"two"))
    before = time.time_ns()
    with _system(publisher) as (_, sink):
        sink.wait_for(b"", b"one", bytes(3_000_000), b"two")
    channel = sink.taken[0].channel
    assert all(taken.channel is channel for taken in sink.taken)
    assert before <= sink.taken[0].received <= sink.taken[-1].received <= time.time_ns()
    assert channel.topic == "/topic"
    assert channel.schema is not None
    assert (channel.schema.name, channel.schema.data) == ("std_msgs/String", b"string data\n")
    assert channel.metadata["callerid"] == "/node"
    (asked,) = publisher.asked
    assert (asked["topic"], asked["type"], asked["md5sum"]) == ("/topic", "*", "*")
    assert sink.topics == [("/topic", "std_msgs/String")]
    assert sink.said == sink.losses == sink.ends == []


def test_only_topics_that_are_wanted() -> None:
    sink = Collector(wanted=lambda topic, type_name: topic == "/b")
    a, b = FakePublisher(sends(b"a"), topic="/a"), FakePublisher(sends(b"b"), topic="/b")
    with _system(a, b, sink=sink) as (master, _):
        sink.wait_for(b"b", topic="/b")
        wait_for(lambda: master.calls.count("getSystemState") > 4)
    assert a.asked == []
    assert {*sink.asked} == {("/a", "std_msgs/String"), ("/b", "std_msgs/String")}


def test_a_topic_goes_and_comes_back() -> None:
    closing = threading.Event()

    def until_told(connection: socket.socket) -> None:
        connection.sendall(framed(b"x"))
        closing.wait(10)

    publisher = FakePublisher(until_told)
    with _system(publisher) as (master, sink):
        sink.wait_for(b"x")
        publisher.withdraw()
        master.remove("/topic", "/node")
        closing.set()
        sink.wait(lambda: ("/topic",) in sink.topics)
        with FakePublisher(sends(b"y")) as again:
            _announce(master, again)
            sink.wait_for(b"x", b"y")
    came = ("/topic", "std_msgs/String")
    assert sink.topics[:3] == [came, ("/topic",), came]
    assert sink.said == []


def test_a_node_that_is_started_anew_at_another_address() -> None:
    """The master's list of names stays the same."""
    with _system() as (master, sink):
        with FakePublisher(sends(b"x")) as first:
            _announce(master, first)
            sink.wait_for(b"x")
        with FakePublisher(sends(b"y")) as second:
            _announce(master, second)
            sink.wait_for(b"x", b"y")


def test_publishers_of_different_types() -> None:
    numbers = {"type": "std_msgs/Int8", "message_definition": "int8 data\n", "md5sum": "27"}
    sink = Collector(wanted=lambda topic, type_name: type_name != "std_msgs/Bool")
    bools = FakePublisher(sends(b"no"), node="/bool", fields={"type": "std_msgs/Bool"})
    with _system(FakePublisher(sends(b"text")), sink=sink) as (master, _):
        sink.wait_for(b"text")
        with FakePublisher(sends(b"7"), node="/int\x1b[31m", fields=numbers) as other, bools:
            master.add("/topic", "", "/bool", bools.uri)
            master.add("/topic", "", "/int", other.uri)
            sink.wait_for(b"text", b"7")
            wait_for(lambda: bool(bools.asked))
    assert bools.connections <= 1
    schemas = [taken.channel.schema for taken in sink.taken]
    assert [schema.name for schema in schemas if schema] == ["std_msgs/String", "std_msgs/Int8"]


def test_a_master_that_is_started_anew() -> None:
    """It knows nobody; what is connected goes on, and new publishers are found."""
    going: list[socket.socket] = []

    def script(connection: socket.socket) -> None:
        connection.sendall(framed(b"before"))
        going.append(connection)
        until_closed(connection)

    sink = Collector()
    with ExitStack() as stack:
        first = stack.enter_context(FakePublisher(script))
        with FakeMaster() as master:
            _announce(master, first)
            source = stack.enter_context(Ros1Source(master.uri, poll_s=0.05))
            source.start(sink)
            sink.wait_for(b"before")
        sink.wait_said("no ROS master", f"127.0.0.1:{master.port}", "refused", "roscore")
        master = stack.enter_context(FakeMaster(port=master.port))
        wait_for(lambda: master.calls)
        going[0].sendall(framed(b"after"))
        sink.wait_for(b"before", b"after")
        second = stack.enter_context(FakePublisher(sends(b"new"), node="/new"))
        _announce(master, second)
        sink.wait_for(b"before", b"after", b"new")
    assert first.connections == 1
    assert not sink.losses


def _serve_raw(answer: bytes, *, endless: bool = False) -> Script:
    def script(connection: socket.socket) -> None:
        connection.recv(65536)
        connection.sendall(answer)
        while endless:
            connection.sendall(bytes(1 << 20))

    return script


def _http(body: bytes, *, length: str | None = None) -> bytes:
    count = length or str(len(body))
    return f"HTTP/1.0 200 OK\r\nContent-Length: {count}\r\n\r\n".encode() + body


def _xml(value: object) -> bytes:
    return _http(xmlrpc.client.dumps((value,), methodresponse=True).encode())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"", "does not speak HTTP"),
        (b"SSH-2.0-x\r\n\r\n", "does not speak HTTP"),
        (b"HTTP/1.0 404 \x1b[2JNo\r\n\r\n", "404 ?[2JNo"),
        (_http(b"<html>"), "malformed XML-RPC"),
        (_http(b"", length="99999999999"), "longer than"),
        (_http(b"", length="-1"), "an invalid content length"),
        (_http(b"abc", length="10"), "in the middle of its answer"),
        (_http(b"<!DOCTYPE a [<!ENTITY b 'c'>]>"), "XML with a document type"),
        (_xml([1, "", [[["/a", "b"]], [], []]]), "not that of a ROS master"),
        (_xml([1, "", 5]), "not that of a ROS master"),
        (_xml({"a": 1}), "not that of a ROS node"),
        (_xml([-1, "go \x9b away", 0]), "it refuses: go ? away"),
        (_http(xmlrpc.client.dumps(xmlrpc.client.Fault(1, "no")).encode()), "it answers: no"),
    ],
)
def test_what_is_no_master(answer: bytes, words: str) -> None:
    with Listening(_serve_raw(answer)) as server:
        sink = Collector()
        with Ros1Source(f"http://127.0.0.1:{server.port}") as source:
            source.start(sink)
            sink.wait_said("no ROS master", words)


@pytest.mark.parametrize("answer", [b"x", b"HTTP/1.0 200 OK\r\n\r\n"], ids=["header", "body"])
def test_an_answer_without_end(answer: bytes) -> None:
    before = psutil.Process().memory_info().rss
    with Listening(_serve_raw(answer, endless=True)) as server:
        sink = Collector()
        with Ros1Source(f"http://127.0.0.1:{server.port}") as source:
            source.start(sink)
            sink.wait_said("no ROS master")
    assert psutil.Process().memory_info().rss - before < 150 << 20


def test_where_the_master_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Ros1Source().address == "http://localhost:11311"
    monkeypatch.setenv("ROS_MASTER_URI", "http://robot:1234")
    assert Ros1Source().address == "http://robot:1234"
    assert Ros1Source("http://other:1").address == "http://other:1"
    monkeypatch.setenv("ROS_MASTER_URI", "")
    assert Ros1Source().address == "http://localhost:11311"


def test_a_publisher_that_dies_in_a_message_is_connected_again() -> None:
    def script(connection: socket.socket) -> None:
        if publisher.connections == 1:
            connection.sendall(framed(b"first") + b"\x64\0\0\0half")
            connection.shutdown(socket.SHUT_RDWR)
        else:
            sends(b"second")(connection)

    publisher = FakePublisher(script)
    with _system(publisher) as (_, sink):
        sink.wait_for(b"first", b"second")
        sink.wait_said("/topic", "/node", "4 of 100 bytes", "connecting again")
    (loss,) = sink.losses
    assert (loss.cause, loss.count) == (Cause.CONNECTION, 1)
    assert "4 of 100 bytes" in loss.reason


def test_memory_grows_with_what_comes_and_not_with_what_is_announced() -> None:
    def script(connection: socket.socket) -> None:
        connection.sendall(struct.pack("<I", 1 << 30) + bytes(100_000))
        reached.release()
        until_closed(connection)

    reached = threading.Semaphore(0)
    bad = [FakePublisher(script, node=f"/bad{n}") for n in range(8)]
    before = psutil.Process().memory_info().rss
    with _system(*bad, FakePublisher(sends(b"good"))) as (_, sink):
        sink.wait_for(b"good")
        for _ in bad:
            assert reached.acquire(timeout=20)
        assert psutil.Process().memory_info().rss - before < 64 << 20


@pytest.mark.parametrize(
    ("greeting", "words"),
    [
        (b"\xff\xff\xff\xff", "connection header of 4294967295 bytes"),
        (b"\x07\0\0\0\x03\0\0\0\xff\xfe\xfd", "header is malformed"),
        (b"\x20\0\0\0abc", "closed the connection within its header"),
        (framed(framed(b"error=you \x1b[31m may not")), "it refuses: you ?[31m may not"),
    ],
)
def test_a_broken_header(greeting: bytes, words: str) -> None:
    def script(connection: socket.socket) -> None:
        connection.sendall(greeting)
        connection.shutdown(socket.SHUT_RDWR)

    bad = FakePublisher(script, node="/bad", greets=False)
    with _system(bad, FakePublisher(sends(b"good"))) as (_, sink):
        sink.wait_for(b"good")
        sink.wait_said("/topic", bad.uri, words)


def test_a_publisher_that_is_not_there() -> None:
    with _system(FakePublisher(sends(b"good"))) as (master, sink):
        sink.wait_for(b"good")
        master.add("/topic", "", "/dead", f"http://127.0.0.1:{free_port()}/")
        master.add("/topic", "", "/odd", "tcp://\x9bnowhere")
        sink.wait_said("refused", "rosnode cleanup", "ROS_IP")
        sink.wait_said("/topic", "not an address")
        sink.wait(lambda: sink.topics[-1] == ("/topic", "std_msgs/String"))
    assert all(line.isprintable() for line in sink.said)


def test_a_dead_node_is_told_of_once_and_its_topics_do_not_come() -> None:
    with FakeMaster() as master, Ros1Source(master.uri, poll_s=0.05) as source:
        assert not source.was_reached
        uri = f"http://127.0.0.1:{free_port()}/"
        for number in range(11):
            master.add(f"/dead/{number:02}", "std_msgs/String", "/dead", uri)
        sink = Collector()
        source.start(sink)
        sink.wait_said(uri, "rosnode cleanup")
        master.add("/dead/late", "std_msgs/String", "/dead", uri)
        calls = master.calls.count("getSystemState")
        wait_for(lambda: master.calls.count("getSystemState") > calls + 10)
        assert source.was_reached
    assert len({*sink.said}) == 1
    assert sink.topics == []


def test_a_publisher_that_offers_nothing() -> None:
    offers = [
        [],
        ["UDPROS", "x", 1],
        ["TCPROS", "127.0.0.1"],
        ["TCPROS", "", 1],
        ["TCPROS", "x", 0],
    ]
    bad = [FakePublisher(sends(b"x"), offer=o, node=f"/{n}") for n, o in enumerate(offers)]
    with _system(*bad) as (_, sink):
        for publisher in bad:
            sink.wait_said(publisher.uri, "does not offer the topic over TCPROS")
    assert sink.taken == []


def test_a_topic_nobody_speaks_on_delays_nothing() -> None:
    silent = FakePublisher(until_closed, topic="/silent")
    never = FakePublisher(until_closed, topic="/never", greets=False)
    with ExitStack() as stack:
        publishers = silent, never, FakePublisher(sends(b"x"))
        _, sink = stack.enter_context(_system(*publishers))
        sink.wait_for(b"x")
        wait_for(lambda: silent.connections == never.connections == 1)
        must_return(stack.close)


def _has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


@pytest.mark.skipif(not _has_ipv6(), reason="IPv6 was NOT tested: this computer has no ::1")
def test_ipv6() -> None:
    sink = Collector()
    with FakeMaster("::1") as master, FakePublisher(sends(b"x"), host="::1") as publisher:
        _announce(master, publisher)
        with Ros1Source(master.uri) as source:
            source.start(sink)
            sink.wait_for(b"x")


def test_what_has_come_is_handed_over_when_it_stops() -> None:
    """The source is held up with its socket full, and stopped."""
    payloads = [str(number).encode() * 100 for number in range(2000)]
    held, holding, sent = threading.Event(), threading.Event(), threading.Event()

    class Slow(Collector):
        def take(self, *arguments: object, **more: object) -> None:
            held.set()
            holding.wait(20)
            super().take(*arguments, **more)  # type: ignore[arg-type]

    def script(connection: socket.socket) -> None:
        connection.sendall(framed(*payloads))
        sent.set()
        until_closed(connection)

    sink = Slow()
    with _system(FakePublisher(script), sink=sink):
        # All of it may fit into the socket before anybody reads there.
        assert sent.wait(20)
        assert held.wait(20)
        threading.Timer(0.1, holding.set).start()
    assert sink.payloads() == payloads
    assert sink.topics == [("/topic", "std_msgs/String")]


def test_stopping_while_publishers_pour() -> None:
    def pour(connection: socket.socket) -> None:
        data = framed(bytes(100)) * 1000
        while True:
            connection.sendall(data)

    with ExitStack() as stack:
        _, sink = stack.enter_context(_system(FakePublisher(pour)))
        sink.wait(lambda: len(sink.taken) > 1000)
        must_return(stack.close)


def test_a_master_that_never_answers_does_not_hold_up_the_end() -> None:
    with Listening(until_closed) as server:
        with Ros1Source(f"http://127.0.0.1:{server.port}") as source:
            source.start(Collector())
            time.sleep(0.1)  # so that it is in the middle of its call
            must_return(source.stop)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_sink_that_fails_ends_the_source_with_a_reason() -> None:
    class Broken(Collector):
        def take(self, *_: object, **__: object) -> None:
            raise RuntimeError("no room in the shelf")

    sink = Broken()
    with _system(FakePublisher(sends(b"x")), sink=sink):
        sink.wait(lambda: bool(sink.ends))
    assert "no room in the shelf" in sink.ends[0]
