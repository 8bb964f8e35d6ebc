"""Time travel: why the map is what it is, and what it would be under other settings.

`Timeline` answers for one log under one setting: the map at any offset, every merge and its cause,
the chronicle of a place or an object, the difference of two moments, and the event that made a
condition true. `what_if` folds the log under other settings and compares.
"""

from .causes import Cause
from .conditions import Expression, ExpressionError
from .difference import Difference
from .lookup import NoSuchThing
from .search import Search, Turn
from .story import Entry, Story
from .timeline import Progress, Timeline
from .whatif import WhatIf, what_if

__all__ = [
    "Cause",
    "Difference",
    "Entry",
    "Expression",
    "ExpressionError",
    "NoSuchThing",
    "Progress",
    "Search",
    "Story",
    "Timeline",
    "Turn",
    "WhatIf",
    "what_if",
]
