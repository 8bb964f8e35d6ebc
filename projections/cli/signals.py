"""Ending a long-running command: the first SIGINT, SIGTERM or SIGHUP asks, the second one insists;
or Ctrl-C ends it, but between two steps."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType, TracebackType
from typing import Final, Self

_STOPPING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


_LOOK_S: Final = 0.25


class _Stop(threading.Event):
    """Waits in pieces. Python runs a signal's handler in the main thread, between two steps of it;
    a signal that another thread gets, or that comes just before the wait, does not end the wait.
    """

    def wait(self, timeout: float | None = None) -> bool:
        if timeout is not None:
            return super().wait(timeout)
        while not super().wait(_LOOK_S):
            pass
        return True


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGINT, SIGTERM and SIGHUP set, so that the command can finish its work. SIGHUP
    comes when the terminal goes; where it is ignored (``nohup``) it stays so.

    After the first signal all have their usual effect again: a second Ctrl-C ends a command that
    does not end. For the main thread only, as Python's signals are.
    """
    stop = _Stop()
    usual = {number: signal.getsignal(number) for number in _STOPPING}
    if usual[signal.SIGHUP] == signal.SIG_IGN:
        del usual[signal.SIGHUP]

    def restore() -> None:
        for number, handler in usual.items():
            signal.signal(number, handler)

    def ask(_number: int, _frame: FrameType | None) -> None:
        restore()
        # From another thread: the handler may have interrupted this thread inside `stop.wait`,
        # holding the very lock that `stop.set` takes.
        threading.Thread(target=stop.set, name="stop").start()

    for number in usual:
        signal.signal(number, ask)
    try:
        yield stop
    finally:
        restore()


class Steps:
    """A context manager for each step of a work that Ctrl-C may end only between two steps.

    Inside it Ctrl-C is held back until the step is done. A second Ctrl-C does not wait.
    """

    def __init__(self) -> None:
        self._busy = False
        self._asked = False

    def __enter__(self) -> Self:
        self._busy = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._busy = False
        if self._asked and error is None:
            raise KeyboardInterrupt

    def interrupt(self, _number: int, _frame: FrameType | None) -> None:
        """The handler of SIGINT."""
        if not self._busy or self._asked:
            raise KeyboardInterrupt
        self._asked = True


@contextlib.contextmanager
def ctrl_c_between_steps() -> Iterator[Steps]:
    """Where Ctrl-C would raise KeyboardInterrupt anywhere, let it do so outside of steps only."""
    steps = Steps()
    usual = signal.getsignal(signal.SIGINT)
    if usual is not signal.default_int_handler:  # ignored, or somebody else's
        yield steps
        return
    signal.signal(signal.SIGINT, steps.interrupt)
    try:
        yield steps
    finally:
        signal.signal(signal.SIGINT, usual)
