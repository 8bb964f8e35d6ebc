"""Signals: Ctrl-C takes effect between two steps; what a second signal does to a command that ends
after the first."""

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from projections.surfaces.cli.signals import (
    ctrl_c_between_steps,
    stop_on_signals,
    unwind_on_signals,
)
from tests.support import prefork

_HANDLER = signal.getsignal(signal.SIGINT)


def _ctrl_c() -> None:
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c_in_a_step_takes_effect_after_it() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps() as step:  # noqa: PT012
        for number in range(9):
            with step:
                if number == 2:
                    _ctrl_c()
                done.append(number)
    assert done == [0, 1, 2]
    assert signal.getsignal(signal.SIGINT) is _HANDLER


def test_ctrl_c_outside_of_steps_takes_effect_at_once() -> None:
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps():
        _ctrl_c()


def test_a_second_ctrl_c_takes_effect_at_once() -> None:
    reached = []
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps() as step, step:  # noqa: PT012
        _ctrl_c()
        reached.append("after the first")
        _ctrl_c()
        reached.append("after the second")
    assert reached == ["after the first"]


@pytest.fixture
def unhandled() -> Iterator[None]:
    """SIGTERM and SIGHUP have no handler, and the tests' process survives those of a test."""
    usual = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    yield
    for number, handler in usual.items():
        signal.signal(number, handler)


ENDING = (signal.SIGTERM, signal.SIGHUP)


def test_the_handler_starts_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would wait for ever where it interrupted a `join` that holds the lock of all threads."""
    with stop_on_signals() as stop:
        monkeypatch.delattr(threading.Thread, "start")
        _ctrl_c()
        assert stop.wait(60)


@pytest.mark.usefixtures("unhandled")
@pytest.mark.parametrize("first", [signal.SIGINT, *ENDING])
@pytest.mark.parametrize("second", ENDING)
def test_a_second_signal_does_not_cut_the_end_of_a_command_short(
    first: signal.Signals, second: signal.Signals
) -> None:
    with stop_on_signals() as stop:
        signal.raise_signal(first)
        stop.wait()
        signal.raise_signal(second)
        if first is signal.SIGINT:
            with pytest.raises(KeyboardInterrupt):
                _ctrl_c()
    assert [signal.getsignal(number) for number in ENDING] == [signal.SIG_DFL] * 2
    assert signal.getsignal(signal.SIGINT) is _HANDLER


@pytest.mark.usefixtures("unhandled")
@pytest.mark.parametrize("number", ENDING)
def test_signals_unwind_a_command_once(number: signal.Signals) -> None:
    closed = []
    with pytest.raises(SystemExit) as ended, unwind_on_signals():  # noqa: PT012
        try:
            signal.raise_signal(number)
        finally:
            for again in ENDING:
                signal.raise_signal(again)
            closed.append("all")
    assert ended.value.code == 128 + number
    assert closed == ["all"]
    assert [signal.getsignal(number) for number in ENDING] == [signal.SIG_DFL] * 2


_AT_ONCE = """
import os, signal, sys
from projections.surfaces.cli.signals import stop_on_signals, unwind_on_signals
with (stop_on_signals if sys.argv[1] == "stop" else unwind_on_signals)():
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGHUP})
    os.kill(os.getpid(), signal.SIGTERM)
    os.kill(os.getpid(), signal.SIGHUP)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM, signal.SIGHUP})
"""


@pytest.mark.parametrize(("kind", "codes"), [("stop", {0}), ("unwind", {129, 143})])
def test_signals_that_come_at_once_leave_no_traceback(kind: str, codes: set[int]) -> None:
    done = prefork.run(_AT_ONCE, ["-c", kind], env={**os.environ}, cwd=prefork.ROOT, timeout=60.0)
    assert (done.returncode in codes, done.stderr) == (True, b"")


_IN_CALLBACK = """
import signal, sys, threading, weakref
from projections.surfaces.cli.program import run_app

class Thing:
    pass

def command():
    thing = Thing()
    seen = weakref.ref(thing, lambda _: signal.raise_signal(int(sys.argv[1])))
    del thing  # what the callback raises is ignored
    threading.Event().wait(50.0)
    raise AssertionError("the signal was lost")

run_app(command)
"""


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_within_a_callback_of_a_weak_reference_ends_the_command(
    sent: signal.Signals, code: int
) -> None:
    done = prefork.run(
        _IN_CALLBACK, ["-c", str(int(sent))], env={**os.environ}, cwd=prefork.ROOT, timeout=60.0
    )
    assert done.returncode == code, done.stderr
    assert b"Traceback" not in done.stderr


@pytest.mark.usefixtures("unhandled")
def test_a_signal_that_is_ignored_stays_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
    with stop_on_signals() as stop:
        signal.raise_signal(signal.SIGHUP)
        assert not stop.is_set()
    with unwind_on_signals():
        signal.raise_signal(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


_IN_A_FILE = """
import os, signal, sys
from pathlib import Path
from eventsrc.base.user_files import written_whole
from projections.surfaces.cli.program import run_app

def command():
    with written_whole(Path(sys.argv[1])) as file:
        file.write(b"half")
        signal.raise_signal(int(sys.argv[2]))
        file.write(b"of it")

run_app(command)
"""


@pytest.mark.parametrize(
    ("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_within_a_file_leaves_the_old_one_and_nothing_else(
    tmp_path: Path, sent: signal.Signals, code: int
) -> None:
    out = tmp_path / "map.svg"
    out.write_bytes(b"old")
    done = prefork.run(
        _IN_A_FILE,
        ["-c", str(out), str(int(sent))],
        env={**os.environ},
        cwd=prefork.ROOT,
        timeout=60.0,
    )
    assert done.returncode == code, done.stderr
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == {out: b"old"}
