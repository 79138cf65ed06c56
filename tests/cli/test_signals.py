"""Which signals stop a command, and how."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import NoReturn

import pytest

from hybridlog.cli import signals
from hybridlog_storage.disk.files import beside
from hybridlog_storage.stopping import at_safe_points


def test_a_background_job_is_stopped_by_sigint_and_nohup_still_holds() -> None:
    for number in signals.SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signals.install()
    ignored = [n for n in signals.SIGNALS if signal.getsignal(n) is signal.SIG_IGN]
    assert ignored == [signal.SIGTERM, signal.SIGHUP]


@pytest.mark.parametrize(
    ("number", "is_terminal"),
    [(signal.SIGINT, True), (signal.SIGTERM, False), (signal.SIGHUP, False)],
)
def test_a_command_with_nothing_to_take_back_leaves_in_the_handler(
    number: signal.Signals,
    is_terminal: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def leave(code: int) -> NoReturn:
        raise SystemExit(code)

    monkeypatch.setattr("os._exit", leave)
    monkeypatch.setattr("os.isatty", lambda _: is_terminal)
    signals.install()
    place = beside(tmp_path / "x")
    place.path.touch()
    with pytest.raises(SystemExit) as left:
        signal.raise_signal(number)
    assert left.value.code == 128 + number
    assert list(tmp_path.iterdir()) == []
    # The bar's line is cleared, and the cursor shown again.
    clear = "\r\x1b[K\x1b[?25h" if is_terminal else ""
    assert capfd.readouterr().err == f"{clear}hybridlog: {signals.INTERRUPTED}\n"


def test_the_second_signal_leaves_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def leave(code: int) -> NoReturn:
        raise SystemExit(code)

    def press_twice() -> None:
        with at_safe_points():
            for _ in range(2):
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("os._exit", leave)
    signals.install()
    with pytest.raises(signals.Stopped) as stopped:
        press_twice()
    assert isinstance(stopped.value.__context__, SystemExit)
    assert stopped.value.exit_code == 130
