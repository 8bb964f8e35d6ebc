"""Progress reports of long work, for a progress bar.

A program sets one function that receives all reports (`send_progress_to`). Long work, such as
reading or verifying a log, reports a few times a second or more often, wherever it is called from.
Until a function is set, as in programs other than ``mapfold``, reports are dropped.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Receiver = Callable[[str, int, int, str], None]
"""Receives the stage, how much of it is done, its total and the unit. A total of 0 is unknown."""

_T = TypeVar("_T")


class _Receiver:
    """The function that receives reports; None drops them. So does work on ``items`` of stages that
    report how many of them are done."""

    receive: Receiver | None = None
    items = 0


def send_progress_to(receive: Receiver | None) -> None:
    """Set the function that receives reports; None drops them."""
    _Receiver.receive = receive


def report_progress(stage: str, done: int, total: int, unit: str = "events") -> None:
    """Report ``done`` of ``total``. With ``done >= total > 0`` the stage ends."""
    if _Receiver.receive is not None and not _Receiver.items:
        _Receiver.receive(stage, done, total, unit)


def reported(items: Iterable[_T], stage: str, total: int, unit: str) -> Iterator[_T]:
    """Yield ``items``, ``total`` in number, and report each as done when the next is requested, but
    no stage within the work on one. The stage ends after the last one, or when the caller closes
    the iterator."""
    try:
        for done, item in enumerate(items):
            report_progress(stage, done, total, unit)
            _Receiver.items += 1
            try:
                yield item
            finally:
                _Receiver.items -= 1
    finally:
        report_progress(stage, max(total, 1), max(total, 1), unit)


@contextlib.contextmanager
def working(stage: str) -> Iterator[None]:
    """Report a stage of unknown length, with a total of 0, within a ``with`` block."""
    report_progress(stage, 0, 0, "")
    try:
        yield
    finally:
        report_progress(stage, 1, 1, "")
