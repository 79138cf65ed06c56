"""What `hybridlog view` takes: `python -m benchmarks.view STORE --clients 20`.

Starts the server on a store, and asks for what the page asks for: the list of recordings, the
first timeline of a recording with all of its topics, and zooms into it, each with 1,600 pixels.
The server has read nothing before the first timeline. Then clients zoom at the same time.
Printed: times in ms, processor time of the server by answer in ms, bytes of the largest answer,
and memory of the server in MB. On a busy machine, only the processor time says something.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import psutil

PIXELS = 1600
ZOOMS = 40


class Page:
    """Asks the server what a page asks.

    Args:
        address: URL of the page, with its token.

    Attributes:
        content: The last answer.
    """

    def __init__(self, address: str) -> None:
        self.content = b""
        self._client = httpx2.Client(base_url=address, timeout=120)

    def get(self, path: str, **parameters: Any) -> tuple[float, int]:
        """Time of an answer, ms, and its bytes; `content` has it."""
        begin = time.perf_counter()
        answer = self._client.get(path, params=parameters)
        answer.raise_for_status()
        self.content = answer.content
        return 1000 * (time.perf_counter() - begin), len(answer.content)

    def timeline(self, recording: dict[str, Any], begin: int, end: int) -> tuple[float, int]:
        """Time, ms, and bytes of a timeline of all topics."""
        topics = [topic["topic"] for topic in recording["topics"]][:64]
        span = {"begin": begin, "end": end, "pixels": PIXELS}
        return self.get("timeline", recording=recording["id"], topic=topics, **span)


def zooms(recording: dict[str, Any], seed: int) -> Iterator[tuple[int, int]]:
    """Ranges of a person who zooms into some places, halving the range, ns since the start."""
    random = np.random.default_rng(seed)
    length = recording["end"] - recording["begin"]
    for n in range(ZOOMS):
        width = max(length >> (n % 10 + 1), 1_000_000)
        begin = recording["begin"] + int(random.random() * max(length - width, 1))
        yield begin, begin + width


class Server:
    """Processor time and memory of the server.

    Args:
        process: Its process.
    """

    def __init__(self, process: psutil.Process) -> None:
        self._process = process
        self._before = self._work()

    def _work(self) -> float:
        times = self._process.cpu_times()
        return 1000 * float(times.user + times.system)

    def tell(self, name: str, answers: list[tuple[float, int]]) -> None:
        """Print a row about the answers since the last one."""
        times, sizes = zip(*answers, strict=True)
        before, self._before = self._before, self._work()
        work = (self._before - before) / len(answers)
        memory = self._process.memory_info().rss / 1e6
        cells = f"{np.median(times):8.1f} | {max(times):8.1f} | {work:8.1f} | {max(sizes):8,}"
        print(f"| {name:22} | {cells} | {memory:6.0f} |", flush=True)


def main() -> None:
    """Ask everything once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("--clients", type=int, default=20)
    chosen = parser.parse_args()
    command = [sys.executable, "-m", "hybridlog", "view", "--json", "--store", str(chosen.store)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            text = ""
            while not text.rstrip().endswith("}"):
                text += process.stdout.readline()
            measure(json.loads(text)["url"], Server(psutil.Process(process.pid)), chosen.clients)
        finally:
            process.terminate()


def measure(address: str, server: Server, clients: int) -> None:
    """Ask the server, one page first, then several at a time."""
    page = Page(address)
    print(f"| {'':22} |   median |     most |     work |    bytes | memory |")
    server.tell("page", [page.get("") for _ in range(3)])
    listed = page.get("recordings", count=100)
    server.tell("recordings", [listed])
    rows = json.loads(page.content)["rows"]
    by = [page.get("recordings", count=100, order="messages") for _ in range(5)]
    server.tell("recordings, ordered", by)
    by = [page.get("recordings", count=100, name=f"{n}") for n in range(5)]
    server.tell("recordings, by name", by)
    by = [page.get("recording", recording=rows[0]["id"])]
    first = json.loads(page.content)
    server.tell("recording", by)
    server.tell("first timeline", [page.timeline(first, first["begin"], first["end"])])
    for name in ("zooms", "the same zooms again"):
        server.tell(name, [page.timeline(first, *span) for span in zooms(first, 0)])

    def visit(number: int) -> list[tuple[float, int]]:
        mine = Page(address)
        mine.get("recording", recording=rows[number % len(rows)]["id"])
        one = json.loads(mine.content)
        return [mine.timeline(one, *span) for span in zooms(one, number + 1)]

    begin = time.perf_counter()
    with ThreadPoolExecutor(clients) as pool:
        answers = [answer for visited in pool.map(visit, range(clients)) for answer in visited]
    server.tell(f"zooms, {clients} clients", answers)
    print(f"{len(answers) / (time.perf_counter() - begin):.0f} timelines a second")


if __name__ == "__main__":
    main()
