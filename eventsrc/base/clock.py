"""The only place that reads the wall clock; everything else is given a `Clock` or a time."""

import time
from collections.abc import Callable

Clock = Callable[[], int]
"""Returns int nanoseconds since the Unix epoch."""


def system_clock() -> int:
    """Now, in int nanoseconds since the Unix epoch."""
    return time.time_ns()
