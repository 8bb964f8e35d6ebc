"""Ending a long-running command: the first SIGINT or SIGTERM asks, the second one insists."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set, so that the command can finish its work.

    After the first signal both have their usual effect again: a second Ctrl-C ends a command that
    does not end. For the main thread only, as Python's signals are.
    """
    stop = threading.Event()
    usual = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

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
