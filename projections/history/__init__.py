"""Time travel: why the map is what it is, and what it would be under other settings.

`Timeline` answers for one log under one setting: the map at any offset, every merge and its cause,
the chronicle of a place or an object, the difference of two moments, and the event that made a
condition true. `what_if` folds the log under other settings and compares.
"""

from .bisect import Search, Turn
from .conditions import Expression, ExpressionError
from .diff import Difference
from .records import Cause
from .same_place import NoSuchThing
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
