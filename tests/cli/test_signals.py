"""Which signals stop a command, and how."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from hybridlog.cli import signals
from hybridlog_storage.stopping import at_safe_points, safe_point


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in signals.SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_background_job_is_stopped_by_sigint_and_nohup_still_holds() -> None:
    for number in signals.SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signals.install()
    ignored = [n for n in signals.SIGNALS if signal.getsignal(n) is signal.SIG_IGN]
    assert ignored == [signal.SIGTERM, signal.SIGHUP]


def test_the_consequence_is_that_of_the_innermost_work_at_the_time() -> None:
    signals.install()

    def work() -> None:
        with signals.if_stopped("outer"), at_safe_points():
            done = 0
            with signals.if_stopped("over"):
                pass
            with signals.if_stopped(lambda: f"{done} done"):
                signal.raise_signal(signal.SIGTERM)
                done = 1
                safe_point()

    with pytest.raises(signals.Stopped) as stopped:
        work()
    assert (stopped.value.consequence, stopped.value.exit_code) == ("1 done", 143)


def test_a_second_signal_only_says_that_it_waits(capfd: pytest.CaptureFixture[str]) -> None:
    signals.install()

    def work() -> None:
        with at_safe_points():
            signal.raise_signal(signal.SIGHUP)
            assert capfd.readouterr().err == ""
            signal.raise_signal(signal.SIGINT)
            assert "press again to leave at once" in capfd.readouterr().err

    with pytest.raises(signals.Stopped) as stopped:
        work()
    assert stopped.value.number == signal.SIGHUP
