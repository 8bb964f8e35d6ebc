"""Time travel: past maps, why the map is what it is, and what it would be under other settings.

`LogTimeline` answers for one log: the map at any offset under the commands known at another, every
merge and its cause, the explanation of a place or an object, the difference of two maps, and the
event that made a condition true. `what_if` folds the log under other settings, or without one of
its commands, and compares.
"""

from projections.map.naming import NoSuchThing
from projections.store.history_records import Cause

from .bisect import Search, Turn
from .conditions import Expression, ExpressionError
from .diff import Difference
from .explanation import Entry, Explanation
from .known_history import KnownHistory, Progress
from .timeline import LogTimeline
from .whatif import WhatIf, what_if

__all__ = [
    "Cause",
    "Difference",
    "Entry",
    "Explanation",
    "Expression",
    "ExpressionError",
    "KnownHistory",
    "LogTimeline",
    "NoSuchThing",
    "Progress",
    "Search",
    "Turn",
    "WhatIf",
    "what_if",
]
