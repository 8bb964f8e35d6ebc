"""How far long work is, for a progress bar.

Logs are read in many places, none of which knows whether a person waits for it. So the program says
once who is told (`tell_progress`), and what takes long reports here, a few times a second or
oftener: the reader of logs, their verification, the questions of an evaluation. In a program that
is not ``mapfold`` nobody is told.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Told = Callable[[str, int, int, str], None]
"""Called with what is done, how much of it is done, how much there is in all, and of what. A
total of 0 is one that nobody knows."""

_T = TypeVar("_T")


class _Listener:
    """Who is told now."""

    told: Told | None = None


def tell_progress(told: Told | None) -> None:
    """Have progress reported to this function, or to none."""
    _Listener.told = told


def report_progress(stage: str, done: int, total: int, unit: str = "events") -> None:
    """Say that ``done`` of ``total`` are through. With ``done >= total > 0`` the stage ends."""
    if _Listener.told is not None:
        _Listener.told(stage, done, total, unit)


def reported(items: Iterable[_T], stage: str, total: int, unit: str) -> Iterator[_T]:
    """Pass ``items``, of which there are ``total``, through, and report each when it is done with.
    The stage ends with them, and when reading them is given up."""
    try:
        for done, item in enumerate(items):
            report_progress(stage, done, total, unit)
            yield item
    finally:
        report_progress(stage, max(total, 1), max(total, 1), unit)


@contextlib.contextmanager
def working(stage: str) -> Iterator[None]:
    """Report a stage of which nobody knows how much of it is done, by a total of 0."""
    report_progress(stage, 0, 0, "")
    try:
        yield
    finally:
        report_progress(stage, 1, 1, "")
