"""Signals that end a command: after its work is closed, through its ``finally`` blocks, or between
two steps of it."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from queue import SimpleQueue
from types import FrameType, TracebackType
from typing import Final, Self

_STOPPING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_POLL_S: Final = 0.25
_AGAIN_S: Final = 0.01


class _PollingEvent(threading.Event):
    """An event whose `wait` returns to the interpreter every `_POLL_S`.

    Python runs signal handlers between two bytecodes of the main thread; a signal that another
    thread receives, or that comes just before the wait, does not interrupt a plain `wait`.
    """

    def wait(self, timeout: float | None = None) -> bool:
        if timeout is not None:
            return super().wait(timeout)
        while not super().wait(_POLL_S):
            pass
        return True


def _ignore(_number: int, _frame: FrameType | None) -> None:
    """Ignore a signal. With SIG_IGN instead Python reports one that came with the first, and that
    it has not handled yet, with a traceback."""


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGINT, SIGTERM and SIGHUP set, so that the command can finish its work.

    SIGHUP comes when the terminal is closed; where it is ignored (``nohup``) it stays ignored.
    After the first signal a Ctrl-C has its usual effect again and ends a command that hangs. The
    others are ignored then: shells send a second SIGHUP, ``timeout`` a second SIGTERM at once. For
    the main thread only, as Python's signals are.
    """
    stop = _PollingEvent()
    usual = {number: signal.getsignal(number) for number in _STOPPING}
    if usual[signal.SIGHUP] == signal.SIG_IGN:
        del usual[signal.SIGHUP]

    def set_stop(_number: int, _frame: FrameType | None) -> None:
        for number, handler in usual.items():
            signal.signal(number, handler if number == signal.SIGINT else _ignore)
        came.put(True)

    def set_when_it_came() -> None:
        if came.get():
            stop.set()

    # A handler may interrupt this thread while it holds a lock, that of `stop` or one that starting
    # a thread needs, and must not wait for it. `SimpleQueue.put` is reentrant.
    came = SimpleQueue[bool]()
    threading.Thread(target=set_when_it_came, name="stop", daemon=True).start()
    for number in usual:
        signal.signal(number, set_stop)
    try:
        yield stop
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
        came.put(False)


@contextlib.contextmanager
def unwind_on_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP end the command through its ``finally`` blocks, as Ctrl-C does.

    Further ones are ignored, so that they do not interrupt these blocks. Where one of them is
    handled or ignored already, that stays so.

    Python calls a handler in the middle of a finalizer or a callback of a weak reference too, and
    ignores what is raised there. That is raised once more, a moment later.
    """
    ours = [
        number
        for number in (signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is signal.SIG_DFL
    ]

    def leave(signum: int, _frame: FrameType | None) -> None:
        for number in ours:
            signal.signal(number, _ignore)
        sys.exit(128 + signum)

    usual = sys.unraisablehook

    def raise_later(ignored: "sys.UnraisableHookArgs") -> None:
        error = ignored.exc_value
        if not isinstance(error, SystemExit | KeyboardInterrupt):
            usual(ignored)
            return

        def raise_again(_number: int, _frame: FrameType | None) -> None:
            raise error

        signal.signal(signal.SIGALRM, raise_again)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)

    for number in ours:
        signal.signal(number, leave)
    sys.unraisablehook = raise_later
    try:
        yield
    finally:
        sys.unraisablehook = usual
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


class Steps:
    """A context manager for one step of a command that Ctrl-C may end only between two steps.

    Inside it, Ctrl-C takes effect when the step is done; a second Ctrl-C takes effect at once.
    """

    def __init__(self) -> None:
        self._in_step = False
        self._interrupted = False

    def __enter__(self) -> Self:
        self._in_step = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._in_step = False
        if self._interrupted and error is None:
            raise KeyboardInterrupt

    def interrupt(self, _number: int, _frame: FrameType | None) -> None:
        """The handler of SIGINT."""
        if not self._in_step or self._interrupted:
            raise KeyboardInterrupt
        self._interrupted = True


@contextlib.contextmanager
def ctrl_c_between_steps() -> Iterator[Steps]:
    """While inside, Ctrl-C raises KeyboardInterrupt only outside of `Steps`."""
    steps = Steps()
    usual = signal.getsignal(signal.SIGINT)
    if usual is not signal.default_int_handler:  # ignored, or set by the caller
        yield steps
        return
    signal.signal(signal.SIGINT, steps.interrupt)
    try:
        yield steps
    finally:
        signal.signal(signal.SIGINT, usual)
