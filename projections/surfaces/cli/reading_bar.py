"""The progress bar of every command: shows the reports of `base.progress` once work takes a second.

Commands need no code for it. It is shown on stderr if that is a terminal, and hidden while a
command shows a bar of its own (`terminal.Bar`, `terminal.FileBars`). It ends once data is written
to stdout, unless that is a file, because both would be mixed on a terminal or in a pager. Work in
other threads, as of a server, is not shown.
"""

import os
import stat
import threading
from typing import Final

from eventsrc.base.progress import send_progress_to

from .terminal import Bar, on_output, on_own_bar, people

DELAY_S: Final = 1.0
"""Shorter work gets no bar."""


class ReadingBar:
    """A context manager that shows the progress reported inside it."""

    def __init__(self, delay_s: float = DELAY_S) -> None:
        self._delay_s = delay_s
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._bar: Bar | None = None
        self._latest = ("", 0, 0, "")
        self._others = 0
        """Bars of the command itself."""
        self._over = not people.is_terminal

    def __enter__(self) -> "ReadingBar":
        if not self._over:
            send_progress_to(self.show)
            on_output(self._on_output)
            on_own_bar(self._on_own_bar)
        return self

    def __exit__(self, *_: object) -> None:
        send_progress_to(None)
        on_output(None)
        on_own_bar(None)
        self._stop()

    def show(self, stage: str, done: int, total: int, unit: str) -> None:
        """Show the stage from `DELAY_S` after its first report until its last."""
        if self._over or self._others or threading.current_thread() is not threading.main_thread():
            return
        if 0 < total <= done:
            self._stop()
            return
        with self._lock:
            self._latest = (stage, done, total, unit)
            if self._bar is not None:
                self._bar.show(*self._latest)
            elif self._timer is None:
                self._timer = threading.Timer(self._delay_s, self._start)
                self._timer.daemon = True
                self._timer.start()

    def _start(self) -> None:
        with self._lock:
            if self._timer is None:  # stopped meanwhile
                return
            self._bar = Bar(announced=False)
            self._bar.show(*self._latest)
            self._bar.__enter__()

    def _stop(self) -> None:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            bar, self._timer, self._bar = self._bar, None, None
        if bar is not None:
            bar.stop()

    def _on_output(self) -> None:
        if not self._over and not _is_file(1):
            self._over = True
            self._stop()

    def _on_own_bar(self, opened: int) -> None:
        self._others += opened
        self._stop()


def _is_file(number: int) -> bool:
    try:
        return stat.S_ISREG(os.fstat(number).st_mode)
    except OSError:
        return False
