"""Interrupts as those of Ctrl-C at any moment: a KeyboardInterrupt where Python handles signals."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from pydantic_core import PydanticSerializationError

_UNRAISABLE = ("__del__",)
"""Functions from which Python reports an exception instead of raising it."""


class Moments:
    """The moments at which a signal may be handled: where a function begins or ends.

    They are numbered from 1 while `passing` runs something. At the moment ``interrupt`` it is
    interrupted. ``marks`` are the moments at which functions called ``mark`` began.
    """

    def __init__(self, interrupt: int | None = None, mark: str = "") -> None:
        self._interrupt, self._mark = interrupt, mark
        self.count = 0
        self.marks: list[int] = []

    @contextmanager
    def passing(self) -> Iterator[None]:
        """Count the moments of a block, which the interrupt ends, if it comes."""
        sys.setprofile(self._pass)
        try:
            yield
        except (KeyboardInterrupt, PydanticSerializationError):  # what pydantic makes of it
            if self._interrupt is None or self.count < self._interrupt:
                raise
        finally:
            sys.setprofile(None)

    def _pass(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "c_call" or frame.f_code.co_name in _UNRAISABLE:  # no moment before a C call
            return
        self.count += 1
        if event == "call" and frame.f_code.co_name == self._mark:
            self.marks.append(self.count)
        if self.count == self._interrupt:
            sys.setprofile(None)
            raise KeyboardInterrupt


def moments_of(work: Callable[[], object], mark: str = "") -> Moments:
    """The moments of some work that is not interrupted."""
    found = Moments(mark=mark)
    with found.passing():
        work()
    return found


def interrupt(work: Callable[[], object], moment: int) -> None:
    """Begin some work and interrupt it at a moment."""
    with Moments(moment).passing():
        work()
