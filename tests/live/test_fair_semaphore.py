"""A semaphore that admits waiting threads in arrival order."""

from __future__ import annotations

import threading
import time

from hybridlog.live.recording import FairSemaphore
from tests.waiting import wait_for


def test_no_more_threads_than_the_limit_are_inside() -> None:
    semaphore, lock = FairSemaphore(3), threading.Lock()
    inside = most = done = 0

    def work() -> None:
        nonlocal inside, most, done
        for _ in range(50):
            with semaphore:
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


def test_the_thread_that_has_waited_longest_is_next() -> None:
    semaphore = FairSemaphore(1)
    order: list[int] = []

    def work(number: int) -> None:
        with semaphore:
            order.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(20)]
    with semaphore:
        for number, thread in enumerate(threads):
            thread.start()
            wait_for(lambda number=number: len(semaphore._waiting) == number + 1)
    for thread in threads:
        thread.join()
    assert order == list(range(20))


def test_an_error_leaves_the_semaphore() -> None:
    semaphore = FairSemaphore(1)
    for _ in range(3):
        try:
            with semaphore:
                raise ZeroDivisionError
        except ZeroDivisionError:
            pass
    with semaphore:
        pass
