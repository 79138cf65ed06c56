"""Some at a time, in the order in which they came."""

from __future__ import annotations

import threading
import time

from hybridlog.live.turns import Turns
from tests.test_faults import wait_for


def test_no_more_than_so_many_at_a_time() -> None:
    turns, lock = Turns(3), threading.Lock()
    inside = most = done = 0

    def work() -> None:
        nonlocal inside, most, done
        for _ in range(50):
            with turns:
                with lock:
                    inside += 1
                    most = max(most, inside)
                time.sleep(0.0002)
                with lock:
                    inside -= 1
                    done += 1

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (most, inside, done) == (3, 0, 400)


def test_who_has_waited_longest_is_next() -> None:
    turns = Turns(1)
    order: list[int] = []

    def work(number: int) -> None:
        with turns:
            order.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(20)]
    with turns:
        for number, thread in enumerate(threads):
            thread.start()
            wait_for(lambda number=number: len(turns._waiting) == number + 1)
    for thread in threads:
        thread.join()
    assert order == list(range(20))


def test_an_error_gives_the_turn_back() -> None:
    turns = Turns(1)
    for _ in range(3):
        try:
            with turns:
                raise ZeroDivisionError
        except ZeroDivisionError:
            pass
    with turns:
        pass
